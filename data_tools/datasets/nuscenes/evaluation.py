"""A nuScenes tracking result scored: the official figures, errors at labels, calibration, HOTA."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from data_tools.datasets.nuscenes.scored_scenes import ScoredScene
from data_tools.evaluation import Evaluation
from data_tools.evaluation.hota import HotaRow, hota
from data_tools.evaluation.placed_detections import PlacedBoxes, placed_detections
from data_tools.evaluation.score_sweep import best_thresholds, sweep_table
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
from saga_fg.numerics.arrays import FloatArray

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
