"""KITTI 3D multi-object tracking metrics, averaged over recall."""

from data_tools.metrics.kitti_tracking.class_rows import KittiTrackingSequence
from data_tools.metrics.kitti_tracking.evaluation import KittiTrackingFigures, kitti_tracking_figures

__all__ = ["KittiTrackingFigures", "KittiTrackingSequence", "kitti_tracking_figures"]
