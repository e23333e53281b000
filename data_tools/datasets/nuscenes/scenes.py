"""The moments of a nuScenes scene: its samples in order, their times, and the poses of the vehicle.

A scene is a chain of samples (keyframes at 2 Hz), from `first_sample_token` along `next`. The pose of the vehicle at a
sample is the `ego_pose` of its LIDAR_TOP keyframe, as in the official evaluation.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.nuscenes.tables import read_table
from data_tools.files.error_messages import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import checked_quaternions, checked_transform, quaternion_rotation

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
