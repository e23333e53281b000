"""Tracks beside the ground truth, as tables, figures for programs and pictures."""

from data_tools.evaluation.evaluation import Evaluation, evaluate_tracks

__all__ = ["Evaluation", "evaluate_tracks"]
