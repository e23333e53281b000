"""nuScenes: the official tables and detection results in, official tracking results out."""

from data_tools.datasets.nuscenes.classes import CATEGORY_TO_TRACKING_CLASS, DETECTION_CLASSES, TRACKING_CLASSES
from data_tools.datasets.nuscenes.dataset import NuScenes
from data_tools.datasets.nuscenes.result_files import ResultMeta
from data_tools.datasets.nuscenes.scans import NuScenesScans, nuscenes_scans
from data_tools.datasets.nuscenes.scored_scenes import ScoredScene, read_scored_scenes
from data_tools.datasets.nuscenes.splits import split_scenes
from data_tools.datasets.nuscenes.tracking_results import (
    TrackedBoxes,
    TrackingResults,
    merge_tracking_results,
    read_tracking_results,
    write_tracking_results,
)

__all__ = [
    "CATEGORY_TO_TRACKING_CLASS",
    "DETECTION_CLASSES",
    "TRACKING_CLASSES",
    "NuScenes",
    "NuScenesScans",
    "ResultMeta",
    "ScoredScene",
    "TrackedBoxes",
    "TrackingResults",
    "merge_tracking_results",
    "nuscenes_scans",
    "read_scored_scenes",
    "read_tracking_results",
    "split_scenes",
    "write_tracking_results",
]
