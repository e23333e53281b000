"""Datasets, simulator, LiDAR geometry, metrics, export and plots of saga-fg."""

from data_tools.datasets.detection_files import DetectionFile, read_detections, write_tracks
from data_tools.datasets.kitti import KittiTracking, write_kitti_results
from data_tools.datasets.nuscenes import NuScenes, read_tracking_results, split_scenes, write_tracking_results

__all__ = [
    "DetectionFile",
    "KittiTracking",
    "NuScenes",
    "read_detections",
    "read_tracking_results",
    "split_scenes",
    "write_kitti_results",
    "write_tracking_results",
    "write_tracks",
]
