from .hota import HotaMetrics, hota_metrics
from .kitti_tracking import (
    KittiSimilarity,
    KittiTrackingMetrics,
    KittiTrackingSequence,
    kitti_hota_metrics,
    kitti_tracking_metrics,
)
from .label_errors import (
    EllipseCoverage,
    ErrorSample,
    ErrorSummary,
    LabelErrors,
    calibration,
    coverage,
    coverages,
    error_summary,
    errors_by_class,
    label_errors,
    label_velocities,
    nees,
)
from .nuscenes_sweep import NuScenesClassMetrics, RecallCurves
from .nuscenes_tracking import (
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    nuscenes_tracking_metrics,
)
from .scene import FrameMatch, SceneMetrics, match_scene, scene_metrics, scene_metrics_by_label
from .scene_boxes import SceneBoxes

__all__ = [
    "EllipseCoverage",
    "ErrorSample",
    "ErrorSummary",
    "FrameMatch",
    "HotaMetrics",
    "KittiSimilarity",
    "KittiTrackingMetrics",
    "KittiTrackingSequence",
    "LabelErrors",
    "NuScenesClassMetrics",
    "NuScenesTrackingMetrics",
    "NuScenesTrackingScene",
    "NuScenesTrackingSettings",
    "RecallCurves",
    "SceneBoxes",
    "SceneMetrics",
    "calibration",
    "coverage",
    "coverages",
    "error_summary",
    "errors_by_class",
    "hota_metrics",
    "kitti_hota_metrics",
    "kitti_tracking_metrics",
    "label_errors",
    "label_velocities",
    "match_scene",
    "nees",
    "nuscenes_tracking_metrics",
    "scene_metrics",
    "scene_metrics_by_label",
]
