"""How good are tracks? Metrics over ground truth and tracks in memory; they know no files."""

from data_tools.metrics.bootstrap import (
    Interval,
    difference,
    paired_bootstrap,
    ratio_of_sums,
    relative_change,
    root_mean_square,
)
from data_tools.metrics.consistency import coverage, coverages, nees, nees_band
from data_tools.metrics.error_figures import (
    Calibration,
    ErrorFigures,
    calibration,
    error_figures,
    errors_by_class,
)
from data_tools.metrics.error_sample import ErrorSample
from data_tools.metrics.hota import HotaFigures, hota_figures
from data_tools.metrics.kitti_tracking import (
    KittiSimilarity,
    KittiTrackingFigures,
    KittiTrackingSequence,
    kitti_hota_figures,
    kitti_tracking_figures,
)
from data_tools.metrics.label_errors import LabelErrors, label_errors, label_velocities
from data_tools.metrics.matching import Matching, match_scene
from data_tools.metrics.nuscenes_tracking import (
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    RecallCurves,
    TrackingFigures,
    nuscenes_tracking_metrics,
)
from data_tools.metrics.scene import SceneMetrics, SceneMetricSettings, scene_metrics, scene_metrics_by_label
from data_tools.metrics.track_table import TrackTable

__all__ = [
    "Calibration",
    "ErrorFigures",
    "ErrorSample",
    "HotaFigures",
    "Interval",
    "KittiSimilarity",
    "KittiTrackingFigures",
    "KittiTrackingSequence",
    "LabelErrors",
    "Matching",
    "NuScenesTrackingMetrics",
    "NuScenesTrackingScene",
    "NuScenesTrackingSettings",
    "RecallCurves",
    "SceneMetricSettings",
    "SceneMetrics",
    "TrackTable",
    "TrackingFigures",
    "calibration",
    "coverage",
    "coverages",
    "difference",
    "error_figures",
    "errors_by_class",
    "hota_figures",
    "kitti_hota_figures",
    "kitti_tracking_figures",
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
