from .calibration import Calibration, read_calibration
from .dataset import KittiTracking, local_kitti
from .image_boxes import image_boxes, observation_angles
from .labels import read_kitti_labels
from .oxts import read_poses
from .tracking_results import kitti_result_text, write_kitti_results
from .velodyne import KittiScans

__all__ = [
    "Calibration",
    "KittiScans",
    "KittiTracking",
    "image_boxes",
    "kitti_result_text",
    "local_kitti",
    "observation_angles",
    "read_calibration",
    "read_kitti_labels",
    "read_poses",
    "write_kitti_results",
]
