"""The metrics of the nuScenes tracking task, equal to the official evaluation."""

from data_tools.metrics.nuscenes_tracking.class_metrics import NuScenesClassMetrics, RecallCurves
from data_tools.metrics.nuscenes_tracking.evaluation import (
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    nuscenes_tracking_metrics,
)

__all__ = [
    "NuScenesClassMetrics",
    "NuScenesTrackingMetrics",
    "NuScenesTrackingScene",
    "NuScenesTrackingSettings",
    "RecallCurves",
    "nuscenes_tracking_metrics",
]
