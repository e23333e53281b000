from .association import associate, log_odds
from .joint_estimate import Innovation, JointEstimate
from .mapper import LandmarkMap, LandmarkMapper, MapperSettings, Sighting
from .merging import duplicates
from .providers import MeasuredMotion, Sightings, landmark_key, pose_key

__all__ = [
    "Innovation",
    "JointEstimate",
    "LandmarkMap",
    "LandmarkMapper",
    "MapperSettings",
    "MeasuredMotion",
    "Sighting",
    "Sightings",
    "associate",
    "duplicates",
    "landmark_key",
    "log_odds",
    "pose_key",
]
