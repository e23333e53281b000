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
from data_tools.metrics.error_sample import ErrorSample
from data_tools.metrics.matching import Matching, match_scene
from data_tools.metrics.scene import SceneMetrics, SceneMetricSettings, scene_metrics, scene_metrics_by_label

__all__ = [
    "ErrorSample",
    "Interval",
    "Matching",
    "SceneMetricSettings",
    "SceneMetrics",
    "coverage",
    "coverages",
    "difference",
    "match_scene",
    "nees",
    "nees_band",
    "paired_bootstrap",
    "ratio_of_sums",
    "relative_change",
    "root_mean_square",
    "scene_metrics",
    "scene_metrics_by_label",
]
