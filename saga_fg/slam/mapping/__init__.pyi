from .association import LandmarkSettings, associate, log_odds
from .local_map import Innovation, LocalMap
from .mapper import AssociatedObservation, LandmarkMap, LandmarkMapper, MapperSettings
from .merging import duplicates
from .nearby import NearbyLandmarks, place_of
from .providers import LandmarkObservations, MeasuredMotion, landmark_key, pose_key

__all__ = [
    "AssociatedObservation",
    "Innovation",
    "LandmarkMap",
    "LandmarkMapper",
    "LandmarkObservations",
    "LandmarkSettings",
    "LocalMap",
    "MapperSettings",
    "MeasuredMotion",
    "NearbyLandmarks",
    "associate",
    "duplicates",
    "landmark_key",
    "log_odds",
    "place_of",
    "pose_key",
]
