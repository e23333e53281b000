"""The bicycle racks of nuScenes: annotated boxes in which the official evaluation scores no bicycle or motorcycle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from data_tools.datasets.nuscenes.scenes import SceneRecord
from data_tools.datasets.nuscenes.tables import read_table
from data_tools.files.error_messages import error_context
from saga_fg.numerics.arrays import checked
from saga_fg.numerics.geometry import checked_quaternions, quaternion_yaw
from saga_fg.types.boxes import Boxes

CATEGORY = "static_object.bicycle_rack"


def read_bicycle_racks(folder: Path, scenes: Mapping[str, SceneRecord]) -> dict[str, list[Boxes]]:
    """The racks of each scene, one entry a sample. Raises `InputError` for missing tables and broken records."""
    category = {token for token, name in read_table(folder, "category", ("token", "name")) if name == CATEGORY}
    racks = {token for token, kind in read_table(folder, "instance", ("token", "category_token")) if kind in category}
    found: dict[str, list[tuple[list[float], list[float], list[float]]]] = {
        token: [] for scene in scenes.values() for token in scene.tokens
    }
    if racks:
        fields = ("sample_token", "instance_token", "translation", "size", "rotation")
        for sample, instance, *box in read_table(folder, "sample_annotation", fields):
            if instance in racks and sample in found:
                found[sample].append((box[0], box[1], box[2]))
    path = folder / "sample_annotation.json"
    result: dict[str, list[Boxes]] = {}
    for name, scene in scenes.items():
        result[name] = []
        for token in scene.tokens:
            with error_context(f"{path}: sample {token}, {CATEGORY}"):
                result[name].append(_boxes(found[token]))
    return result


def _boxes(rows: list[tuple[list[float], list[float], list[float]]]) -> Boxes:
    if not rows:
        return Boxes.empty()
    position, size, rotation = zip(*rows, strict=True)
    width_length_height = checked("size", size, (None, 3))
    return Boxes.of(
        ["bicycle_rack"] * len(rows),
        position,
        width_length_height[:, [1, 0, 2]],
        quaternion_yaw(checked_quaternions("rotation", rotation)),
    )
