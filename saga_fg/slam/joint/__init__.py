"""Joint estimation of the vehicle's path and the objects around it."""

from saga_fg.slam.joint.graph import JointEstimate, ObjectStates, estimate_jointly
from saga_fg.slam.joint.record import JointSettings, OdometryIncrements

__all__ = [
    "JointEstimate",
    "JointSettings",
    "ObjectStates",
    "OdometryIncrements",
    "estimate_jointly",
]
