"""Evaluations: results of a tracker beside the ground truth, as tables, figures and pictures."""

from pipelines.evaluation.nuscenes import NuScenesEvaluation, evaluate_nuscenes

__all__ = ["NuScenesEvaluation", "evaluate_nuscenes"]
