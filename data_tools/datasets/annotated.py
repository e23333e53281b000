"""Recordings that have ground truth and no detections: these come from a table, or from the annotations."""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace

import numpy as np

from data_tools.datasets.detection_files import read_detections
from data_tools.datasets.source import ChosenScenes, DatasetSource, option
from data_tools.files import local_copy
from saga_fg.errors import InputError
from saga_fg.tables import DetectionTable
from saga_fg.types import Dataset, Detections, Frame, Scene

SENSOR = "annotations"


@dataclass(frozen=True, kw_only=True)
class AnnotatedSource(DatasetSource):
    """Annotated recordings; without a table, detections are the visible boxes without identities and velocities."""

    detections: str | None = option(
        "Table of detections (.csv, .ndjson, .jsonl, .npz), s from the recording's first moment; without it, what is "
        "annotated and visible is detected, without identities and velocities.",
        None,
        metavar="TABLE",
    )
    scenes: str | None = option("Recordings with commas between them; all if left out.", None)

    @abstractmethod
    def annotated(self) -> AbstractContextManager[Dataset]:
        """The recordings with their ground truth, without frames."""

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        with self.annotated() as recordings:
            dataset = recordings if self.scenes is None else ChosenScenes(recordings, self.scenes)
            if self.detections is None:
                yield DetectedScenes(dataset, None)
            else:
                with local_copy(self.detections) as path:
                    yield DetectedScenes(dataset, read_detections(path))


class DetectedScenes:
    """The scenes of a dataset with the detections of a table, or with their annotations as detections."""

    def __init__(self, dataset: Dataset, table: DetectionTable | None) -> None:
        self._dataset, self._table = dataset, table
        self.scenes = dataset.scenes

    def scene(self, name: str) -> Scene:
        """Read one of the scenes; raises `InputError` where the table does not have it."""
        scene = self._dataset.scene(name)
        return replace(scene, frames=detected(scene) if self._table is None else self._table.scene(name).frames)


def detected(scene: Scene) -> list[Frame]:
    """A frame for each moment, of sensor "annotations": its visible boxes, of score 1, without ids and velocities.

    Where moments are missing, since nothing is annotated, there are empty frames at the pace of the others. Raises
    `InputError` for a scene without ground truth.
    """
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth to take detections from")
    frames: list[Frame] = []
    period = float(np.median(np.diff(scene.timestamps))) if len(scene) > 1 else np.inf
    for time, pose, truth in zip(scene.timestamps.tolist(), scene.world_T_ego, scene.ground_truth, strict=True):
        if frames:
            last = frames[-1]
            missing = np.arange(1, round((time - last.timestamp) / period)) * period + last.timestamp
            frames += [Frame(at, SENSOR, Detections.empty(), last.world_T_ego) for at in missing.tolist()]
        boxes = truth.boxes.select(truth.visible)
        unknown = replace(boxes, velocity=np.full((len(boxes), 2), np.nan))
        frames.append(Frame(time, SENSOR, Detections(unknown, np.ones(len(boxes))), pose))
    return frames
