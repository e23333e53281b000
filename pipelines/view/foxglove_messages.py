"""Drawings as messages of Foxglove, ready for JSON; their fields are in `foxglove_schemas`.

A pose is a `FrameTransforms`, a cloud a `PointCloud` of float32 x, y, z, every other shape a `SceneUpdate` that first
deletes all its layer showed before: each message says all there is, so that one may begin anywhere. What has facts is
an entity each, named by the first fact and with all of them as metadata; other shapes are one entity together.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, assert_never

import numpy as np

from pipelines.view.drawing import Arrows, Cubes, Drawing, Ellipses, Lines, Marks, Points, Pose
from pipelines.view.foxglove_schemas import FRAME_TRANSFORMS, POINT_CLOUD, SCENE_UPDATE
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import rotation_quaternion, yaw_quaternion

FLAT = 0.04  # height of an ellipse, m
SEE_THROUGH = 0.4  # opacity of what has an inside
TEXT_SIZE, TEXT_GAP = 12.0, 0.3  # pixels; m above what it names
UP = np.array([0.0, 0.0, 1.0])
HEAD = 0.25  # of an arrow's length
ALL, LINE_STRIP, FLOAT32 = 1, 0, 7

Message = dict[str, Any]
Flat = Cubes | Lines | Arrows | Ellipses | Marks
IDENTITY = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def nanoseconds(drawing: Drawing) -> int:
    """Its time, to the microsecond (seconds since 1970 are no finer); what is always there is there from 0."""
    return 1000 * round(1e6 * (drawing.time or 0.0))


def foxglove_message(drawing: Drawing) -> tuple[str, Message]:
    """The name of its schema, and the message."""
    shape = drawing.shape
    if isinstance(shape, Pose):
        return FRAME_TRANSFORMS, _transform(drawing, shape)
    if isinstance(shape, Points):
        return POINT_CLOUD, _cloud(drawing, shape)
    return SCENE_UPDATE, _update(drawing, shape)


def _update(drawing: Drawing, shape: Flat) -> Message:
    stamp = _stamp(drawing)
    return {
        "deletions": [{"timestamp": stamp, "type": ALL, "id": ""}],
        "entities": [
            {
                "timestamp": stamp,
                "frame_id": drawing.frame,
                "id": name,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": drawing.time is None,
                "metadata": [{"key": key, "value": value} for key, value in facts.items()],
                **{kind: primitives.get(kind, []) for kind in _KINDS},
            }
            for name, facts, primitives in _entities(drawing.name, shape)
        ],
    }


_KINDS = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
Entity = tuple[str, dict[str, str], dict[str, list[Message]]]
"""Id, facts, primitives by kind."""


def _entities(layer: str, shape: Flat) -> list[Entity]:
    match shape:
        case Cubes():
            cubes = _solids(shape.centre, shape.size, shape.yaw, shape.colour)
            if not shape.facts:
                return [(layer, {}, {"cubes": cubes})]
            above = shape.centre + UP * (shape.size / 2 + TEXT_GAP)
            facts = [dict(zip(shape.facts, row, strict=True)) for row in zip(*shape.facts.values(), strict=True)]
            texts = _texts(above, shape.labels, shape.colour)
            return [
                (next(iter(known.values())), known, {"cubes": [cube], "texts": [text]})
                for known, cube, text in zip(facts, cubes, texts, strict=True)
            ]
        case Ellipses():
            size = np.column_stack([2 * shape.half, np.full(len(shape.half), FLAT)])
            return [(layer, {}, {"spheres": _solids(shape.centre, size, shape.yaw, shape.colour)})]
        case Marks():
            places, side = len(shape.place), 2 * shape.radius
            balls = _solids(shape.place, np.full((places, 3), side), np.zeros(places), shape.colour)
            texts = _texts(shape.place + TEXT_GAP * UP, shape.names, shape.colour)
            return [(layer, {}, {"spheres": balls, "texts": texts})]
        case Lines():
            return [(layer, {}, {"lines": _lines(shape)})]
        case Arrows():
            return [(layer, {}, {"arrows": _arrows(shape)})]
    assert_never(shape)


def _solids(centre: FloatArray, size: FloatArray, yaw: FloatArray, colour: IntArray) -> list[Message]:
    poses, sizes, colours = _poses(centre, yaw), _xyz(size), _colours(colour, len(centre), SEE_THROUGH)
    return [{"pose": p, "size": s, "color": c} for p, s, c in zip(poses, sizes, colours, strict=True)]


def _texts(place: FloatArray, texts: Sequence[str], colour: IntArray) -> list[Message]:
    poses, colours = _poses(place, np.zeros(len(place))), _colours(colour, len(place))
    look = {"billboard": True, "font_size": TEXT_SIZE, "scale_invariant": True}
    return [{"pose": p, **look, "color": c, "text": t} for p, c, t in zip(poses, colours, texts, strict=True)]


def _lines(shape: Lines) -> list[Message]:
    count = len(shape.strips)
    thickness = np.broadcast_to((2 * shape.radius).round(3), (count,)).tolist()
    return [
        {
            "type": LINE_STRIP,
            "pose": IDENTITY,
            "thickness": thick,
            "scale_invariant": False,
            "points": _xyz(strip),
            "color": colour,
            "colors": [],
            "indices": [],
        }
        for strip, thick, colour in zip(shape.strips, thickness, _colours(shape.colour, count), strict=True)
    ]


def _arrows(shape: Arrows) -> list[Message]:
    length = np.hypot(*shape.vector.T)
    poses = _poses(shape.tail, np.arctan2(shape.vector[:, 1], shape.vector[:, 0]))
    return [
        {
            "pose": pose,
            "shaft_length": (1 - HEAD) * long,
            "shaft_diameter": 2 * shape.radius,
            "head_length": HEAD * long,
            "head_diameter": 4 * shape.radius,
            "color": colour,
        }
        for pose, long, colour in zip(poses, length.round(3).tolist(), _colours(shape.colour, len(length)), strict=True)
    ]


def _transform(drawing: Drawing, pose: Pose) -> Message:
    matrix = pose.parent_T_child
    (translation,), (rotation,) = _xyz(matrix[None, :3, 3]), _quaternions(rotation_quaternion(matrix[None, :3, :3]), 9)
    names = {"parent_frame_id": drawing.frame, "child_frame_id": drawing.path}
    return {"transforms": [{"timestamp": _stamp(drawing), **names, "translation": translation, "rotation": rotation}]}


def _cloud(drawing: Drawing, cloud: Points) -> Message:
    return {
        "timestamp": _stamp(drawing),
        "frame_id": drawing.frame,
        "pose": IDENTITY,
        "point_stride": 12,
        "fields": [{"name": name, "offset": 4 * k, "type": FLOAT32} for k, name in enumerate("xyz")],
        "data": base64.b64encode(cloud.points.astype("<f4").tobytes()).decode("ascii"),
    }


def _stamp(drawing: Drawing) -> Message:
    sec, nsec = divmod(nanoseconds(drawing), 10**9)
    return {"sec": sec, "nsec": nsec}


def _poses(place: FloatArray, yaw: FloatArray) -> list[Message]:
    turns = _quaternions(yaw_quaternion(yaw), 5)
    return [{"position": p, "orientation": q} for p, q in zip(_xyz(place), turns, strict=True)]


def _xyz(rows: FloatArray) -> list[Message]:
    """Vectors (N, 3), to the millimetre."""
    return [{"x": x, "y": y, "z": z} for x, y, z in rows.round(3).tolist()]


def _quaternions(rows: FloatArray, digits: int) -> list[Message]:
    """Quaternions (N, 4), (w, x, y, z)."""
    return [{"x": x, "y": y, "z": z, "w": w} for w, x, y, z in rows.round(digits).tolist()]


def _colours(colour: IntArray, count: int, opacity: float = 1.0) -> list[Message]:
    rows = np.broadcast_to((colour / 255).round(3), (count, 3)).tolist()
    return [{"r": r, "g": g, "b": b, "a": opacity} for r, g, b in rows]
