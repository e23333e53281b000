"""KITTI 3D multi-object tracking metrics, averaged over recall."""

from data_tools.metrics.kitti_tracking.class_rows import KittiTrackingSequence
from data_tools.metrics.kitti_tracking.evaluation import KittiTrackingFigures, kitti_tracking_figures
from data_tools.metrics.kitti_tracking.judged_objects import KittiSimilarity, kitti_hota_figures

__all__ = [
    "KittiSimilarity",
    "KittiTrackingFigures",
    "KittiTrackingSequence",
    "kitti_hota_figures",
    "kitti_tracking_figures",
]
