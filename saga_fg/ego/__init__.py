"""The vehicle in the graph: its path and the objects around it, estimated together."""

from saga_fg.ego.batch import estimate_jointly
from saga_fg.ego.estimate import JointEstimate, ObjectStates
from saga_fg.ego.landmarks import Observations
from saga_fg.ego.odometry import Odometry, OdometryNoise
from saga_fg.ego.settings import JointSettings

__all__ = [
    "JointEstimate",
    "JointSettings",
    "ObjectStates",
    "Observations",
    "Odometry",
    "OdometryNoise",
    "estimate_jointly",
]
