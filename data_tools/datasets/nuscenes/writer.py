"""Scenes and labels written in the nuScenes layout, for every tool that reads it.

    DIRECTORY/VERSION/*.json         the 13 tables, and splits.json with all scenes as split "all"
    DIRECTORY/maps/placeholder.png   a black pixel: there is no map
    DIRECTORY/detections/NAME.json   the detections of the sensor NAME in the official detection-result format

Keyframes (`sample`) come at most every half second. Each has a `sample_data` record of LIDAR_TOP at its own time, which
carries the pose of the vehicle, and one of each other sensor, its frame nearest in time; all other frames are sweeps.
There are no sensor files behind these records. A sensor's detections of a sample are those of its frame nearest in
time, moved along their measured velocities to the sample's time; unknown velocities are NaN. Objects have no
attributes, and two fields are approximate:

    num_lidar_pts      0 for hidden objects, else what 32 beams would leave on the object's side seen freely
    visibility_token   the lowest level for hidden objects, else the highest

Schema: https://www.nuscenes.org/nuscenes#data-format.

Labels as tables of nuScenes: a version of the dataset whose annotations are the labels.

    DIRECTORY/VERSION/sample_annotation.json, instance.json   made from the labels
    DIRECTORY/VERSION/category.json                           the dataset's, and the categories of the labels
    DIRECTORY/VERSION/*.json                                  copies of the dataset's other tables
    DIRECTORY/maps/*                                          copies of its map masks, which the development kit loads

Readers of nuScenes read them as annotations. An annotation has five additional fields: `label_score`, `label_source`,
`label_quality`, `position_covariance` (xx, xy, yy, m^2) and `yaw_variance` (rad^2). Points are not counted:
`num_lidar_pts` is 1 in detected boxes and 0 in filled ones. `visibility_token` and `attribute_tokens` are empty.
Objects of unknown size or heading are left out.

Schema: https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from data_tools.datasets.nuscenes.results import ResultMeta
from data_tools.datasets.nuscenes.tables import (
    CATEGORY_OF_CLASS,
    DETECTION_CLASSES,
    Record,
    box_fields,
    instance_record,
    linked,
    read_table,
    table_folder,
    token,
)
from data_tools.files import atomic_directory, atomic_file, open_bytes, open_json, parsed_json, write_text
from saga_fg.errors import InputError, error_context
from saga_fg.numerics import FloatArray, IntArray, upper_triangle, yaw_of, yaw_quaternion
from saga_fg.types import Annotations, Dataset, Frame, Scene

if TYPE_CHECKING:
    from saga_fg.smoothing import Labels

Tables = dict[str, list[Record]]
Mounts = Mapping[str, tuple[float, float, float]]
"""Position of each sensor on the vehicle by its name, m."""

CLASSES = ("car", "truck", "bus", "pedestrian")  # that every such version has
KEYFRAME_INTERVAL = 0.5  # s
ROOF = (0.94, 0.0, 1.84)  # m, of LIDAR_TOP where no sensor is a LiDAR
RAYS_PER_STERADIAN = 12300.0  # 0.2 deg between shots, 32 beams over 42 deg
VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
IMAGE = (1600, 900)  # width, height, pixels
FOCAL = IMAGE[0] / 2  # an angle of view of 90 degrees
INTRINSIC = [[FOCAL, 0.0, IMAGE[0] / 2], [0.0, FOCAL, IMAGE[1] / 2], [0.0, 0.0, 1.0]]
BLACK_PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55"
    "0000000a49444154789c636000000002000148afa4710000000049454e44ae426082"
)  # a PNG image of one black pixel


class Channel(NamedTuple):
    """Name and modality of a sensor in the format."""

    name: str
    modality: str


LIDAR = Channel("LIDAR_TOP", "lidar")


VERSION = "v1.0-mini"


def write_nuscenes(directory: str | Path, dataset: Dataset, mounts: Mounts) -> None:
    """Write all scenes of `dataset`, with the sensors of `mounts`; all files appear when the last scene is done.

    Raises `InputError` for a directory that is not writable.
    """
    with atomic_directory(directory) as folder:
        tables: Tables = defaultdict(list)
        classes = dict.fromkeys(CLASSES)
        results: dict[str, Record] = {name: {} for name in mounts}
        for name in dataset.scenes:
            scene = dataset.scene(name)
            _add_scene(tables, scene, mounts)
            for truth in scene.ground_truth or ():
                classes |= dict.fromkeys(truth.boxes.label.tolist())
            for sensor, samples in results.items():
                samples.update(_detections(scene, sensor))
        tables |= _shared_tables(mounts, dataset.scenes, tuple(classes))
        for part in (VERSION, "detections", "maps"):
            (folder / part).mkdir()
        for table, records in tables.items():
            _write_json(folder / VERSION / f"{table}.json", records)
        _write_json(folder / VERSION / "splits.json", {"all": list(dataset.scenes)})
        for sensor, samples in results.items():
            meta = asdict(ResultMeta(**{f"use_{_channel_of(sensor).modality}": True}))
            _write_json(folder / "detections" / f"{sensor}.json", {"meta": meta, "results": samples})
        (folder / "maps" / "placeholder.png").write_bytes(BLACK_PIXEL)


def _write_json(path: Path, content: object) -> None:
    with path.open("w", encoding="utf-8") as file:
        json.dump(content, file)


def _channel_of(sensor: str) -> Channel:
    """The channel of a sensor by its name: "lidar" is LIDAR_TOP, "camera" CAM_FRONT, any other its name in capitals."""
    named = {"lidar": LIDAR, "camera": Channel("CAM_FRONT", "camera")}
    modality = next((kind for kind in ("camera", "radar") if kind in sensor), "lidar")
    return named.get(sensor, Channel(sensor.upper(), modality))


def _microseconds(time: float) -> int:
    return round(time * 1e6)


def _samples(scene: Scene) -> tuple[IntArray, list[str]]:
    """Rows of the timestamps that become samples, at least half a second apart, and the tokens of these."""
    rows, latest = [], -np.inf
    for k, time in enumerate(scene.timestamps.tolist()):
        if time - latest > KEYFRAME_INTERVAL - 1e-3:
            rows.append(k)
            latest = time
    tokens = [token("sample", scene.name, _microseconds(scene.timestamps[k])) for k in rows]
    return np.array(rows, dtype=np.int64), tokens


def _nearest_frames(frames: list[Frame], times: FloatArray) -> list[Frame | None]:
    """For each time (K,), s, the frame of one sensor nearest to it, if nearer than half of a keyframe interval."""
    if not frames:
        return [None] * len(times)
    stamps = np.array([frame.timestamp for frame in frames])
    nearest = np.abs(stamps[None, :] - times[:, None]).argmin(axis=1)
    close = np.abs(stamps[nearest] - times) < KEYFRAME_INTERVAL / 2
    return [frames[n] if ok else None for n, ok in zip(nearest.tolist(), close.tolist(), strict=True)]


def _detections(scene: Scene, sensor: str) -> dict[str, list[Record]]:
    """The detections of one sensor at the samples of a scene; samples far from any frame of the sensor are left out."""
    rows, tokens = _samples(scene)
    times = scene.timestamps[rows]
    nearest = _nearest_frames([frame for frame in scene.frames if frame.sensor == sensor], times)
    found = zip(tokens, times.tolist(), nearest, strict=True)
    return {sample: list(_detected(sample, time, frame)) for sample, time, frame in found if frame is not None}


def _detected(sample: str, time: float, frame: Frame) -> Iterator[Record]:
    known = np.isin(frame.detections.boxes.label, DETECTION_CLASSES)  # nuScenes has no traffic lights
    detections = frame.detections.select(known)
    boxes, position = detections.boxes, detections.boxes.position.copy()
    position[:, :2] += (time - frame.timestamp) * np.nan_to_num(boxes.velocity)
    columns = (column.tolist() for column in (boxes.velocity.round(4), boxes.label, detections.score.round(6)))
    for box, velocity, label, score in zip(box_fields(replace(boxes, position=position), 4), *columns, strict=True):
        about = {"detection_name": label, "detection_score": score, "attribute_name": ""}
        yield {"sample_token": sample, **box, "velocity": velocity, **about}


def _shared_tables(mounts: Mounts, logs: tuple[str, ...], classes: tuple[str, ...]) -> Tables:
    """The records shared by all scenes; `logs` are the names of the scenes, `classes` those of their objects."""
    categories = [CATEGORY_OF_CLASS[label] for label in classes]
    image = {"category": "semantic_prior", "filename": "maps/placeholder.png"}
    return {
        "category": [{"token": token("category", c), "name": c, "description": ""} for c in categories],
        "attribute": [],
        "visibility": [{"token": t, "level": level, "description": ""} for t, level in VISIBILITY.items()],
        "sensor": [
            {"token": token("sensor", c.name), "channel": c.name, "modality": c.modality}
            for c in sorted({*map(_channel_of, mounts), LIDAR})
        ],
        "map": [{"token": token("map"), **image, "log_tokens": [token("log", name) for name in logs]}],
    }


def _add_scene(tables: Tables, scene: Scene, mounts: Mounts) -> None:
    """All records of one scene with ground truth."""
    rows, tokens = _samples(scene)
    log, scene_token = token("log", scene.name), token("scene", scene.name)
    tables["log"].append(
        {"token": log, "logfile": scene.name, "vehicle": "simulated", "date_captured": "", "location": "simulated"}
    )
    tables["scene"].append(
        {
            "token": scene_token,
            "log_token": log,
            "nbr_samples": len(rows),
            "first_sample_token": tokens[0],
            "last_sample_token": tokens[-1],
            "name": scene.name,
            "description": "",
        }
    )
    samples = zip(tokens, scene.timestamps[rows], strict=True)
    tables["sample"] += linked(
        [{"token": here, "timestamp": _microseconds(time), "scene_token": scene_token} for here, time in samples]
    )
    for name in sorted({*mounts, "lidar"}):
        _add_sensor_data(tables, scene, name, mounts.get(name, ROOF))
    _add_annotations(tables, scene, rows, tokens)


def _add_sensor_data(tables: Tables, scene: Scene, name: str, position: tuple[float, float, float]) -> None:
    """`sample_data`, `ego_pose` and `calibrated_sensor` of a sensor."""
    rows, tokens = _samples(scene)
    times, channel = scene.timestamps[rows], _channel_of(name)
    camera, calibration = channel.modality == "camera", token("calibrated_sensor", scene.name, channel.name)
    tables["calibrated_sensor"].append(
        {
            "token": calibration,
            "sensor_token": token("sensor", channel.name),
            "translation": list(position),
            "rotation": [0.5, -0.5, 0.5, -0.5] if camera else [1.0, 0.0, 0.0, 0.0],  # a camera's z axis looks ahead
            "camera_intrinsic": INTRINSIC if camera else [],
        }
    )
    frames = [frame for frame in scene.frames if frame.sensor == name and frame.world_T_ego is not None]
    poses = {_microseconds(f.timestamp): (f.timestamp, f.world_T_ego) for f in frames}
    key = {_microseconds(frame.timestamp) for frame in _nearest_frames(frames, times) if frame is not None}
    if channel == LIDAR:
        poses |= {_microseconds(scene.timestamps[k]): (scene.timestamps[k], scene.world_T_ego[k]) for k in rows}
        key = {_microseconds(time) for time in times}
    data = []
    for time, (seconds, pose) in sorted(poses.items()):
        assert pose is not None
        here = token("sample_data", scene.name, channel.name, time)
        rotation, translation = yaw_quaternion(yaw_of(pose)).tolist(), pose[:3, 3].tolist()
        tables["ego_pose"].append({"token": here, "timestamp": time, "rotation": rotation, "translation": translation})
        folder, ending = "samples" if time in key else "sweeps", "jpg" if camera else "pcd"
        data.append(
            {
                "token": here,
                "sample_token": tokens[int(np.argmin(np.abs(times - seconds)))],
                "ego_pose_token": here,
                "calibrated_sensor_token": calibration,
                "timestamp": time,
                "fileformat": ending,
                "is_key_frame": time in key,
                "height": IMAGE[1] if camera else 0,
                "width": IMAGE[0] if camera else 0,
                "filename": f"{folder}/{channel.name}/{scene.name}__{channel.name}__{time}.{ending}",
            }
        )
    tables["sample_data"] += linked(data)


def _add_annotations(tables: Tables, scene: Scene, rows: IntArray, tokens: list[str]) -> None:
    """`sample_annotation` and `instance`; the scene has ground truth."""
    assert scene.ground_truth is not None
    annotations: dict[str, list[Record]] = defaultdict(list)
    class_of: dict[str, str] = {}
    for k, sample in zip(rows.tolist(), tokens, strict=True):
        truth = scene.ground_truth[k]
        class_of.update(zip(truth.id.tolist(), truth.boxes.label.tolist(), strict=True))
        for name, record in zip(truth.id.tolist(), _annotations(scene, k, truth, sample), strict=True):
            annotations[name].append(record)
    for name, records in sorted(annotations.items()):
        instance, category = token("instance", scene.name, name), token("category", CATEGORY_OF_CLASS[class_of[name]])
        tables["sample_annotation"] += linked([{**record, "instance_token": instance} for record in records])
        tables["instance"].append(instance_record(instance, category, records))


def _annotations(scene: Scene, k: int, truth: Annotations, sample: str) -> Iterator[Record]:
    """The annotations of one sample, without links to others."""
    boxes = truth.boxes
    distance = np.linalg.norm(boxes.position[:, :2] - scene.world_T_ego[k][:2, 3], axis=1)
    side = boxes.size[:, 1] * boxes.size[:, 2] / np.maximum(distance, 1.0) ** 2
    points = np.where(truth.visible, np.maximum(1, np.round(RAYS_PER_STERADIAN * side)), 0).astype(int)
    columns = (column.tolist() for column in (truth.id, truth.visible, points))
    for box, name, visible, count in zip(box_fields(boxes, 6), *columns, strict=True):
        yield {
            "token": token("sample_annotation", sample, name),
            "sample_token": sample,
            "visibility_token": "4" if visible else "1",
            "attribute_tokens": [],
            **box,
            "num_lidar_pts": count,
            "num_radar_pts": 0,
        }


LabelledObject = tuple[str, list[Record]]
"""The class of an object, and its annotations in order of time."""


def write_nuscenes_labels(
    directory: str | Path,
    dataroot: str | Path,
    version: str,
    scenes: Iterable[tuple[Scene, Sequence[Labels]]],
) -> None:
    """Write the labels of some scenes of dataroot/version to directory/version; the files appear when all is done.

    The tables hold all scenes of the version; those that are not among `scenes` have no annotations. Raises
    `InputError` for tables that are missing, a directory that is not writable, labels that do not fit their scene.
    """
    _write_tables(directory, dataroot, version, _objects(str(directory), scenes))


def write_label_part(path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Labels]]]) -> None:
    """Write some scenes as input of `merge_label_parts`: one line `[class, [annotation, ...]]` for each object.

    Raises `InputError` as `write_nuscenes_labels` does.
    """
    with atomic_file(path) as file:
        for one in _objects(str(path), scenes):
            file.write(json.dumps(one, allow_nan=False).encode() + b"\n")


def merge_label_parts(directory: str | Path, dataroot: str | Path, version: str, parts: Iterable[str | Path]) -> None:
    """Write the tables of `write_nuscenes_labels` from files that `write_label_part` has written."""
    _write_tables(directory, dataroot, version, (one for part in parts for one in _read_part(Path(part))))


def _read_part(path: Path) -> Iterator[LabelledObject]:
    with open_json(path) as file:
        for line in file:
            label, records = parsed_json(line, str(path))
            yield label, records


def _objects(where: str, scenes: Iterable[tuple[Scene, Sequence[Labels]]]) -> Iterator[LabelledObject]:
    """The objects of some scenes; a class that nuScenes does not have is an `InputError`."""
    for scene, frames in scenes:
        with error_context(f"{where}: scene {scene.name}"):
            if len(frames) != len(scene):
                raise InputError(f"expected labels for {len(scene)} samples, got {len(frames)}")
            for label, records in _label_records(scene, frames):
                if label not in CATEGORY_OF_CLASS:
                    raise InputError(f"class {label}: expected one of {', '.join(CATEGORY_OF_CLASS)}")
                yield label, records


def _write_tables(directory: str | Path, dataroot: str | Path, version: str, objects: Iterable[LabelledObject]) -> None:
    """Write all tables; those of annotations and instances object by object."""
    source = table_folder(dataroot, version)
    categories = dict(read_table(source, "category", ("name", "token")))
    with atomic_directory(directory) as folder:
        tables = folder / version
        tables.mkdir()
        for path in sorted(source.glob("*.json")):
            if path.stem not in ("sample_annotation", "instance", "category"):
                _copy(path, tables / path.name)
        for (name,) in read_table(source, "map", ("filename",)):
            mask = Path(dataroot) / name
            if mask.is_file() and Path(name).parts[0] == "maps" and ".." not in Path(name).parts:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                _copy(mask, folder / name)
        with _array(tables / "sample_annotation.json") as annotation, _array(tables / "instance.json") as instance:
            for label, records in objects:
                name = CATEGORY_OF_CLASS[label]
                for record in records:
                    annotation(record)
                category = categories.setdefault(name, token("label", "category", name))
                instance(instance_record(records[0]["instance_token"], category, records))
        with open_json(source / "category.json") as file:
            known: list[Record] = parsed_json(file.read(), str(source / "category.json"))
        there = {record["token"] for record in known}
        known += [
            {"token": category, "name": name, "description": ""}
            for name, category in categories.items()
            if category not in there
        ]
        write_text(tables / "category.json", json.dumps(known) + "\n")


def _copy(source: Path, target: Path) -> None:
    with open_bytes(source) as file, target.open("wb") as copy:
        shutil.copyfileobj(file, copy)


@contextmanager
def _array(path: Path) -> Iterator[Callable[[Record], None]]:
    """A function that appends a record to the JSON array that the file is."""
    first = True
    with path.open("w", encoding="utf-8") as file:

        def append(record: Record) -> None:
            nonlocal first
            file.write(("[\n" if first else ",\n") + json.dumps(record, allow_nan=False))
            first = False

        yield append
        file.write("[]\n" if first else "\n]\n")


def _label_records(scene: Scene, frames: Sequence[Labels]) -> list[LabelledObject]:
    """The class of each object, and its annotations in order of time, linked."""
    records: dict[int, list[Record]] = defaultdict(list)
    class_of: dict[int, str] = {}
    for sample, labels in zip(scene.tokens, frames, strict=True):
        boxes = labels.tracks.boxes
        rows = np.flatnonzero(np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw))
        tracks = labels.tracks.select(rows)
        columns = zip(
            tracks.id.tolist(),
            tracks.boxes.label.tolist(),
            box_fields(tracks.boxes, 6),
            tracks.score.tolist(),
            labels.source[rows].tolist(),
            labels.quality[rows].tolist(),
            upper_triangle(tracks.position_covariance).tolist(),
            labels.yaw_variance[rows].tolist(),
            strict=True,
        )
        for id_, label, box, score, source, quality, covariance, variance in columns:
            if class_of.setdefault(id_, label) != label:
                raise InputError(f"sample {sample}: object {id_}: expected one class, got {class_of[id_]} and {label}")
            records[id_].append(
                {
                    "token": token("label", "sample_annotation", sample, id_),
                    "sample_token": sample,
                    "instance_token": token("label", "instance", scene.name, id_),
                    "visibility_token": "",
                    "attribute_tokens": [],
                    **box,
                    "num_lidar_pts": int(source != "filled"),
                    "num_radar_pts": 0,
                    "label_score": score,
                    "label_source": source,
                    "label_quality": quality,
                    "position_covariance": covariance,
                    "yaw_variance": None if variance != variance else variance,
                }
            )
    return [(class_of[id_], linked(records[id_])) for id_ in sorted(records)]
