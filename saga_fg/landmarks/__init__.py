"""Landmarks: their types, which observation is of which, and maps built from them."""

from saga_fg.landmarks.association import associate, log_odds
from saga_fg.landmarks.edge import LaneEdgeLandmark
from saga_fg.landmarks.joint_estimate import Innovation, JointEstimate
from saga_fg.landmarks.mapper import LandmarkMap, LandmarkMapper, MapperSettings, Sighting
from saga_fg.landmarks.merging import duplicates
from saga_fg.landmarks.plane import PlaneLandmark
from saga_fg.landmarks.point import PointLandmark
from saga_fg.landmarks.pole import PoleLandmark
from saga_fg.landmarks.protocol import Landmark, LandmarkDetector, LandmarkFactors, LandmarkType, Observation
from saga_fg.landmarks.providers import MeasuredMotion, Sightings, landmark_key, pose_key

__all__ = [
    "Innovation",
    "JointEstimate",
    "Landmark",
    "LandmarkDetector",
    "LandmarkFactors",
    "LandmarkMap",
    "LandmarkMapper",
    "LandmarkType",
    "LaneEdgeLandmark",
    "MapperSettings",
    "MeasuredMotion",
    "Observation",
    "PlaneLandmark",
    "PointLandmark",
    "PoleLandmark",
    "Sighting",
    "Sightings",
    "associate",
    "duplicates",
    "landmark_key",
    "log_odds",
    "pose_key",
]
