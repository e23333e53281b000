"""The moments of a nuScenes scene: times, poses, annotated boxes, bicycle racks.

The moments of a nuScenes scene: its samples in order, their times, and the poses of the vehicle.

A scene is a chain of samples (keyframes at 2 Hz), from `first_sample_token` along `next`. The pose of the vehicle at a
sample is the `ego_pose` of its LIDAR_TOP keyframe, as in the official evaluation.

Ground truth of nuScenes: annotated boxes of the seven tracking classes at every sample.

Velocity is the central difference of the neighbouring annotations of the same instance, and unknown where they lie
more than 1.5 s per side apart, as in `NuScenes.box_velocity` of the development kit.

An object counts as visible if some LiDAR or radar point lies in its box; the official evaluation leaves out the others.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.central_differences import central_differences
from data_tools.datasets.nuscenes.tables import CATEGORY_TO_TRACKING_CLASS, read_table
from data_tools.files.input_files import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import checked_quaternions, checked_transform, quaternion_rotation, quaternion_yaw
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations

LIDAR = "LIDAR_TOP"


@dataclass(frozen=True, eq=False)
class SceneRecord:
    """name; tokens of its K samples; timestamps (K,) in s; world_T_ego (K, 4, 4)."""

    name: str
    tokens: tuple[str, ...]
    timestamps: FloatArray
    world_T_ego: FloatArray


@dataclass(frozen=True, eq=False)
class SceneTables:
    """The chosen scenes by name, and the tokens of all samples of all scenes."""

    records: dict[str, SceneRecord]
    all_samples: frozenset[str]


def read_scenes(folder: Path, names: Collection[str] | None) -> SceneTables:
    """Read the chosen scenes (None: all). Raises `InputError` for unknown names and broken records."""
    scenes = {name: (first, count) for name, first, count in _scene_rows(folder)}
    chosen = tuple(scenes) if names is None else tuple(dict.fromkeys(names))
    for name in chosen:
        if name not in scenes:
            raise InputError(f"{folder / 'scene.json'}: {unknown_name('scene', name, tuple(scenes))}")
    samples: dict[str, tuple[Any, str]] = {}
    for token, time, after in read_table(folder, "sample", ("token", "timestamp", "next")):
        if token in samples:
            raise InputError(f"{folder / 'sample.json'}: record {token}: expected every token once, it occurs again")
        samples[token] = (time, after)
    chains = {name: _chain(folder, name, *scenes[name], samples) for name in chosen}
    times = {name: _times(folder, chain, samples) for name, chain in chains.items()}
    poses = _poses(folder, {token for chain in chains.values() for token in chain})
    records = {
        name: SceneRecord(name, chain, times[name], np.array([poses[token] for token in chain]).reshape(-1, 4, 4))
        for name, chain in chains.items()
    }
    return SceneTables(records, frozenset(samples))


def _scene_rows(folder: Path) -> list[tuple[Any, ...]]:
    rows = list(read_table(folder, "scene", ("name", "first_sample_token", "nbr_samples")))
    seen: set[str] = set()
    for name, _, count in rows:
        if not name or name in seen:
            raise InputError(f"{folder / 'scene.json'}: name: expected unique scene names, got {name!r}")
        if not isinstance(count, int):
            raise InputError(f"{folder / 'scene.json'}: scene {name}: nbr_samples: expected a number, got {count!r}")
        seen.add(name)
    return rows


def _chain(folder: Path, scene: str, first: str, count: int, samples: dict[str, tuple[Any, str]]) -> tuple[str, ...]:
    """The samples of a scene in the order of the tables' links."""
    chain: list[str] = []
    token = first
    while token != "":
        if token not in samples:
            raise InputError(f"{folder / 'sample.json'}: scene {scene}: expected a sample {token!r}, there is none")
        if len(chain) == count:
            raise InputError(f"{folder / 'sample.json'}: scene {scene}: expected {count} samples, the chain goes on")
        chain.append(token)
        token = samples[token][1]
    if len(chain) != count:
        raise InputError(f"{folder / 'sample.json'}: scene {scene}: expected {count} samples, got {len(chain)}")
    return tuple(chain)


def _times(folder: Path, chain: tuple[str, ...], samples: dict[str, tuple[Any, str]]) -> FloatArray:
    times = [samples[token][0] for token in chain]
    for k, (token, time) in enumerate(zip(chain, times, strict=True)):
        where = f"{folder / 'sample.json'}: record {token}: timestamp"
        if not isinstance(time, int) or not 0 <= time < 2**53:
            raise InputError(f"{where}: expected a whole number of microseconds, got {time!r}")
        if k and time <= times[k - 1]:
            what = "repeats" if time == times[k - 1] else "runs backwards"
            raise InputError(f"{where}: expected a later time than the sample before, time {what} at {time} us")
    return np.array(times, dtype=np.float64) * 1e-6


def _poses(folder: Path, wanted: Collection[str]) -> dict[str, FloatArray]:
    """world_T_ego (4, 4) of each sample at its LIDAR_TOP keyframe."""
    lidars = {token for token, channel in read_table(folder, "sensor", ("token", "channel")) if channel == LIDAR}
    mounted = {
        token
        for token, sensor in read_table(folder, "calibrated_sensor", ("token", "sensor_token"))
        if sensor in lidars
    }
    fields = ("sample_token", "ego_pose_token", "calibrated_sensor_token", "is_key_frame")
    pose_of = {
        sample: pose
        for sample, pose, sensor, key in read_table(folder, "sample_data", fields)
        if key and sensor in mounted and sample in wanted
    }
    missing = next((token for token in wanted if token not in pose_of), None)
    if missing is not None:
        raise InputError(f"{folder / 'sample_data.json'}: sample {missing}: expected a {LIDAR} keyframe, there is none")
    needed = set(pose_of.values())
    poses = {
        token: _pose(folder, token, translation, rotation)
        for token, translation, rotation in read_table(folder, "ego_pose", ("token", "translation", "rotation"))
        if token in needed
    }
    for sample, pose in pose_of.items():
        if pose not in poses:
            raise InputError(f"{folder / 'ego_pose.json'}: expected pose {pose!r} of sample {sample}, there is none")
    return {sample: poses[pose] for sample, pose in pose_of.items()}


def _pose(folder: Path, token: str, translation: Any, rotation: Any) -> FloatArray:
    with error_context(f"{folder / 'ego_pose.json'}: record {token}"):
        return rigid_transform(translation, rotation)


def rigid_transform(translation: Any, rotation: Any) -> FloatArray:
    """The (4, 4) transform of a record: translation in m, rotation a quaternion (w, x, y, z).

    Raises `InputError` for anything but three and four finite numbers.
    """
    transform = np.eye(4)
    transform[:3, :3] = quaternion_rotation(checked_quaternions("rotation", [rotation]))[0]
    try:
        transform[:3, 3] = translation
    except (TypeError, ValueError) as error:
        raise InputError(f"translation: expected three numbers in m, got {translation!r}") from error
    return checked_transform("pose", transform)


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
