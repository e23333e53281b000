"""A tracking result file beside the ground truth of its scenes, ready for the nuScenes tracking metrics."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from data_tools.metrics.nuscenes_tracking import NuScenesTrackingScene
from data_tools.metrics.track_table import TrackTable
from data_tools.nuscenes.annotations import read_annotations
from data_tools.nuscenes.bicycle_racks import read_bicycle_racks
from data_tools.nuscenes.scenes import SceneRecord, read_scenes
from data_tools.nuscenes.tables import table_folder
from data_tools.nuscenes.tracking_results import MAX_BOXES, TrackingResults, read_tracking_results
from saga_fg.boxes import Boxes
from saga_fg.dataset import Annotations
from saga_fg.errors import InputError


def read_scored_scenes(
    result: str | Path, dataroot: str | Path, version: str, scenes: Collection[str] | None = None
) -> dict[str, NuScenesTrackingScene]:
    """The chosen scenes by name (None: all), each with its ground truth and the tracks that file `result` has for it.

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes or has more
    than 500 boxes in one: the official evaluation takes neither.
    """
    folder = table_folder(dataroot, version)
    records = read_scenes(folder, scenes).records
    found = read_tracking_results(result)
    truth, racks = read_annotations(folder, records), read_bicycle_racks(folder, records)
    return {name: _scored(str(result), record, truth[name], racks[name], found) for name, record in records.items()}


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
        truth=TrackTable.of_annotations(truth, hidden=False),
        found=TrackTable(
            np.repeat(np.arange(len(samples)), [len(sample) for sample in samples]),
            np.concatenate([sample.id for sample in samples]),
            Boxes.concatenate([sample.boxes for sample in samples]),
            np.concatenate([sample.score for sample in samples]),
            np.concatenate([sample.position_covariance for sample in samples]),
        ),
        racks=racks,
    )
