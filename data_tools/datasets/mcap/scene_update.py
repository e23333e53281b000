"""Foxglove's `SceneUpdate`: an entity is an object if it has a cube, a cylinder or a sphere, of which the first counts.

Class and score are taken from the metadata (the first of `class`, `label`, `category`, `type`; of `score`,
`confidence`, `probability`), the class else from the first text, the velocity from `vx` and `vy`. Every message shows
all objects of its time. Results are `foxglove.SceneUpdate` in protobuf, with the same metadata and `id`.

Source: https://docs.foxglove.dev/docs/sdk/schemas/scene-update.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_tools.datasets.mcap import objects as ros
from data_tools.datasets.mcap.objects import NAN, NO_COVARIANCE, ObjectRows, frame_name, nanoseconds, wxyz, xyz
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import upper_triangle
from saga_fg.types.track import Tracks

TYPES = ("foxglove.SceneUpdate", "foxglove_msgs/SceneUpdate")
RESULT = "foxglove.SceneUpdate"
FIELDS = {
    "position": "object {}: pose.position",
    "rotation": "object {}: pose.orientation",
    "covariance": "object {}: metadata: cov_xx, cov_xy, cov_yy",
    "size": "object {}: size",
    "score": "object {}: metadata: score",
    "velocity": "object {}: metadata: vx, vy",
    "velocity_covariance": "object {}: metadata: cov_vxvx, cov_vxvy, cov_vyvy",
}
_CLASS, _SCORE = ("class", "label", "category", "type"), ("score", "confidence", "probability")
_POSITION, _VELOCITY = ("cov_xx", "cov_xy", "cov_yy"), ("cov_vxvx", "cov_vxvy", "cov_vyvy")
_COLOUR = {"r": 0.1, "g": 0.45, "b": 0.9, "a": 0.5}
_TEXT_GAP = 0.4  # m above the box


def rows(message: Any) -> ObjectRows:
    """The objects of a message. Raises `InputError` for entities in several frames."""
    objects = [each for each in message.entities if _solid(each) is not None]
    stamps = [nanoseconds(each.timestamp) for each in (*objects, *message.deletions)]
    frames = list(dict.fromkeys(frame_name(each.frame_id) for each in objects))
    if len(frames) > 1:
        raise InputError(f"entities: expected all in one frame, got {', '.join(frames)}")
    found = ObjectRows(max(stamps, default=0), frames[0] if frames else "", FIELDS)
    for k, each in enumerate(objects):
        solid, facts = _solid(each), {fact.key.lower(): fact.value for fact in each.metadata}
        text = each.texts[0].text if len(each.texts) else ""
        found.id.append(facts.get("id", each.id))
        found.label.append(next((facts[name] for name in _CLASS if name in facts), text))
        found.score.append(_number(facts, k, next((name for name in _SCORE if name in facts), ""), 1.0))
        found.position.append(xyz(solid.pose.position))
        found.rotation.append(wxyz(solid.pose.orientation))
        found.heading.append(True)
        found.size.append(xyz(solid.size))
        found.velocity.append((_number(facts, k, "vx"), _number(facts, k, "vy"), 0.0))
        found.covariance.append(_entries([_number(facts, k, name) for name in _POSITION]))
        found.velocity_covariance.append(_entries([_number(facts, k, name) for name in _VELOCITY]))
    return found


def result(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> Any:
    """A `SceneUpdate` of tracks: a cube, a text and metadata for each."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    seconds, nanoseconds_ = divmod(stamp, 10**9)
    time, boxes = {"timestamp": {"seconds": seconds, "nanos": nanoseconds_}}, tracks.boxes
    columns = np.column_stack(
        [
            tracks.score,
            boxes.velocity,
            upper_triangle(tracks.position_covariance),
            upper_triangle(tracks.velocity_covariance),
        ]
    )
    entities: list[Any] = []
    for k, (id_, label) in enumerate(zip(tracks.id.tolist(), boxes.label.tolist(), strict=True)):
        keys = ("score", "vx", "vy", *_POSITION, *_VELOCITY)
        known = {key: f"{value:.6g}" for key, value in zip(keys, columns[k].tolist(), strict=True) if value == value}
        facts = {"id": str(id_), "class": names.get(label, label), **known}
        if not tracks.settled[k]:
            facts["settled"] = "0"
        size = np.where(np.isfinite(boxes.size[k]), boxes.size[k], 0.5)
        above = boxes.position[k] + [0, 0, size[2] / 2 + _TEXT_GAP]
        text = {"pose": ros.pose(above, 0.0), "billboard": True, "font_size": 12.0, "scale_invariant": True}
        entities.append(
            {
                **time,
                "frame_id": frame,
                "id": f"track {id_}",
                "metadata": [{"key": key, "value": value} for key, value in facts.items()],
                "cubes": [
                    {"pose": ros.pose(boxes.position[k], boxes.yaw[k]), "size": ros.vector(size), "color": _COLOUR}
                ],
                "texts": [{**text, "color": {**_COLOUR, "a": 1.0}, "text": f"{facts['class']} {id_}"}],
            }
        )
    deletions: list[Any] = [{**time, "type": 1}]
    return SceneUpdate(deletions=deletions, entities=entities)


def _solid(entity: Any) -> Any:
    """The first cube, cylinder or sphere of an entity; None for lines, arrows and others."""
    return next((solids[0] for solids in (entity.cubes, entity.cylinders, entity.spheres) if len(solids)), None)


def _number(facts: Mapping[str, str], row: int, name: str, default: float = NAN) -> float:
    if name not in facts:
        return default
    try:
        return float(facts[name])
    except ValueError:
        raise InputError(f"object {row}: metadata: {name}: expected a number, got {facts[name][:40]!r}") from None


def _entries(upper: list[float]) -> tuple[float, ...]:
    """The 36 entries of a covariance by those of its horizontal part: xx, xy, yy."""
    xx, xy, yy = upper
    return (xx, xy, *NO_COVARIANCE[2:6], xy, yy, *NO_COVARIANCE[8:])
