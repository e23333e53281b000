"""Drawings as files of MCAP (https://mcap.dev) for Foxglove, and for other readers of its messages.

A pose is a `FrameTransforms`, points without names a `PointCloud` of float32 x, y, z, every other shape a `SceneUpdate`
that first deletes all its layer showed before: each message is complete, so that playback may begin anywhere. Solids
with facts are an entity each, named by the first fact and with all of them as metadata; other shapes are one entity.

The path of a drawing is the topic of its messages, its frame the message's. Messages are protobuf with the fields that
Foxglove publishes (https://docs.foxglove.dev/docs/sdk/schemas); times are nanoseconds from the scene's start.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, assert_never

import numpy as np

from data_tools.files.atomic_files import atomic_file, check_writable
from pipelines.view.scenes import Arrows, Drawing, Lines, Points, Pose, Solids
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import rotation_quaternion, yaw_quaternion

OPACITY = 0.4  # of solids
TEXT_SIZE, TEXT_GAP = 12.0, 0.3  # pixels; m above the named thing
UP = np.array([0.0, 0.0, 1.0])
HEAD = 0.25  # of an arrow's length

Fields = dict[str, Any]
"""Fields of a message by name; those left out have protobuf's defaults."""
IDENTITY: Fields = {"position": {}, "orientation": {"w": 1.0}}


def load_mcap() -> Any:
    """The class that writes messages. Raises `MissingExtraError` where its packages are not installed."""
    try:
        import foxglove_schemas_protobuf  # noqa: F401
        from mcap_protobuf.writer import Writer
    except ImportError as error:
        raise MissingExtraError('files for Foxglove need mcap; pip install "saga-fg[mcap]"') from error
    return Writer


def write_view(path: Path, drawings: Iterable[Drawing]) -> None:
    """Write drawings in order of time to a file, whole or not at all.

    Raises `InputError` where the file cannot be written, `MissingExtraError` without mcap.
    """
    with atomic_file(path) as file:
        writer = load_mcap()(file)
        for each in drawings:
            time = _nanoseconds(each)
            writer.write_message(f"/{each.path}", _message(each), log_time=time, publish_time=time)
        writer.finish()


def _nanoseconds(drawing: Drawing) -> int:
    """Time to the microsecond (seconds since 1970 are no finer); 0 for static drawings."""
    return 1000 * round(1e6 * (drawing.time or 0.0))


def _message(drawing: Drawing) -> Any:
    """A `FrameTransforms`, `PointCloud` or `SceneUpdate`."""
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    shape = drawing.shape
    seconds, nanoseconds = divmod(_nanoseconds(drawing), 10**9)
    fields: Fields
    stamp: Fields = {"timestamp": {"seconds": seconds, "nanos": nanoseconds}}
    if isinstance(shape, Pose):
        matrix = shape.parent_T_child[None]
        (translation,), (rotation,) = _xyz(matrix[:, :3, 3]), _quaternions(rotation_quaternion(matrix[:, :3, :3]), 9)
        frames = {"parent_frame_id": drawing.frame, "child_frame_id": drawing.path}
        fields = {"transforms": [{**stamp, **frames, "translation": translation, "rotation": rotation}]}
        return FrameTransforms(**fields)
    if isinstance(shape, Points) and shape.names is None:
        xyz = [{"name": name, "offset": 4 * k, "type": PackedElementField.FLOAT32} for k, name in enumerate("xyz")]
        points = shape.points.astype("<f4").tobytes()
        fields = {"frame_id": drawing.frame, "pose": IDENTITY, "point_stride": 12, "fields": xyz, "data": points}
        return PointCloud(**stamp, **fields)
    common = {**stamp, "frame_id": drawing.frame, "frame_locked": drawing.time is None}
    fields = {
        "deletions": [{**stamp, "type": SceneEntityDeletion.ALL}],
        "entities": [{**common, **entity} for entity in _entities(drawing.name, shape)],
    }
    return SceneUpdate(**fields)


