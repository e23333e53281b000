from .association import associate, log_odds
from .edge import LaneEdgeLandmark
from .joint_estimate import Innovation, JointEstimate
from .mapper import LandmarkMap, LandmarkMapper, MapperSettings, Sighting
from .merging import duplicates
from .plane import PlaneLandmark
from .point import PointLandmark
from .pole import PoleLandmark
from .protocol import Landmark, LandmarkDetector, LandmarkFactors, LandmarkType, Observation
from .providers import MeasuredMotion, Sightings, landmark_key, pose_key

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
