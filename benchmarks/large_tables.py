"""Tables of nuScenes of any size, without content that matters: to see what reading them takes.

The numbers of rows are those of v1.0-trainval for 850 scenes (https://www.nuscenes.org/nuscenes): 40 samples a scene,
34 annotations and 77 sensor readings a sample, with a pose of the vehicle for every reading. Records have all
fields of the official schema, since what is not needed has to be read over too. Written row by row.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from data_tools.datasets.nuscenes import CATEGORY_TO_TRACKING_CLASS
from data_tools.files.atomic_files import atomic_directory, atomic_file
from saga_fg.settings import Range, Settings, setting

VERSION = "v1.0-trainval"
CHANNELS = (
    *("LIDAR_TOP", "RADAR_FRONT", "RADAR_FRONT_LEFT", "RADAR_FRONT_RIGHT", "RADAR_BACK_LEFT", "RADAR_BACK_RIGHT"),
    *("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"),
)
PERIOD = 500_000  # microseconds between samples
LIFE = 20  # samples that an object is there


@dataclass(frozen=True)
class TableSize(Settings):
    """How many rows."""

    scenes: Annotated[int, Range(1, 10**6)] = setting(850, "scenes")
    samples: Annotated[int, Range(1, 10**6)] = setting(40, "samples of a scene")
    annotations: Annotated[int, Range(0, 10**6)] = setting(34, "annotations of a sample")
    readings: Annotated[int, Range(len(CHANNELS), 10**6)] = setting(
        77, "sensor readings of a sample, one keyframe of each of the twelve sensors among them"
    )
    detections: Annotated[int, Range(0, 10**6)] = setting(30, "detections of a sample")

    @property
    def rows(self) -> dict[str, int]:
        """Of the largest tables and of the detections."""
        samples = self.scenes * self.samples
        return {
            "sample": samples,
            "sample_data": samples * self.readings,
            "ego_pose": samples * self.readings,
            "sample_annotation": samples * self.annotations,
            "detections": samples * self.detections,
        }


def write_large_tables(directory: Path, size: TableSize) -> None:
    """Write directory/v1.0-trainval/*.json and directory/lidar.json. Raises `InputError` where that is not possible."""
    tables = {
        "category": _categories(),
        "sensor": ({"token": _token("se", k), "channel": c, "modality": c[:5]} for k, c in enumerate(CHANNELS)),
        "calibrated_sensor": _calibrations(size),
        "scene": _scenes(size),
        "sample": _samples(size),
        "sample_data": _readings(size),
        "ego_pose": _poses(size),
        "instance": _instances(size),
        "sample_annotation": _annotations(size),
    }
    with atomic_directory(directory) as folder:
        (folder / VERSION).mkdir()
        for name, rows in tables.items():
            _write(folder / VERSION / f"{name}.json", "[", (json.dumps(row, indent=0) for row in rows), "]\n")
        head = '{"meta": {"use_lidar": true}, "results": {'
        _write(folder / "lidar.json", head, _detections(size), "}}\n")


def _write(path: Path, begin: str, rows: Iterable[str], end: str) -> None:
    with atomic_file(path) as file:
        file.write(begin.encode())
        for number, row in enumerate(rows):
            file.write(f"{',' if number else ''}\n{row}".encode())
        file.write(f"\n{end}".encode())


Row = dict[str, Any]


def _token(table: str, *parts: int) -> str:
    """32 letters, as official tokens have."""
    return f"{table}{''.join(f'{part:010d}' for part in parts):0>30}"


def _linked(table: str, scene: int, k: int, count: int) -> dict[str, str]:
    """Token of row k of a chain of a scene, and of its neighbours."""
    tokens = [_token(table, scene, j) if 0 <= j < count else "" for j in (k, k - 1, k + 1)]
    return dict(zip(("token", "prev", "next"), tokens, strict=True))


def _categories() -> Iterator[Row]:
    for k, name in enumerate(CATEGORY_TO_TRACKING_CLASS):
        yield {"token": _token("ca", k), "name": name, "description": ""}


def _calibrations(size: TableSize) -> Iterator[Row]:
    for scene in range(size.scenes):
        for k in range(len(CHANNELS)):
            yield {
                "token": _token("cs", scene, k),
                "sensor_token": _token("se", k),
                "translation": [0.94, 0.0, 1.84],
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "camera_intrinsic": [],
            }


def _scenes(size: TableSize) -> Iterator[Row]:
    for scene in range(size.scenes):
        yield {
            "token": _token("sc", scene),
            "log_token": _token("lo", scene),
            "nbr_samples": size.samples,
            "first_sample_token": _token("sa", scene, 0),
            "last_sample_token": _token("sa", scene, size.samples - 1),
            "name": f"scene-{scene + 1:04d}",
            "description": "Parked cars, pedestrians, turn right",
        }


def _samples(size: TableSize) -> Iterator[Row]:
    for scene in range(size.scenes):
        for k in range(size.samples):
            link = _linked("sa", scene, k, size.samples)
            yield {**link, "timestamp": _time(size, scene, k), "scene_token": _token("sc", scene)}


def _readings(size: TableSize) -> Iterator[Row]:
    count = size.samples * size.readings
    for scene in range(size.scenes):
        for k in range(count):
            sample, number = divmod(k, size.readings)
            channel = CHANNELS[number % len(CHANNELS)]
            time = _time(size, scene, sample) + number * PERIOD // size.readings
            yield {
                **_linked("sd", scene, k, count),
                "sample_token": _token("sa", scene, sample),
                "ego_pose_token": _token("eg", scene, k),
                "calibrated_sensor_token": _token("cs", scene, number % len(CHANNELS)),
                "timestamp": time,
                "fileformat": "jpg",
                "is_key_frame": number < len(CHANNELS),
                "height": 900,
                "width": 1600,
                "filename": f"sweeps/{channel}/n015-2018-07-24-11-22-45+0800__{channel}__{time}.jpg",
            }


def _poses(size: TableSize) -> Iterator[Row]:
    for scene in range(size.scenes):
        for k in range(size.samples * size.readings):
            sample, number = divmod(k, size.readings)
            yield {
                "token": _token("eg", scene, k),
                "timestamp": _time(size, scene, sample) + number * PERIOD // size.readings,
                "rotation": [0.5731787718287827, -0.0015811634307974854, 0.013859363182046986, -0.8193116095230444],
                "translation": [411.4199861830012 + 0.05 * k, 1181.197175631848, 0.0],
            }


def _instances(size: TableSize) -> Iterator[Row]:
    for scene in range(size.scenes):
        for k in range(size.annotations * -(-size.samples // LIFE)):
            yield {
                "token": _token("in", scene, k),
                "category_token": _token("ca", k % len(CATEGORY_TO_TRACKING_CLASS)),
                "nbr_annotations": LIFE,
                "first_annotation_token": "",
                "last_annotation_token": "",
            }


def _annotations(size: TableSize) -> Iterator[Row]:
    count = size.samples * size.annotations
    for scene in range(size.scenes):
        for k in range(count):
            sample, number = divmod(k, size.annotations)
            yield {
                **_linked("an", scene, k, count),
                "sample_token": _token("sa", scene, sample),
                "instance_token": _token("in", scene, sample // LIFE * size.annotations + number),
                "visibility_token": "4",
                "attribute_tokens": ["4d8821270b4a47e3a8a300cbec48188e"],
                "translation": _position(sample, number),
                "size": [0.621, 0.669, 1.642],
                "rotation": [0.9831098797903927, 0.0, 0.0, -0.18301629506281616],
                "num_lidar_pts": number % 7,
                "num_radar_pts": 0,
            }


def _detections(size: TableSize) -> Iterator[str]:
    """Members of `results`, a sample each."""
    for scene in range(size.scenes):
        for sample in range(size.samples):
            token = _token("sa", scene, sample)
            boxes = [
                {
                    "sample_token": token,
                    "translation": _position(sample, number),
                    "size": [1.9528912305831909, 4.623015880584717, 1.7314634323120117],
                    "rotation": [0.9831098797903927, 0.0, 0.0, -0.18301629506281616],
                    "velocity": [0.5, 0.1],
                    "detection_name": "car",
                    "detection_score": 0.5,
                    "attribute_name": "vehicle.moving",
                }
                for number in range(size.detections)
            ]
            yield f'"{token}": {json.dumps(boxes)}'


def _position(sample: int, number: int) -> list[float]:
    return [400.0 + 5.0 * number + 0.25 * sample, 1150.0 + 3.0 * (number % 20), 1.0 + 0.123456789012 * (number % 3)]


def _time(size: TableSize, scene: int, sample: int) -> int:
    """Microseconds."""
    return 1_532_402_927_647_951 + (scene * (size.samples + 10) + sample) * PERIOD
