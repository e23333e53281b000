"""The moments of a nuScenes scene and their annotated boxes.

The moments: its samples in order, their times, and the poses of the vehicle.

A scene is a chain of samples (keyframes at 2 Hz), from `first_sample_token` along `next`. The pose of the vehicle at a
sample is the `ego_pose` of its LIDAR_TOP keyframe, as in the official evaluation.

Ground truth of nuScenes: annotated boxes of the seven tracking classes at every sample.

Velocity is the central difference of the neighbouring annotations of the same instance, and unknown where they lie
more than 1.5 s per side apart, as in `NuScenes.box_velocity` of the development kit.

An object counts as visible if some LiDAR or radar point lies in its box; the official evaluation leaves out the others.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Container, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_tools.datasets.central_differences import central_differences
from data_tools.datasets.nuscenes.tables import CATEGORY_TO_TRACKING_CLASS, read_table
from data_tools.files.input_files import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
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
    pose_of = {sample: pose for sample, _, _, pose in keyframes(folder, (LIDAR,), wanted, "ego_pose_token")}
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


def keyframes(
    folder: Path, channels: Collection[str], wanted: Container[str], field: str
) -> Iterator[tuple[str, str, str, Any]]:
    """The `sample_data` of keyframes: sample (of `wanted`), channel, calibrated sensor, and a field of the record."""
    named = {token: name for token, name in read_table(folder, "sensor", ("token", "channel")) if name in channels}
    mounts = read_table(folder, "calibrated_sensor", ("token", "sensor_token"))
    mounted = {token: named[sensor] for token, sensor in mounts if sensor in named}
    fields = ("sample_token", "calibrated_sensor_token", "is_key_frame", field)
    for sample, sensor, key, value in read_table(folder, "sample_data", fields):
        if key and sensor in mounted and sample in wanted:
            yield sample, mounted[sensor], sensor, value


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


def read_annotations(
    folder: Path, scenes: Mapping[str, SceneRecord], class_of: Mapping[str, str] = CATEGORY_TO_TRACKING_CLASS
) -> dict[str, list[Annotations]]:
    """The annotations of each scene, one entry a sample, of the categories that have a class.

    Raises `InputError` for missing tables and broken records.
    """
    classes = _instance_classes(folder, class_of)
    moments = {t: (name, k) for name, scene in scenes.items() for k, t in enumerate(scene.tokens)}
    rows = {name: _Rows([], array("d")) for name in scenes}
    path = folder / "sample_annotation.json"
    for sample, instance, translation, size, rotation, lidar, radar in read_table(folder, "sample_annotation", _FIELDS):
        if sample not in moments:
            continue
        if instance not in classes:
            raise InputError(f"{path}: sample {sample}: instance_token: expected an instance, {instance!r} is none")
        if (label := classes[instance]) is None:
            continue
        name, k = moments[sample]
        try:
            if (len(translation), len(size), len(rotation)) != (3, 3, 4):
                raise TypeError("lengths")
            rows[name].numbers.extend((*translation, *size, *rotation))
            rows[name].names.append((k, instance, label, int(lidar + radar)))
        except (TypeError, OverflowError) as error:
            where = f"{path}: sample {sample}, instance {instance}"
            raise InputError(f"{where}: expected 3, 3 and 4 numbers as translation, size, rotation") from error
    result = {}
    for name, scene in scenes.items():
        with error_context(f"{path}: scene {name}"):
            result[name] = rows[name].annotations(scene)
    return result


def _instance_classes(folder: Path, class_of: Mapping[str, str]) -> dict[str, str | None]:
    """The class of every instance, None for the categories that have none."""
    names = dict(read_table(folder, "category", ("token", "name")))
    classes: dict[str, str | None] = {}
    for token, category in read_table(folder, "instance", ("token", "category_token")):
        if category not in names:
            raise InputError(f"{folder / 'instance.json'}: record {token}: expected a category, {category!r} is none")
        classes[token] = class_of.get(names[category])
    return classes


class _Rows(NamedTuple):
    """Annotations of one scene: index of the sample, instance, class, number of points; and ten numbers of each."""

    names: list[tuple[int, str, str, int]]
    numbers: array[float]

    def annotations(self, scene: SceneRecord) -> list[Annotations]:
        index, instances, labels, points = zip(*self.names, strict=True) if self.names else ((), (), (), ())
        sample, instance = np.array(index, dtype=np.int64), np.array(instances, dtype=np.str_)
        visible = np.array(points, dtype=np.int64) > 0
        numbers = np.array(self.numbers).reshape(-1, 10)
        boxes = Boxes(
            label=np.array(labels, dtype=np.str_),
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
