from .association import NearbyLandmarks, associate, duplicates, log_odds, place_of
from .local_map import Innovation, LocalMap
from .mapper import (
    AssociatedObservation,
    Given,
    LandmarkMap,
    LandmarkMapper,
    LandmarkObservations,
    MapperSettings,
    MeasuredMotion,
    landmark_key,
    pose_key,
)

__all__ = [
    "AssociatedObservation",
    "Given",
    "Innovation",
    "LandmarkMap",
    "LandmarkMapper",
    "LandmarkObservations",
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
