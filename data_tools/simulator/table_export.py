"""Simulated scenes as plain tables (columns as in `detection_files`): detections, with colours of lights, and truth.

detections.csv   a row per detection of every sensor, world coordinates, with the pose of the vehicle
truth.csv        a row per annotated object and keyframe; `id` is its name, `visible` is 1 while a sensor sees it
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.detection_files import write_rows
from saga_fg.numerics.geometry import yaw_of
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame

BOX = ("x", "y", "z", "length", "width", "height", "yaw", "vx", "vy")
DETECTIONS = (
    *("scene", "timestamp", "sensor", "label", *BOX, "range_rate", "score"),
    *("ego_x", "ego_y", "ego_z", "ego_yaw"),
)
TRUTH = ("scene", "timestamp", "id", "label", *BOX, "visible")


def write_tables(folder: Path, scene: Scene) -> None:
    """Write `detections.csv` and `truth.csv` of one simulated scene into an existing folder."""
    write_rows(folder / "detections.csv", DETECTIONS, (row for frame in scene.frames for row in _rows(scene, frame)))
    write_rows(folder / "truth.csv", TRUTH, _truth(scene))


def _rows(scene: Scene, frame: Frame) -> Iterator[list[Any]]:
    pose = frame.world_T_ego
    assert pose is not None
    ego = [*pose[:3, 3].tolist(), yaw_of(pose)]
    start = [scene.name, frame.timestamp, frame.sensor]
    boxes = frame.detections.boxes
    if len(boxes) == 0:
        yield [*start, *[None] * (len(DETECTIONS) - 7), *ego]
    numbers = np.column_stack([boxes.position, boxes.size, boxes.yaw, boxes.velocity])
    numbers = np.column_stack([numbers, frame.detections.range_rate, frame.detections.score])
    for label, values in zip(boxes.label.tolist(), numbers.tolist(), strict=True):
        yield [*start, label, *_known(values), *ego]


def _truth(scene: Scene) -> Iterator[list[Any]]:
    assert scene.ground_truth is not None
    for time, truth in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        boxes = truth.boxes
        numbers = np.column_stack([boxes.position, boxes.size, boxes.yaw, boxes.velocity]).tolist()
        for name, label, values, visible in zip(
            truth.id.tolist(), boxes.label.tolist(), numbers, truth.visible.tolist(), strict=True
        ):
            yield [scene.name, time, name, label, *_known(values), int(visible)]


def _known(values: list[float]) -> list[float | None]:
    return [None if value != value else value for value in values]
