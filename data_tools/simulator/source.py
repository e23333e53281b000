"""Simulated traffic as a dataset of the command, and as plain tables.

Simulated scenes as plain tables (columns as in `detection_files`): detections, with colours of lights, and truth.

detections.csv   a row per detection of every sensor, world coordinates, with the pose of the vehicle
truth.csv        a row per annotated object and keyframe; `id` is its name, `visible` is 1 while a sensor sees it
"""

import hashlib
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from data_tools.datasets.detection_files import write_rows
from data_tools.datasets.source import DatasetSource, HeldScene, OpenedPart, Parts, option
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.world import SimulatedTraffic
from saga_fg.numerics import yaw_of
from saga_fg.types import Dataset, Frame, Scene


@dataclass(frozen=True, kw_only=True)
class SimulatedSource(DatasetSource):
    """Simulated traffic, whose ground truth has the hidden objects too."""

    name = "simulated"
    family = "simulated"
    example = "--scenes 2 --seed 0"
    scenes: int = option("Number of scenes.", 4, least=1)
    seed: int = option("The same seed makes the same scenes.", 0, least=0)
    simulator: SimulatorSettings | None = option("YAML file; see `saga-fg config --simulator`.", None, metavar="FILE")

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        yield SimulatedTraffic(self.simulator, self.scenes, self.seed)

    def restricted(self, scenes: Collection[str]) -> Self:
        numbers = (re.fullmatch(r"scene-([0-9]{4,6})", name) for name in scenes)
        last = max((int(number[1]) for number in numbers if number), default=1)
        return replace(self, scenes=max(last, 1))

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        scenes = SimulatedTraffic(self.simulator, self.scenes, self.seed).scenes
        yield Parts(scenes, (SimulatedScene(self, name) for name in scenes))


@dataclass(frozen=True)
class SimulatedScene:
    """Scene `name` of simulated traffic, made at the worker."""

    source: SimulatedSource
    name: str

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digest of the settings, seed and name."""
        made_from = f"{self.source.simulator or SimulatorSettings()!r} {self.source.seed} {self.name}"
        yield OpenedPart({"simulator": hashlib.sha256(made_from.encode()).hexdigest()}, self._read)

    def _read(self) -> Dataset:
        source = self.source
        return HeldScene(SimulatedTraffic(source.simulator, source.scenes, source.seed).scene(self.name))


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
