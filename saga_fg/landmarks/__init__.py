"""Landmarks: their types, which observation is of which, and maps built from them."""

from saga_fg.landmarks.association import associate, log_odds
from saga_fg.landmarks.edge import LaneEdgeLandmark
from saga_fg.landmarks.factors import sighting_factors
from saga_fg.landmarks.joint_estimate import Innovation, JointEstimate
from saga_fg.landmarks.mapper import Landmark, LandmarkMap, LandmarkMapper, MapperSettings, Sighting
from saga_fg.landmarks.merging import duplicates
from saga_fg.landmarks.plane import PlaneLandmark
from saga_fg.landmarks.point import PointLandmark
from saga_fg.landmarks.pole import PoleLandmark
from saga_fg.landmarks.protocol import LandmarkFactors, LandmarkType, Observation

__all__ = [
    "Innovation",
    "JointEstimate",
    "Landmark",
    "LandmarkFactors",
    "LandmarkMap",
    "LandmarkMapper",
    "LandmarkType",
    "LaneEdgeLandmark",
    "MapperSettings",
    "Observation",
    "PlaneLandmark",
    "PointLandmark",
    "PoleLandmark",
    "Sighting",
    "associate",
    "duplicates",
    "log_odds",
    "sighting_factors",
]
