from .local_map import Innovation, LocalMap, associate, log_odds
from .mapper import (
    AssociatedObservation,
    Given,
    LandmarkObservations,
    MeasuredMotion,
    landmark_key,
    pose_key,
)

__all__ = [
    "AssociatedObservation",
    "Given",
    "Innovation",
    "LandmarkObservations",
    "LocalMap",
    "MeasuredMotion",
    "associate",
    "landmark_key",
    "log_odds",
    "pose_key",
]
