from .class_metrics import NuScenesClassMetrics, RecallCurves
from .evaluation import (
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
