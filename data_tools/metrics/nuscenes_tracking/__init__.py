"""The metrics of the nuScenes tracking task, equal to the official evaluation."""

from data_tools.metrics.nuscenes_tracking.class_metrics import NuScenesClassMetrics, RecallCurves
from data_tools.metrics.nuscenes_tracking.evaluation import (
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    nuscenes_tracking_metrics,
)
from data_tools.metrics.nuscenes_tracking.settings import NuScenesTrackingSettings

__all__ = [
    "NuScenesClassMetrics",
    "NuScenesTrackingMetrics",
    "NuScenesTrackingScene",
    "NuScenesTrackingSettings",
    "RecallCurves",
    "nuscenes_tracking_metrics",
]
