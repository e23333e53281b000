from .classes import CATEGORY_TO_TRACKING_CLASS, DETECTION_CLASSES, TRACKING_CLASSES
from .dataset import NuScenes
from .result_files import ResultMeta
from .scans import NuScenesScans, nuscenes_scans
from .scene_writer import write_nuscenes
from .scored_scenes import ScoredScene, read_scored_scenes
from .splits import split_scenes
from .tracking_results import (
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
    "write_nuscenes",
    "write_tracking_results",
]
