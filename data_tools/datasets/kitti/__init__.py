"""KITTI tracking: official poses, calibration and labels, and detections as text, in; official result text out."""

from data_tools.datasets.kitti.calibration import Calibration, read_calibration
from data_tools.datasets.kitti.dataset import KittiTracking, local_kitti
from data_tools.datasets.kitti.image_boxes import image_boxes, observation_angles
from data_tools.datasets.kitti.labels import read_kitti_labels
from data_tools.datasets.kitti.oxts import read_poses
from data_tools.datasets.kitti.tracking_results import kitti_result_text, write_kitti_results
from data_tools.datasets.kitti.velodyne import KittiScans
from data_tools.kitti_objects import CameraBoxes, KittiObjects, camera_boxes_to_world, has_box, world_boxes_to_camera

__all__ = [
    "Calibration",
    "CameraBoxes",
    "KittiObjects",
    "KittiScans",
    "KittiTracking",
    "camera_boxes_to_world",
    "has_box",
    "image_boxes",
    "kitti_result_text",
    "local_kitti",
    "observation_angles",
    "read_calibration",
    "read_kitti_labels",
    "read_poses",
    "world_boxes_to_camera",
    "write_kitti_results",
]
