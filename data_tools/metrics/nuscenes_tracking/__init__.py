"""The metrics of the nuScenes tracking task, equal to the official evaluation."""

from data_tools.metrics.nuscenes_tracking.evaluation import (
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    nuscenes_tracking_metrics,
)
from data_tools.metrics.nuscenes_tracking.figures import RecallCurves, TrackingFigures
from data_tools.metrics.nuscenes_tracking.settings import NuScenesTrackingSettings

__all__ = [
    "NuScenesTrackingMetrics",
    "NuScenesTrackingScene",
    "NuScenesTrackingSettings",
    "RecallCurves",
    "TrackingFigures",
    "nuscenes_tracking_metrics",
]
