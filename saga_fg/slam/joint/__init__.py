"""Joint estimation of the vehicle's path and the objects around it."""

from saga_fg.slam.joint.association import Observations
from saga_fg.slam.joint.batch import estimate_jointly
from saga_fg.slam.joint.graph import JointEstimate, ObjectStates
from saga_fg.slam.joint.online import OnlineEstimate, OnlineEstimator, OnlineStep, estimate_online
from saga_fg.slam.joint.record import JointSettings, OdometryIncrements, OdometryNoise

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
]
