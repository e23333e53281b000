"""Joint estimation of the vehicle's path and the objects around it."""

from saga_fg.slam.joint.batch import estimate_jointly
from saga_fg.slam.joint.estimate import JointEstimate, ObjectStates
from saga_fg.slam.joint.landmarks import Observations
from saga_fg.slam.joint.lanes import lane_key
from saga_fg.slam.joint.odometry import OdometryIncrements, OdometryNoise
from saga_fg.slam.joint.online import OnlineEstimate, OnlineEstimator, OnlineStep, estimate_online
from saga_fg.slam.joint.settings import JointSettings

__all__ = [
    "JointEstimate",
    "JointSettings",
    "ObjectStates",
    "Observations",
    "OdometryIncrements",
    "OdometryNoise",
    "OnlineEstimate",
    "OnlineEstimator",
    "OnlineStep",
    "estimate_jointly",
    "estimate_online",
    "lane_key",
]
