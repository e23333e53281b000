"""Joint estimation of the vehicle's path and the objects around it."""

from saga_fg.slam.joint.graph import JointEstimate, ObjectStates, estimate_jointly
from saga_fg.slam.joint.odometry_noise import OdometryNoise
from saga_fg.slam.joint.online import OnlinePath
from saga_fg.slam.joint.record import KEYFRAME_PERIOD, JointSettings, OdometryIncrements, in_ego

__all__ = [
    "KEYFRAME_PERIOD",
    "JointEstimate",
    "JointSettings",
    "ObjectStates",
    "OdometryIncrements",
    "OdometryNoise",
    "OnlinePath",
    "estimate_jointly",
    "in_ego",
]
