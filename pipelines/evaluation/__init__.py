"""Evaluations: results of a tracker beside the ground truth, as tables, figures and pictures."""

from pipelines.evaluation.kitti import KittiEvaluation, evaluate_kitti
from pipelines.evaluation.labels import LabelEvaluation, evaluate_labels
from pipelines.evaluation.nuscenes import NuScenesEvaluation, evaluate_nuscenes
from pipelines.evaluation.simulated import SimulatedEvaluation, evaluate_simulated

__all__ = [
    "KittiEvaluation",
    "LabelEvaluation",
    "NuScenesEvaluation",
    "SimulatedEvaluation",
    "evaluate_kitti",
    "evaluate_labels",
    "evaluate_nuscenes",
    "evaluate_simulated",
]
