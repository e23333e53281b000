from .dataset import (
    Calibration,
    KittiTracking,
    kitti_scans,
    local_kitti,
    read_calibration,
    read_origin,
    read_poses,
    read_transform,
)
from .labels import image_boxes, observation_angles, read_kitti_labels
from .source import kitti_result_text, write_kitti_results

__all__ = [
    "Calibration",
    "KittiTracking",
    "image_boxes",
    "kitti_result_text",
    "kitti_scans",
    "local_kitti",
    "observation_angles",
    "read_calibration",
    "read_kitti_labels",
    "read_origin",
    "read_poses",
    "read_transform",
    "write_kitti_results",
]
