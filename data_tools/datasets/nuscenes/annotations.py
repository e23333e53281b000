"""Ground truth of nuScenes: annotated boxes of the seven tracking classes at every sample.

Velocity is the central difference of the neighbouring annotations of the same instance, and unknown where they lie
more than 1.5 s per side apart, as in `NuScenes.box_velocity` of the development kit.

An object counts as visible if some LiDAR or radar point lies in its box; the official evaluation leaves out the others.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_tools.datasets.central_differences import central_differences
from data_tools.datasets.nuscenes.classes import CATEGORY_TO_TRACKING_CLASS
from data_tools.datasets.nuscenes.scenes import SceneRecord
from data_tools.datasets.nuscenes.tables import read_table
from data_tools.files.error_messages import error_context
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import checked_quaternions, quaternion_yaw
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations

MAX_GAP = 1.5  # s between an annotation and its neighbour, for a velocity

_FIELDS = ("sample_token", "instance_token", "translation", "size", "rotation", "num_lidar_pts", "num_radar_pts")


def read_annotations(folder: Path, scenes: Mapping[str, SceneRecord]) -> dict[str, list[Annotations]]:
    """The annotations of each scene, one entry a sample. Raises `InputError` for missing tables and broken records."""
    classes = _instance_classes(folder)
    moments = {t: (name, k) for name, scene in scenes.items() for k, t in enumerate(scene.tokens)}
    rows = {name: _Rows() for name in scenes}
    path = folder / "sample_annotation.json"
    for sample, instance, translation, size, rotation, lidar, radar in read_table(folder, "sample_annotation", _FIELDS):
        if sample not in moments:
            continue
        if instance not in classes:
            raise InputError(f"{path}: sample {sample}: instance_token: expected an instance, {instance!r} is none")
        label = classes[instance]
        if label is not None:
            name, k = moments[sample]
            try:
                numbers = (*translation, *size, *rotation)
                if (len(translation), len(size), len(rotation)) != (3, 3, 4):
                    raise TypeError("lengths")
                rows[name].add(k, instance, label, numbers, lidar + radar)
            except (TypeError, OverflowError) as error:
                where = f"{path}: sample {sample}, instance {instance}"
                raise InputError(f"{where}: expected 3, 3 and 4 numbers as translation, size, rotation") from error
    result = {}
    for name, scene in scenes.items():
        with error_context(f"{path}: scene {name}"):
            result[name] = rows[name].annotations(scene)
    return result


def _instance_classes(folder: Path) -> dict[str, str | None]:
    """The tracking class of every instance, None for the categories that are not tracked."""
    names = dict(read_table(folder, "category", ("token", "name")))
    classes: dict[str, str | None] = {}
    for token, category in read_table(folder, "instance", ("token", "category_token")):
        if category not in names:
            raise InputError(f"{folder / 'instance.json'}: record {token}: expected a category, {category!r} is none")
        classes[token] = CATEGORY_TO_TRACKING_CLASS.get(names[category])
    return classes


@dataclass
class _Rows:
    """Annotations of one scene, packed: sample index, instance, class, ten numbers, number of points."""

    sample: array[int] = field(default_factory=lambda: array("q"))
    instance: list[str] = field(default_factory=list)
    label: list[str] = field(default_factory=list)
    numbers: array[float] = field(default_factory=lambda: array("d"))
    points: array[int] = field(default_factory=lambda: array("q"))

    def add(self, sample: int, instance: str, label: str, numbers: tuple[float, ...], points: int) -> None:
        self.sample.append(sample)
        self.instance.append(instance)
        self.label.append(label)
        self.numbers.extend(numbers)
        self.points.append(points)

    def annotations(self, scene: SceneRecord) -> list[Annotations]:
        sample = np.array(self.sample, dtype=np.int64)
        instance = np.array(self.instance, dtype=np.str_)
        label = np.array(self.label, dtype=np.str_)
        numbers = np.array(self.numbers).reshape(-1, 10)
        visible = np.array(self.points, dtype=np.int64) > 0
        boxes = Boxes(
            label=label,
            position=numbers[:, :3],
            size=numbers[:, [4, 3, 5]],
            yaw=quaternion_yaw(checked_quaternions("rotation", numbers[:, 6:])),
            velocity=central_differences(instance, scene.timestamps[sample], numbers[:, :2], MAX_GAP),
        )
        order = np.argsort(sample, kind="stable")
        bounds = np.searchsorted(sample[order], np.arange(len(scene.tokens) + 1))
        result = []
        for token, first, last in zip(scene.tokens, bounds[:-1], bounds[1:], strict=True):
            chosen = order[first:last]
            with error_context(f"sample {token}"):
                result.append(Annotations(instance[chosen], boxes.select(chosen), visible[chosen]))
        return result
