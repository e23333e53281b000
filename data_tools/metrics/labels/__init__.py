"""How good are labels? Detections, online tracks and smoothed labels side by side, and what they say without truth."""

from data_tools.metrics.labels.precision_recall import PrecisionRecall, precision_recall, scored_pairs
from data_tools.metrics.labels.same_boxes import (
    QUANTITIES,
    LabelledScene,
    SameBoxes,
    same_boxes,
)
from data_tools.metrics.labels.self_consistency import SelfConsistency, self_consistency

__all__ = [
    "QUANTITIES",
    "LabelledScene",
    "PrecisionRecall",
    "SameBoxes",
    "SelfConsistency",
    "precision_recall",
    "same_boxes",
    "scored_pairs",
    "self_consistency",
]
