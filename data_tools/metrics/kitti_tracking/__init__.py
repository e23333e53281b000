"""KITTI 3D multi-object tracking metrics, averaged over recall."""

from data_tools.metrics.kitti_tracking.class_boxes import KittiTrackingSequence
from data_tools.metrics.kitti_tracking.evaluated_objects import KittiSimilarity, kitti_hota_metrics
from data_tools.metrics.kitti_tracking.evaluation import KittiTrackingMetrics, kitti_tracking_metrics

__all__ = [
    "KittiSimilarity",
    "KittiTrackingMetrics",
    "KittiTrackingSequence",
    "kitti_hota_metrics",
    "kitti_tracking_metrics",
]
