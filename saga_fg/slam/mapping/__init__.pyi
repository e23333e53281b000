from .association import associate, log_odds
from .ekf_slam import EkfSlam, Innovation
from .mapper import AssociatedObservation, LandmarkMap, LandmarkMapper, MapperSettings
from .merging import duplicates
from .providers import LandmarkObservations, MeasuredMotion, landmark_key, pose_key

__all__ = [
    "AssociatedObservation",
    "EkfSlam",
    "Innovation",
    "LandmarkMap",
    "LandmarkMapper",
    "LandmarkObservations",
    "MapperSettings",
    "MeasuredMotion",
    "associate",
    "duplicates",
    "landmark_key",
    "log_odds",
    "pose_key",
]
