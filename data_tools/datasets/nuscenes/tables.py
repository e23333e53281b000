"""The tables of nuScenes: flat records joined by tokens, splits, classes, scenes, annotations, and records to write.

A table is a file with an array of flat records, joined to others by tokens.

Schema: https://www.nuscenes.org/nuscenes#data-format. The tables of a full download have millions of rows, so they
are walked and only the wanted fields of the wanted rows are kept.

The tables do not say the splits. The official ones are lists of scenes published with the development kit
(https://github.com/nutonomy/nuscenes-devkit, `utils/splits.py`); scene names are numbered, and of the scenes of
v1.0-trainval a few number ranges are `val` and `train_detect`, the rest `train` and `train_track`. Splits of one's own
are lists of scene names in `splits.json` beside the tables, the place the development kit looks in.

Detections have ten classes, tracks seven of them; annotations have 23 categories, of which eleven map onto the seven.
Source: the official definitions of the detection and tracking tasks, https://www.nuscenes.org/tracking, and
https://github.com/nutonomy/nuscenes-devkit/tree/master/python-sdk/nuscenes/eval.

A scene is a chain of samples (keyframes at 2 Hz), from `first_sample_token` along `next`. The pose of the vehicle at a
sample is the `ego_pose` of its LIDAR_TOP keyframe, as in the official evaluation.

Velocity is the central difference of the neighbouring annotations of the same instance, and unknown where they lie
more than 1.5 s per side apart, as in `NuScenes.box_velocity` of the development kit. An object counts as visible if
some LiDAR or radar point lies in its box; the official evaluation leaves out the others.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_tools.files import JsonStream, open_json
from data_tools.trajectories import central_differences
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import (
    FloatArray,
    checked_quaternions,
    checked_transform,
    quaternion_rotation,
    quaternion_yaw,
    yaw_quaternion,
)
from saga_fg.types import Annotations, Boxes

_TEXT_FIELDS = ("name", "channel", "next")  # and all that end in "token"


def table_folder(dataroot: str | Path, version: str) -> Path:
    """The folder of the tables; raises `InputError` naming the versions that are there."""
    folder = Path(dataroot) / version
    if not version or not folder.is_dir():
        root = Path(dataroot)
        present = sorted(p.parent.name for p in root.glob("*/scene.json")) if root.is_dir() else []
        there = f"; versions there: {', '.join(present)}" if present else ""
        raise InputError(f"{folder}: expected the folder of the nuScenes tables{there}")
    return folder


def read_table(folder: Path, table: str, fields: tuple[str, ...]) -> Iterator[tuple[Any, ...]]:
    """The `fields` of every row; names, channels and tokens are strings.

    Raises `InputError` for a missing table, broken JSON, a row without a field.
    """
    path = folder / f"{table}.json"
    if not path.is_file():
        raise InputError(f"{path}: missing table {table!r}")
    pick = itemgetter(*fields)
    text = [i for i, field in enumerate(fields) if field.endswith("token") or field in _TEXT_FIELDS]
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        for number, row in enumerate(stream.array()):
            try:
                values = pick(row)
            except (KeyError, TypeError, IndexError) as error:
                raise InputError(_broken(path, number, row, fields)) from error
            if len(fields) == 1:
                values = (values,)
            for i in text:
                if not isinstance(values[i], str):
                    raise InputError(f"{path}: record {number}: {fields[i]}: expected a string, got {values[i]!r}")
            yield values
        stream.end()


def _broken(path: Path, number: int, row: Any, fields: tuple[str, ...]) -> str:
    if not isinstance(row, dict):
        return f"{path}: record {number}: expected an object with fields {', '.join(fields)}"
    missing = next(field for field in fields if field not in row)
    return f"{path}: record {number} ({row.get('token', 'no token')}): field {missing!r} is missing"


_MINI_VAL = {"scene-0103", "scene-0916"}

_VAL = (
    *((3, 3), (12, 18), (35, 39), (92, 110), (221, 221), (268, 278), (329, 346), (519, 524), (552, 565), (625, 638)),
    *((770, 784), (794, 802), (904, 931), (962, 972), (1059, 1073)),
)
_TRAIN_DETECT = (
    *((1, 2), (41, 76), (161, 176), (190, 214), (254, 264), (283, 324), (347, 375), (382, 382), (420, 439), (457, 480)),
    *((566, 583), (665, 689), (739, 769), (868, 903), (945, 961), (975, 991), (1011, 1025), (1074, 1105)),
)

_VERSION_OF_SPLIT = {
    "mini_train": "mini",
    "mini_val": "mini",
    "train": "trainval",
    "train_detect": "trainval",
    "train_track": "trainval",
    "val": "trainval",
    "test": "test",
}


def split_scenes(dataroot: str | Path, version: str, split: str) -> tuple[str, ...]:
    """The names of the scenes of a split that the tables hold, in the order of the tables.

    Reads the scene table and `splits.json` alone. Raises `InputError` for an unknown split, an official one that does
    not belong to this version, and one of which no scene is present.
    """
    folder = table_folder(dataroot, version)
    scenes = [name for (name,) in read_table(folder, "scene", ("name",))]
    own = _own_splits(folder)
    if split in _VERSION_OF_SPLIT:
        wanted_version = _VERSION_OF_SPLIT[split]
        if not version.endswith(wanted_version):
            raise InputError(f"split {split} belongs to v1.0-{wanted_version}, the tables read are {version}")
        chosen = [name for name in scenes if _in_official_split(name, split)]
    elif split in own:
        chosen = [name for name in scenes if name in own[split]]
    else:
        official = [name for name, kind in _VERSION_OF_SPLIT.items() if version.endswith(kind)]
        raise InputError(f"{folder / 'splits.json'}: {unknown_name('split', split, (*official, *own))}")
    if not chosen:
        raise InputError(f"{folder / 'scene.json'}: expected scenes of split {split}, the table holds none of them")
    return tuple(chosen)


def _in_official_split(name: str, split: str) -> bool:
    if split == "test":
        return True
    if split.startswith("mini"):
        return (name in _MINI_VAL) == (split == "mini_val")
    number = name.removeprefix("scene-")
    if not number.isdecimal() or len(number) > 9:
        raise InputError(f"scene {name[:40]}: expected a name scene-NNNN to find its place in split {split}")
    val = _within(int(number), _VAL)
    detect = _within(int(number), _TRAIN_DETECT)
    return {"val": val, "train": not val, "train_detect": detect, "train_track": not (val or detect)}[split]


def _within(number: int, ranges: Iterable[tuple[int, int]]) -> bool:
    return any(first <= number <= last for first, last in ranges)


def _own_splits(folder: Path) -> dict[str, frozenset[str]]:
    path = folder / "splits.json"
    if not path.exists():
        return {}
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        splits = stream.value()
        stream.end()
    if not isinstance(splits, dict) or not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in splits.values()
    ):
        raise InputError(f"{path}: expected an object of lists of scene names")
    return {split: frozenset(names) for split, names in splits.items()}


TRACKING_CLASSES = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")

DETECTION_CLASSES = (*TRACKING_CLASSES, "barrier", "construction_vehicle", "traffic_cone")

CATEGORY_TO_TRACKING_CLASS = {
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}


LIDAR = "LIDAR_TOP"


@dataclass(frozen=True, eq=False)
class SceneRecord:
    """name; tokens of its K samples; timestamps (K,) in s; world_T_ego (K, 4, 4)."""

    name: str
    tokens: tuple[str, ...]
    timestamps: FloatArray
    world_T_ego: FloatArray


def read_scenes(folder: Path, names: Collection[str] | None) -> tuple[dict[str, SceneRecord], Collection[str]]:
    """The chosen scenes (None: all) by name, and the tokens of all samples of all scenes.

    Raises `InputError` for unknown names and broken records.
    """
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
    return records, samples.keys()


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
            rows[name].names.append((k, instance, label, int(lidar + radar) > 0))
        except (TypeError, ValueError, OverflowError) as error:
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
    """Annotations of one scene: index of the sample, instance, class, whether it has points; ten numbers of each."""

    names: list[tuple[int, str, str, bool]]
    numbers: array[float]

    def annotations(self, scene: SceneRecord) -> list[Annotations]:
        index, instances, labels, seen = zip(*self.names, strict=True) if self.names else ((), (), (), ())
        sample, instance = np.array(index, dtype=np.int64), np.array(instances, dtype=np.str_)
        visible = np.array(seen, dtype=np.bool_)
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


Record = dict[str, Any]

CATEGORY_OF_CLASS = {
    "barrier": "movable_object.barrier",
    "bicycle": "vehicle.bicycle",
    "bus": "vehicle.bus.rigid",
    "car": "vehicle.car",
    "construction_vehicle": "vehicle.construction",
    "motorcycle": "vehicle.motorcycle",
    "pedestrian": "human.pedestrian.adult",
    "traffic_cone": "movable_object.trafficcone",
    "trailer": "vehicle.trailer",
    "truck": "vehicle.truck",
}


def token(*parts: object) -> str:
    """The token of a record: a hash of the parts that identify it."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def box_fields(boxes: Boxes, decimals: int) -> list[Record]:
    """`translation`, `size` (width, length, height) and `rotation` of each box, m, rounded to `decimals`."""
    columns = zip(
        boxes.position.round(decimals).tolist(),
        boxes.size[:, [1, 0, 2]].round(decimals).tolist(),
        yaw_quaternion(boxes.yaw).tolist(),
        strict=True,
    )
    return [{"translation": position, "size": size, "rotation": rotation} for position, size, rotation in columns]


def linked(records: list[Record]) -> list[Record]:
    """The records, which are in order of time, with the tokens of their neighbours as `prev` and `next`."""
    tokens = ["", *(record["token"] for record in records), ""]
    return [
        {**record, "prev": before, "next": after}
        for record, before, after in zip(records, tokens[:-2], tokens[2:], strict=True)
    ]


def instance_record(instance: str, category: str, annotations: list[Record]) -> Record:
    """The `instance` of an object: its token, that of its category, and its annotations in order of time."""
    return {
        "token": instance,
        "category_token": category,
        "nbr_annotations": len(annotations),
        "first_annotation_token": annotations[0]["token"],
        "last_annotation_token": annotations[-1]["token"],
    }
