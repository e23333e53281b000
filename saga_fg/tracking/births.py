"""Where new tracks start: at their detection, with a velocity measured, or as class and traffic tell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.tracking.joint_state import Kinematics
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.settings import ClassSettings
from saga_fg.tracking.standing import after_evidence, log_density
from saga_fg.tracking.traffic_flow import TrafficFlow
from saga_fg.types.boxes import Boxes
from saga_fg.types.by_class import class_values


def newborn(
    observed: Observed,
    rows: IntArray,
    origin: FloatArray,
    classes: Mapping[str, ClassSettings],
    flow: TrafficFlow,
    standing: float = 0.0,
) -> tuple[Kinematics, FloatArray]:
    """The kinematics of tracks born from the detections `rows` (k,), if they move; and the belief (k,) that they stand.

    origin    (2,) that positions are from
    flow      what traffic around tells of velocities that are not measured
    standing  the belief that an object stands of which nothing is known
    """
    boxes, measured, R = observed.boxes.select(rows), observed.with_velocity[rows], observed.R[rows]
    velocity, P_velocity, stands = _unmeasured_velocity(boxes, classes, flow, standing)
    if standing > 0:
        z, R_v = np.nan_to_num(boxes.velocity), R[:, 2:, 2:]
        seen = after_evidence(stands, log_density(z, R_v) - log_density(z - velocity, P_velocity + R_v))
        stands = np.where(measured, seen, stands)
    kinematics = Kinematics(
        boxes.position[:, :2] - origin,
        np.where(measured[:, None], boxes.velocity, velocity),
        R[:, :2, :2],
        np.where(measured[:, None, None], R[:, 2:, 2:], P_velocity),
    )
    return kinematics, stands


def _unmeasured_velocity(
    boxes: Boxes, classes: Mapping[str, ClassSettings], flow: TrafficFlow, standing: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Velocity (k, 2), its covariance (k, 2, 2) and the belief (k,) to stand, by class, heading and traffic."""
    speed, drift = class_values(
        classes, ClassSettings, boxes.label, "initial_speed_deviation", "initial_lateral_speed_deviation"
    )
    stands, mean, variance = flow.expected(boxes.label, boxes.position[:, :2], boxes.yaw, speed**2, standing)
    known = np.isfinite(boxes.yaw)
    ahead = np.nan_to_num(np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=-1))
    along = np.where(known, variance - drift**2, 0.0)[:, None, None] * (ahead[:, :, None] * ahead[:, None])
    P = along + (np.where(known, drift, speed) ** 2)[:, None, None] * np.eye(2)
    return mean[:, None] * ahead, P, stands
