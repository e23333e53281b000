"""One simulated scene as records of the official nuScenes tables.

Schema: https://www.nuscenes.org/nuscenes#data-format. Keyframes (`sample`) come at most every half second. Each has a
`sample_data` record of LIDAR_TOP at its own time, which carries the pose of the vehicle, and one of each other sensor,
its frame nearest in time; all other frames are sweeps. There are no sensor files behind these records. Three fields are
approximate:

    num_lidar_pts      0 for hidden objects, else what 32 beams would leave on the object's side seen freely
    visibility_token   the lowest level for hidden objects, else the highest
    attribute_tokens   from the class and the speed
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from data_tools.datasets.nuscenes.records import (
    CATEGORY_OF_CLASS,
    Record,
    box_fields,
    instance_record,
    linked,
    token,
)
from data_tools.simulator.settings import SensorSettings
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import yaw_of, yaw_quaternion
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Frame

Tables = dict[str, list[Record]]

KEYFRAME_INTERVAL = 0.5  # s
RAYS_PER_STERADIAN = 12300.0  # 0.2 deg between shots, 32 beams over 42 deg
LIDAR = "LIDAR_TOP"
ATTRIBUTES = ("vehicle.moving", "vehicle.stopped", "vehicle.parked", "pedestrian.moving", "pedestrian.standing")
VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
IMAGE = (1600, 900)  # width, height, pixels


@dataclass(frozen=True)
class Channel:
    """Name and modality of a sensor in the format."""

    name: str
    modality: str


def channel_of(sensor: str) -> Channel:
    """The channel of a sensor by its name: "lidar" is LIDAR_TOP, "camera" CAM_FRONT, any other its name in capitals."""
    if sensor == "lidar":
        return Channel(LIDAR, "lidar")
    if sensor == "camera":
        return Channel("CAM_FRONT", "camera")
    modality = next((kind for kind in ("camera", "radar") if kind in sensor), "lidar")
    return Channel(sensor.upper(), modality)


def microseconds(time: float) -> int:
    return round(time * 1e6)


def keyframes(scene: Scene) -> IntArray:
    """Rows of the timestamps of a scene that become samples, at least half a second apart."""
    rows, latest = [], -np.inf
    for k, time in enumerate(scene.timestamps.tolist()):
        if time - latest > KEYFRAME_INTERVAL - 1e-3:
            rows.append(k)
            latest = time
    return np.array(rows, dtype=np.int64)


def sample_tokens(scene: Scene) -> list[str]:
    """The tokens of the samples, in order."""
    return [token("sample", scene.name, microseconds(scene.timestamps[k])) for k in keyframes(scene)]


def shared_tables(sensors: Mapping[str, SensorSettings], logs: list[str], classes: Iterable[str]) -> Tables:
    """The records shared by all scenes; `logs` are the names of the scenes, `classes` those of their objects."""
    categories = [CATEGORY_OF_CLASS[label] for label in classes]
    channels = {channel_of(name) for name in sensors} | {Channel(LIDAR, "lidar")}
    return {
        "category": [{"token": token("category", c), "name": c, "description": ""} for c in categories],
        "attribute": [{"token": token("attribute", a), "name": a, "description": ""} for a in ATTRIBUTES],
        "visibility": [{"token": t, "level": level, "description": ""} for t, level in VISIBILITY.items()],
        "sensor": [
            {"token": token("sensor", c.name), "channel": c.name, "modality": c.modality}
            for c in sorted(channels, key=lambda c: c.name)
        ],
        "map": [
            {
                "token": token("map"),
                "category": "semantic_prior",
                "filename": "maps/placeholder.png",
                "log_tokens": [token("log", name) for name in logs],
            }
        ],
    }


def scene_tables(scene: Scene, sensors: Mapping[str, SensorSettings]) -> Tables:
    """All records of one scene with ground truth, by table."""
    rows, tokens = keyframes(scene), sample_tokens(scene)
    log, scene_token = token("log", scene.name), token("scene", scene.name)
    tables: Tables = defaultdict(list)
    tables["log"] = [
        {"token": log, "logfile": scene.name, "vehicle": "simulated", "date_captured": "", "location": "simulated"}
    ]
    tables["scene"] = [
        {
            "token": scene_token,
            "log_token": log,
            "nbr_samples": len(rows),
            "first_sample_token": tokens[0],
            "last_sample_token": tokens[-1],
            "name": scene.name,
            "description": "",
        }
    ]
    tables["sample"] = linked(
        [
            {"token": here, "timestamp": microseconds(time), "scene_token": scene_token}
            for here, time in zip(tokens, scene.timestamps[rows], strict=True)
        ]
    )
    _add_sensor_data(tables, scene, sensors, rows, tokens)
    _add_annotations(tables, scene, rows, tokens)
    return dict(tables)


def _add_sensor_data(
    tables: Tables, scene: Scene, sensors: Mapping[str, SensorSettings], rows: IntArray, tokens: list[str]
) -> None:
    """`sample_data`, `ego_pose` and `calibrated_sensor` of every channel."""
    times = scene.timestamps[rows]
    for name in sorted({*sensors, "lidar"}):
        channel = channel_of(name)
        is_camera = channel.modality == "camera"
        calibration = token("calibrated_sensor", scene.name, channel.name)
        tables["calibrated_sensor"].append(_calibration(calibration, channel, sensors.get(name)))
        frames = [frame for frame in scene.frames if frame.sensor == name and frame.world_T_ego is not None]
        poses = {microseconds(f.timestamp): (f.timestamp, f.world_T_ego) for f in frames}
        key = {microseconds(frame.timestamp) for frame in nearest_frames(frames, times) if frame is not None}
        if channel.name == LIDAR:
            poses |= {microseconds(scene.timestamps[k]): (scene.timestamps[k], scene.world_T_ego[k]) for k in rows}
            key = {microseconds(time) for time in times}
        data = []
        for time, (seconds, pose) in sorted(poses.items()):
            assert pose is not None
            here = token("sample_data", scene.name, channel.name, time)
            tables["ego_pose"].append(
                {
                    "token": here,
                    "timestamp": time,
                    "rotation": yaw_quaternion(yaw_of(pose)).tolist(),
                    "translation": pose[:3, 3].tolist(),
                }
            )
            folder, ending = "samples" if time in key else "sweeps", "jpg" if is_camera else "pcd"
            data.append(
                {
                    "token": here,
                    "sample_token": tokens[int(np.argmin(np.abs(times - seconds)))],
                    "ego_pose_token": here,
                    "calibrated_sensor_token": calibration,
                    "timestamp": time,
                    "fileformat": ending,
                    "is_key_frame": time in key,
                    "height": IMAGE[1] if is_camera else 0,
                    "width": IMAGE[0] if is_camera else 0,
                    "filename": f"{folder}/{channel.name}/{scene.name}__{channel.name}__{time}.{ending}",
                }
            )
        tables["sample_data"] += linked(data)


def nearest_frames(frames: list[Frame], times: FloatArray) -> list[Frame | None]:
    """For each time (K,), s, the frame of one sensor nearest to it, if nearer than half of a keyframe interval."""
    if not frames:
        return [None] * len(times)
    stamps = np.array([frame.timestamp for frame in frames])
    nearest = np.abs(stamps[None, :] - times[:, None]).argmin(axis=1)
    close = np.abs(stamps[nearest] - times) < KEYFRAME_INTERVAL / 2
    return [frames[n] if ok else None for n, ok in zip(nearest.tolist(), close.tolist(), strict=True)]


def _calibration(name: str, channel: Channel, sensor: SensorSettings | None) -> Record:
    position = (sensor or SensorSettings()).position
    camera = channel.modality == "camera"
    focal = IMAGE[0] / 2  # an angle of view of 90 degrees
    return {
        "token": name,
        "sensor_token": token("sensor", channel.name),
        "translation": list(position),
        "rotation": [0.5, -0.5, 0.5, -0.5] if camera else [1.0, 0.0, 0.0, 0.0],  # a camera's z axis looks ahead
        "camera_intrinsic": [[focal, 0.0, IMAGE[0] / 2], [0.0, focal, IMAGE[1] / 2], [0.0, 0.0, 1.0]] if camera else [],
    }


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


def _annotations(scene: Scene, k: int, truth: Annotations, sample: str) -> list[Record]:
    """The annotations of one sample, without links to others."""
    boxes = truth.boxes
    distance = np.linalg.norm(boxes.position[:, :2] - scene.world_T_ego[k][:2, 3], axis=1)
    side = boxes.size[:, 1] * boxes.size[:, 2] / np.maximum(distance, 1.0) ** 2
    points = np.where(truth.visible, np.maximum(1, np.round(RAYS_PER_STERADIAN * side)), 0).astype(int)
    moving = np.linalg.norm(boxes.velocity, axis=1) > 0.2
    columns = (truth.id, boxes.label, truth.visible, moving, points)
    return [
        {
            "token": token("sample_annotation", sample, name),
            "sample_token": sample,
            "visibility_token": "4" if visible else "1",
            "attribute_tokens": [token("attribute", attribute) for attribute in _attributes(name, label, moves)],
            **box,
            "num_lidar_pts": count,
            "num_radar_pts": 0,
        }
        for box, name, label, visible, moves, count in zip(
            box_fields(boxes, 6), *(column.tolist() for column in columns), strict=True
        )
    ]


def _attributes(name: str, label: str, moves: bool) -> list[str]:
    if label in ("bicycle", "traffic_cone"):
        return []
    if label == "pedestrian":
        return ["pedestrian.moving" if moves else "pedestrian.standing"]
    if name.startswith("parked"):
        return ["vehicle.parked"]
    return ["vehicle.moving" if moves else "vehicle.stopped"]
