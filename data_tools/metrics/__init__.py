"""Metrics of tracks against ground truth, both in memory; they read no files."""

from data_tools.metrics.bootstrap import (
    Interval,
    difference,
    paired_bootstrap,
    ratio_of_sums,
    relative_change,
    root_mean_square,
)
from data_tools.metrics.consistency import coverage, coverages, nees, nees_band
from data_tools.metrics.error_sample import ErrorSample
from data_tools.metrics.error_summary import (
    EllipseCoverage,
    ErrorSummary,
    calibration,
    error_summary,
    errors_by_class,
)
from data_tools.metrics.hota import HotaMetrics, hota_metrics
from data_tools.metrics.kitti_tracking import (
    KittiSimilarity,
    KittiTrackingMetrics,
    KittiTrackingSequence,
    kitti_hota_metrics,
    kitti_tracking_metrics,
)
from data_tools.metrics.label_errors import LabelErrors, label_errors, label_velocities
from data_tools.metrics.matching import FrameMatch, match_scene
from data_tools.metrics.nuscenes_tracking import (
    NuScenesClassMetrics,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    RecallCurves,
    nuscenes_tracking_metrics,
)
from data_tools.metrics.scene import SceneMetrics, SceneMetricSettings, scene_metrics, scene_metrics_by_label
from data_tools.metrics.scene_boxes import SceneBoxes

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
]
