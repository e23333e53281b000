"""Simulated scenes in the nuScenes layout, for every tool that reads it.

    DIRECTORY/VERSION/*.json         the 13 tables, and splits.json with all scenes as split "all"
    DIRECTORY/maps/placeholder.png   a black pixel: there is no map
    DIRECTORY/detections/NAME.json   the detections of the sensor NAME in the official detection-result format

Samples come at 2 Hz. A sensor's detections of a sample are those of its frame nearest in time, moved along their
measured velocities to the sample's time; unknown velocities are NaN.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.nuscenes.classes import DETECTION_CLASSES
from data_tools.datasets.nuscenes.records import Record, box_fields
from data_tools.datasets.nuscenes.result_files import ResultMeta
from data_tools.files.atomic_files import atomic_directory
from data_tools.simulator.nuscenes_tables import (
    Tables,
    channel_of,
    keyframes,
    nearest_frames,
    sample_tokens,
    scene_tables,
    shared_tables,
)
from data_tools.simulator.scene import SimulatedTraffic
from saga_fg.errors import InputError
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame

CLASSES = ("car", "truck", "bus", "pedestrian")  # of every simulated dataset
BLACK_PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55"
    "0000000a49444154789c636000000002000148afa4710000000049454e44ae426082"
)  # a PNG image of one black pixel


def write_nuscenes(directory: str | Path, dataset: SimulatedTraffic, version: str = "v1.0-mini") -> None:
    """Write all scenes of `dataset` under `directory`; all files appear when the last scene is done.

    Raises `InputError` for a directory that is not writable, and for a version that is not a plain name.
    """
    if not version or Path(version).name != version:
        raise InputError(f"version: expected a plain name such as v1.0-mini, got {version!r}")
    sensors = dataset.settings.sensors
    with atomic_directory(directory) as folder:
        tables: Tables = {}
        classes = dict.fromkeys(CLASSES)
        results: dict[str, dict[str, Any]] = {name: {} for name in sensors}
        for name in dataset.scenes:
            scene = dataset.scene(name)
            for table, records in scene_tables(scene, sensors).items():
                tables.setdefault(table, []).extend(records)
            classes |= dict.fromkeys(
                label for truth in scene.ground_truth or () for label in truth.boxes.label.tolist()
            )
            for sensor, samples in results.items():
                samples.update(_detections(scene, sensor))
        tables |= shared_tables(sensors, list(dataset.scenes), classes)
        (folder / version).mkdir()
        for table, records in tables.items():
            _write_json(folder / version / f"{table}.json", records)
        _write_json(folder / version / "splits.json", {"all": list(dataset.scenes)})
        (folder / "detections").mkdir()
        for sensor, samples in results.items():
            _write_json(folder / "detections" / f"{sensor}.json", {"meta": _meta(sensor), "results": samples})
        (folder / "maps").mkdir()
        (folder / "maps" / "placeholder.png").write_bytes(BLACK_PIXEL)


def _detections(scene: Scene, sensor: str) -> dict[str, list[Record]]:
    """The detections of one sensor at the samples of a scene; samples far from any frame of the sensor are left out."""
    frames = [frame for frame in scene.frames if frame.sensor == sensor]
    times = scene.timestamps[keyframes(scene)]
    nearest = zip(sample_tokens(scene), times.tolist(), nearest_frames(frames, times), strict=True)
    return {sample: _boxes(sample, time, frame) for sample, time, frame in nearest if frame is not None}


def _boxes(sample: str, time: float, frame: Frame) -> list[Record]:
    known = np.isin(frame.detections.boxes.label, DETECTION_CLASSES)  # nuScenes has no traffic lights
    detections = frame.detections.select(known)
    boxes = detections.boxes
    position = boxes.position.copy()
    position[:, :2] += (time - frame.timestamp) * np.nan_to_num(boxes.velocity)
    columns = (boxes.velocity.round(4), boxes.label, detections.score.round(6))
    return [
        {
            "sample_token": sample,
            **box,
            "velocity": velocity,
            "detection_name": label,
            "detection_score": score,
            "attribute_name": "",
        }
        for box, velocity, label, score in zip(
            box_fields(replace(boxes, position=position), 4), *(column.tolist() for column in columns), strict=True
        )
    ]


def _meta(sensor: str) -> dict[str, bool]:
    return asdict(ResultMeta(**{f"use_{channel_of(sensor).modality}": True}))


def _write_json(path: Path, content: object) -> None:
    with path.open("w", encoding="utf-8") as file:
        json.dump(content, file)
