"""A tracking result file beside the ground truth of its scenes, ready for the nuScenes tracking metrics."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.nuscenes.bicycle_racks import read_bicycle_racks
from data_tools.datasets.nuscenes.dataset import NuScenes
from data_tools.datasets.nuscenes.scenes import SceneRecord
from data_tools.datasets.nuscenes.tracking_results import MAX_BOXES, TrackingResults, read_tracking_results
from data_tools.datasets.results import SceneResult
from data_tools.metrics.nuscenes_tracking import NuScenesTrackingScene
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.errors import InputError
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations


@dataclass(frozen=True, eq=False)
class ScoredScene(SceneResult):
    """One scene: also as the official metrics compare it."""

    tracking: NuScenesTrackingScene


def read_scored_scenes(
    result: str | Path,
    dataroot: str | Path,
    version: str,
    scenes: Collection[str] | None = None,
    detections: Mapping[str, str | Path] | None = None,
) -> dict[str, ScoredScene]:
    """The chosen scenes by name (None: all), each with its ground truth and the tracks that file `result` has for it.

    detections  files by sensor, as `NuScenes` takes them

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes or has more
    than 500 boxes in one: the official evaluation takes neither.
    """
    dataset = NuScenes(dataroot, version, detections or {}, scenes, ground_truth=True)
    found = read_tracking_results(result)
    racks = read_bicycle_racks(dataset.folder, dataset.records)
    read = {name: dataset.scene(name) for name in dataset.scenes}
    scored = {
        name: _scored(str(result), dataset.records[name], scene.ground_truth or (), racks[name], found)
        for name, scene in read.items()
    }
    return {name: ScoredScene(read[name], tracking.found, tracking) for name, tracking in scored.items()}


def _scored(
    path: str, record: SceneRecord, truth: Sequence[Annotations], racks: Sequence[Boxes], found: TrackingResults
) -> NuScenesTrackingScene:
    for token in record.tokens:
        if token not in found.samples:
            raise InputError(f"{path}: expected every sample of scene {record.name}, {token} is missing")
        if len(found.samples[token]) > MAX_BOXES:
            raise InputError(f"{path}: sample {token}: expected at most {MAX_BOXES} boxes")
    samples = [found.samples[token] for token in record.tokens]
    return NuScenesTrackingScene(
        timestamps=record.timestamps,
        ego_position=record.world_T_ego[:, :2, 3],
        truth=SceneBoxes.of_annotations(truth, hidden=False),
        found=SceneBoxes(
            np.repeat(np.arange(len(samples)), [len(sample) for sample in samples]),
            np.concatenate([sample.id for sample in samples]),
            Boxes.concatenate([sample.boxes for sample in samples]),
            np.concatenate([sample.score for sample in samples]),
            np.concatenate([sample.position_covariance for sample in samples]),
        ),
        racks=racks,
    )