def _entities(layer: str, shape: Solids | Lines | Arrows | Points) -> list[Fields]:
    """Identifiers, metadata and primitives of a shape's entities."""
    match shape:
        case Solids():
            kind = "spheres" if shape.round else "cubes"
            solids = _solids(shape.centre, shape.size, shape.yaw, shape.colour)
            if not shape.facts:
                return [{"id": layer, kind: solids}]
            texts = _texts(shape.centre + UP * (shape.size / 2 + TEXT_GAP), shape.labels, shape.colour)
            return [
                {
                    "id": row[0],
                    "metadata": [{"key": key, "value": value} for key, value in zip(shape.facts, row, strict=True)],
                    kind: [solid],
                    "texts": [text],
                }
                for row, solid, text in zip(zip(*shape.facts.values(), strict=True), solids, texts, strict=True)
            ]
        case Points():
            size, yaw = np.full(shape.points.shape, 2 * shape.radius), np.zeros(len(shape.points))
            texts = _texts(shape.points + TEXT_GAP * UP, shape.names or (), shape.colour)
            return [{"id": layer, "spheres": _solids(shape.points, size, yaw, shape.colour), "texts": texts}]
        case Lines():
            return [{"id": layer, "lines": _lines(shape)}]
        case Arrows():
            return [{"id": layer, "arrows": _arrows(shape)}]
    assert_never(shape)


def _solids(centre: FloatArray, size: FloatArray, yaw: FloatArray, colour: IntArray) -> list[Fields]:
    poses, sizes, colours = _poses(centre, yaw), _xyz(size), _mcap_colours(colour, len(centre), OPACITY)
    return [{"pose": p, "size": s, "color": c} for p, s, c in zip(poses, sizes, colours, strict=True)]


def _texts(place: FloatArray, texts: Sequence[str], colour: IntArray) -> list[Fields]:
    poses, colours = _poses(place, np.zeros(len(place))), _mcap_colours(colour, len(place))
    look = {"billboard": True, "font_size": TEXT_SIZE, "scale_invariant": True}
    return [{"pose": p, **look, "color": c, "text": t} for p, c, t in zip(poses, colours, texts, strict=True)]


def _lines(shape: Lines) -> list[Fields]:
    """Line strips, the first type of line and so the default."""
    count = len(shape.strips)
    thickness = np.broadcast_to((2 * shape.radius).round(3), (count,)).tolist()
    return [
        {"pose": IDENTITY, "thickness": thick, "points": _xyz(strip), "color": colour}
        for strip, thick, colour in zip(shape.strips, thickness, _mcap_colours(shape.colour, count), strict=True)
    ]


def _arrows(shape: Arrows) -> list[Fields]:
    length = np.hypot(*shape.vector.T)
    poses = _poses(shape.tail, np.arctan2(shape.vector[:, 1], shape.vector[:, 0]))
    diameters = {"shaft_diameter": 2 * shape.radius, "head_diameter": 4 * shape.radius}
    return [
        {"pose": pose, "shaft_length": (1 - HEAD) * long, "head_length": HEAD * long, **diameters, "color": colour}
        for pose, long, colour in zip(
            poses, length.round(3).tolist(), _mcap_colours(shape.colour, len(length)), strict=True
        )
    ]


def _poses(place: FloatArray, yaw: FloatArray) -> list[Fields]:
    turns = _quaternions(yaw_quaternion(yaw), 5)
    return [{"position": p, "orientation": q} for p, q in zip(_xyz(place), turns, strict=True)]


def _xyz(rows: FloatArray) -> list[Fields]:
    """Vectors (N, 3), to the millimetre."""
    return [{"x": x, "y": y, "z": z} for x, y, z in rows.round(3).tolist()]


def _quaternions(rows: FloatArray, digits: int) -> list[Fields]:
    """Quaternions (N, 4), (w, x, y, z)."""
    return [{"x": x, "y": y, "z": z, "w": w} for w, x, y, z in rows.round(digits).tolist()]


def _mcap_colours(colour: IntArray, count: int, opacity: float = 1.0) -> list[Fields]:
    rows = np.broadcast_to((colour / 255).round(3), (count, 3)).tolist()
    return [{"r": r, "g": g, "b": b, "a": opacity} for r, g, b in rows]


def check_view_file(path: Path) -> None:
    """Check the suffix, the package and the folder of a file for `write_view`.

    Raises `InputError` and `MissingExtraError`, before long work and not after it.
    """
    if path.suffix != ".mcap":
        raise InputError(f"{path}: expected a file name that ends in .mcap")
    load_mcap()
    check_writable(path)
