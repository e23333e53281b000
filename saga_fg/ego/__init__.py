"""The vehicle in the graph: its path and the objects around it, estimated together."""

from saga_fg.ego.batch import estimate_jointly
from saga_fg.ego.estimate import JointEstimate, ObjectStates
from saga_fg.ego.landmarks import Observations
from saga_fg.ego.lanes import lane_key
from saga_fg.ego.odometry import Odometry, OdometryNoise
from saga_fg.ego.online import OnlineEstimator, OnlineStep
from saga_fg.ego.online_estimate import OnlineEstimate, estimate_online
from saga_fg.ego.settings import JointSettings, LaneSettings

__all__ = [
    "JointEstimate",
    "JointSettings",
    "LaneSettings",
    "ObjectStates",
    "Observations",
    "Odometry",
    "OdometryNoise",
    "OnlineEstimate",
    "OnlineEstimator",
    "OnlineStep",
    "estimate_jointly",
    "estimate_online",
    "lane_key",
]
