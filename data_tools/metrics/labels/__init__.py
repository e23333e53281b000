"""Metrics of labels: detections, online tracks and smoothed labels against ground truth, and without it."""

from data_tools.metrics.labels.common_boxes import (
    QUANTITIES,
    CommonBoxes,
    LabelledScene,
    common_boxes,
)
from data_tools.metrics.labels.precision_recall import PrecisionRecall, precision_recall, scored_pairs
from data_tools.metrics.labels.self_consistency import SelfConsistency, self_consistency

__all__ = [
    "QUANTITIES",
    "CommonBoxes",
    "LabelledScene",
    "PrecisionRecall",
    "SelfConsistency",
    "common_boxes",
    "precision_recall",
    "scored_pairs",
    "self_consistency",
]
