"""One simulated scene as records of the official nuScenes tables.

Schema: https://www.nuscenes.org/nuscenes#data-format. Keyframes (`sample`) come at most every half second. Each has a
`sample_data` record of LIDAR_TOP at its own time, which carries the pose of the vehicle, and one of each other sensor,
its frame nearest in time; all other frames are sweeps. Tokens are hashes of what they name. There are no measurements
behind these records, and of three fields the scene says less than the format asks for:

    num_lidar_pts      0 for hidden objects, else what 32 beams would leave on the object's side seen freely
    visibility_token   the lowest level for hidden objects, else the highest
    attribute_tokens   from the class and the speed
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_tools.simulator.settings import SensorSettings
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import yaw_of, yaw_quaternion
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Frame

Record = dict[str, Any]
Tables = dict[str, list[Record]]

KEYFRAME_INTERVAL = 0.5  # s
RAYS_PER_STERADIAN = 12300.0  # 0.2 deg between shots, 32 beams over 42 deg
LIDAR = "LIDAR_TOP"
CATEGORIES = {
    "car": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "pedestrian": "human.pedestrian.adult",
}
ATTRIBUTES = ("vehicle.moving", "vehicle.stopped", "vehicle.parked", "pedestrian.moving", "pedestrian.standing")
VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
IMAGE = (1600, 900)  # width, height, pixels


@dataclass(frozen=True)
class Channel:
    """What the format calls a sensor."""

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


def token(*parts: object) -> str:
    """The token of a record: a hash of its table, scene and what tells it from others."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def microseconds(time: float) -> int:
    return round(time * 1e6)


def keyframes(scene: Scene) -> IntArray:
    """The moments of a scene that become samples: rows at least half a second apart."""
    rows, latest = [], -np.inf
    for k, time in enumerate(scene.timestamps.tolist()):
        if time - latest > KEYFRAME_INTERVAL - 1e-3:
            rows.append(k)
            latest = time
    return np.array(rows, dtype=np.int64)


def sample_tokens(scene: Scene) -> list[str]:
    """The tokens of the samples, in order."""
    return [token("sample", scene.name, microseconds(scene.timestamps[k])) for k in keyframes(scene)]


