from .bootstrap import (
    Interval,
    difference,
    paired_bootstrap,
    ratio_of_sums,
    relative_change,
    root_mean_square,
)
from .consistency import coverage, coverages, nees, nees_band
from .error_sample import ErrorSample
from .error_summary import (
    EllipseCoverage,
    ErrorSummary,
    calibration,
    error_summary,
    errors_by_class,
)
from .hota import HotaMetrics, hota_metrics
from .kitti_tracking import (
    KittiSimilarity,
    KittiTrackingMetrics,
    KittiTrackingSequence,
    kitti_hota_metrics,
    kitti_tracking_metrics,
)
from .label_errors import LabelErrors, label_errors, label_velocities
from .matching import FrameMatch, match_scene
from .nuscenes_tracking import (
    NuScenesClassMetrics,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    RecallCurves,
    nuscenes_tracking_metrics,
)
from .scene import SceneMetrics, SceneMetricSettings, scene_metrics, scene_metrics_by_label
from .scene_boxes import SceneBoxes
from .track_quality import TrackSummary, WholeTracks, track_summaries, whole_tracks

__all__ = [
    "EllipseCoverage",
    "ErrorSample",
    "ErrorSummary",
    "FrameMatch",
    "HotaMetrics",
    "Interval",
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
    "SceneMetricSettings",
    "SceneMetrics",
    "TrackSummary",
    "WholeTracks",
    "calibration",
    "coverage",
    "coverages",
    "difference",
    "error_summary",
    "errors_by_class",
    "hota_metrics",
    "kitti_hota_metrics",
    "kitti_tracking_metrics",
    "label_errors",
    "label_velocities",
    "match_scene",
    "nees",
    "nees_band",
    "nuscenes_tracking_metrics",
    "paired_bootstrap",
    "ratio_of_sums",
    "relative_change",
    "root_mean_square",
    "scene_metrics",
    "scene_metrics_by_label",
    "track_summaries",
    "whole_tracks",
]
