from .dataset import NuScenes, nuscenes_scans
from .results import (
    ResultMeta,
    merge_tracking_results,
    read_tracking_results,
    write_tracking_results,
)
from .source import ScoredScene, read_scored_scenes
from .tables import (
    CATEGORY_TO_TRACKING_CLASS,
    DETECTION_CLASSES,
    TRACKING_CLASSES,
    read_table,
    split_scenes,
    table_folder,
)
from .writer import write_nuscenes

__all__ = [
    "CATEGORY_TO_TRACKING_CLASS",
    "DETECTION_CLASSES",
    "TRACKING_CLASSES",
    "NuScenes",
    "ResultMeta",
    "ScoredScene",
    "merge_tracking_results",
    "nuscenes_scans",
    "read_scored_scenes",
    "read_table",
    "read_tracking_results",
    "split_scenes",
    "table_folder",
    "write_nuscenes",
    "write_tracking_results",
]