def shared_tables(sensors: Mapping[str, SensorSettings], logs: list[str]) -> Tables:
    """The records that do not belong to one scene; `logs` are the names of all scenes."""
    channels = {channel_of(name) for name in sensors} | {Channel(LIDAR, "lidar")}
    return {
        "category": [{"token": token("category", c), "name": c, "description": ""} for c in CATEGORIES.values()],
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
    tables: Tables = defaultdict(list)
    rows = keyframes(scene)
    tokens = sample_tokens(scene)
    log = token("log", scene.name)
    tables["log"].append(
        {"token": log, "logfile": scene.name, "vehicle": "simulated", "date_captured": "", "location": "simulated"}
    )
    tables["scene"].append(
        {
            "token": token("scene", scene.name),
            "log_token": log,
            "nbr_samples": len(rows),
            "first_sample_token": tokens[0],
            "last_sample_token": tokens[-1],
            "name": scene.name,
            "description": "",
        }
    )
    for (before, here, after), k in zip(_linked(tokens), rows, strict=True):
        time = microseconds(scene.timestamps[k])
        links = {"prev": before, "next": after}
        tables["sample"].append({"token": here, "timestamp": time, "scene_token": token("scene", scene.name), **links})
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
        mounted = token("calibrated_sensor", scene.name, channel.name)
        tables["calibrated_sensor"].append(_calibration(mounted, channel, sensors.get(name)))
        frames = [frame for frame in scene.frames if frame.sensor == name and frame.world_T_ego is not None]
        moments = {microseconds(f.timestamp): (f.timestamp, f.world_T_ego) for f in frames}
        key = {microseconds(frame.timestamp) for frame in nearest_frames(frames, times) if frame is not None}
        if channel.name == LIDAR:
            moments |= {microseconds(scene.timestamps[k]): (scene.timestamps[k], scene.world_T_ego[k]) for k in rows}
            key = {microseconds(time) for time in times}
        ordered = sorted(moments)
        links = _linked([token("sample_data", scene.name, channel.name, time) for time in ordered])
        for (before, here, after), time in zip(links, ordered, strict=True):
            seconds, pose = moments[time]
            assert pose is not None
            is_key = time in key
            tables["ego_pose"].append(
                {
                    "token": here,
                    "timestamp": time,
                    "rotation": yaw_quaternion(yaw_of(pose)).tolist(),
                    "translation": pose[:3, 3].tolist(),
                }
            )
            folder = "samples" if is_key else "sweeps"
            ending = "jpg" if channel.modality == "camera" else "pcd"
            tables["sample_data"].append(
                {
                    "token": here,
                    "sample_token": tokens[int(np.argmin(np.abs(times - seconds)))],
                    "ego_pose_token": here,
                    "calibrated_sensor_token": mounted,
                    "timestamp": time,
                    "fileformat": ending,
                    "is_key_frame": is_key,
                    "height": IMAGE[1] if channel.modality == "camera" else 0,
                    "width": IMAGE[0] if channel.modality == "camera" else 0,
                    "filename": f"{folder}/{channel.name}/{scene.name}__{channel.name}__{time}.{ending}",
                    "prev": before,
                    "next": after,
                }
            )


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
    of_instance: dict[str, list[Record]] = defaultdict(list)
    category: dict[str, str] = {}
    for k, sample in zip(rows.tolist(), tokens, strict=True):
        truth = scene.ground_truth[k]
        category.update(zip(truth.id.tolist(), truth.boxes.label.tolist(), strict=True))
        for name, record in zip(truth.id.tolist(), _annotations(scene, k, truth, sample), strict=True):
            of_instance[name].append(record)
    for name in sorted(of_instance):
        records = of_instance[name]
        instance = token("instance", scene.name, name)
        for record, (before, _, after) in zip(records, _linked([r["token"] for r in records]), strict=True):
            tables["sample_annotation"].append({**record, "instance_token": instance, "prev": before, "next": after})
        tables["instance"].append(
            {
                "token": instance,
                "category_token": token("category", CATEGORIES[category[name]]),
                "nbr_annotations": len(records),
                "first_annotation_token": records[0]["token"],
                "last_annotation_token": records[-1]["token"],
            }
        )


def _annotations(scene: Scene, k: int, truth: Annotations, sample: str) -> list[Record]:
    """The annotations of one sample, without what links them to others."""
    boxes = truth.boxes
    distance = np.linalg.norm(boxes.position[:, :2] - scene.world_T_ego[k][:2, 3], axis=1)
    side = boxes.size[:, 1] * boxes.size[:, 2] / np.maximum(distance, 1.0) ** 2
    points = np.where(truth.visible, np.maximum(1, np.round(RAYS_PER_STERADIAN * side)), 0).astype(int)
    moving = np.linalg.norm(boxes.velocity, axis=1) > 0.2
    columns = zip(
        truth.id.tolist(),
        boxes.label.tolist(),
        truth.visible.tolist(),
        moving.tolist(),
        boxes.position.round(6).tolist(),
        boxes.size[:, [1, 0, 2]].round(6).tolist(),
        yaw_quaternion(boxes.yaw).tolist(),
        points.tolist(),
        strict=True,
    )
    return [
        {
            "token": token("sample_annotation", sample, name),
            "sample_token": sample,
            "visibility_token": "4" if visible else "1",
            "attribute_tokens": [token("attribute", _attribute(name, label, moves))],
            "translation": position,
            "size": size,
            "rotation": rotation,
            "num_lidar_pts": count,
            "num_radar_pts": 0,
        }
        for name, label, visible, moves, position, size, rotation, count in columns
    ]


def _attribute(name: str, label: str, moves: bool) -> str:
    if label == "pedestrian":
        return "pedestrian.moving" if moves else "pedestrian.standing"
    if name.startswith("parked"):
        return "vehicle.parked"
    return "vehicle.moving" if moves else "vehicle.stopped"


def _linked(tokens: list[str]) -> list[tuple[str, str, str]]:
    """Each token with the one before and the one after it, "" at the ends."""
    return list(zip(["", *tokens[:-1]], tokens, [*tokens[1:], ""], strict=True))
