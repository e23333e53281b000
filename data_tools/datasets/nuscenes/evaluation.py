"""A nuScenes tracking result beside the ground truth of its scenes, and its figures."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.nuscenes.dataset import NuScenes
from data_tools.datasets.nuscenes.results import MAX_BOXES, ResultBoxes, read_tracking_results
from data_tools.datasets.nuscenes.tables import SceneRecord, read_annotations
from data_tools.datasets.results import SceneResult
from data_tools.evaluation import (
    Evaluation,
    HotaRow,
    PlacedBoxes,
    best_thresholds,
    hota,
    placed_detections,
    sweep_table,
)
from data_tools.metrics import (
    LabelErrors,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    SceneBoxes,
    WholeTracks,
    label_errors,
    label_velocities,
    nuscenes_tracking_metrics,
    whole_tracks,
)
from data_tools.plots import recall_sweep
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
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
    found = read_tracking_results(result).samples
    racks = read_annotations(dataset.folder, dataset.records, {"static_object.bicycle_rack": "bicycle_rack"})
    scored = {}
    for name in dataset.scenes:
        scene = dataset.scene(name)
        truth = scene.ground_truth or ()
        tracking = _scored(str(result), dataset.records[name], truth, [each.boxes for each in racks[name]], found)
        scored[name] = ScoredScene(scene, tracking.found, tracking)
    return scored


def _scored(
    path: str,
    record: SceneRecord,
    truth: Sequence[Annotations],
    racks: Sequence[Boxes],
    found: Mapping[str, ResultBoxes],
) -> NuScenesTrackingScene:
    for token in record.tokens:
        if token not in found:
            raise InputError(f"{path}: expected every sample of scene {record.name}, {token} is missing")
        if len(found[token]) > MAX_BOXES:
            raise InputError(f"{path}: sample {token}: expected at most {MAX_BOXES} boxes")
    samples = [found[token] for token in record.tokens]
    tracks = ResultBoxes.concatenate(samples)
    frame = np.repeat(np.arange(len(samples)), [len(sample) for sample in samples])
    return NuScenesTrackingScene(
        timestamps=record.timestamps,
        ego_position=record.world_T_ego[:, :2, 3],
        truth=SceneBoxes.of_annotations(truth, hidden=False),
        found=SceneBoxes(frame, tracks.id, tracks.boxes, tracks.score, tracks.position_covariance),
        racks=racks,
    )


REACH = 1  # keyframes to either side for a label's velocity, 0.5 s


def evaluate_nuscenes(
    scored: Mapping[str, ScoredScene], with_hota: bool = False, innovations: Mapping[str, FloatArray] | None = None
) -> Evaluation:
    """Score the tracks of the scenes that were read; errors are those at the labels that their detections match.

    innovations  of the journal of the run, by class, to be among the figures

    Raises `MissingExtraError` for HOTA without trackeval.
    """
    tracking = nuscenes_tracking_metrics([each.tracking for each in scored.values()])
    return Evaluation(
        sweep_table("nuScenes tracking metrics; AMOTP, MOTP in m, TID, LGD in s", tracking),
        {
            "scenes": tuple(scored),
            "overall": tracking.overall,
            "per_class": tracking.per_class,
            "curves": tracking.curves,
        },
        LabelErrors.pool(
            nuscenes_label_errors(each.tracking, placed_detections(each.scene) if each.scene.frames else None)
            for each in scored.values()
        ),
        WholeTracks.concatenate([whole_tracks(each.tracking.truth, each.tracking.found) for each in scored.values()]),
        nuscenes_hota([each.tracking for each in scored.values()], tracking) if with_hota else (),
        innovations or {},
        lambda: {"recall": recall_sweep(tracking.curves)},
    )


def nuscenes_hota(scenes: Sequence[NuScenesTrackingScene], tracking: NuScenesTrackingMetrics) -> list[HotaRow]:
    """HOTA, at the scores of the best MOTA. Raises `MissingExtraError` without trackeval."""
    return hota([_in_range(scene) for scene in scenes], best_thresholds(tracking))


def nuscenes_label_errors(scene: NuScenesTrackingScene, detections: PlacedBoxes | None = None) -> LabelErrors:
    """The errors at the labels of one scene, those without a LiDAR or radar point left out."""
    velocity = label_velocities(scene.truth, scene.timestamps, REACH)
    return label_errors(scene.truth, scene.found, velocity, detections)


def _in_range(scene: NuScenesTrackingScene) -> tuple[SceneBoxes, SceneBoxes]:
    """Truth and tracks within the distance from the vehicle up to which their class is scored."""
    limits = NuScenesTrackingSettings().class_range

    def near(table: SceneBoxes) -> SceneBoxes:
        reach = np.array([limits.get(label, 0.0) for label in table.boxes.label.tolist()])
        offset = table.boxes.position[:, :2] - scene.ego_position[table.frame]
        return table.select(np.flatnonzero(np.hypot(offset[:, 0], offset[:, 1]) < reach))

    return near(scene.truth), near(scene.found)
