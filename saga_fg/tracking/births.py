"""Where new tracks start: at their detection, with a velocity measured, or as class and traffic tell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.boxes import Boxes
from saga_fg.tracking.joint_state import Kinematics
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.settings import ClassSettings, class_values
from saga_fg.tracking.traffic_flow import TrafficFlow


def newborn(
    observed: Observed,
    rows: IntArray,
    origin: FloatArray,
    classes: Mapping[str, ClassSettings],
    flow: TrafficFlow | None = None,
) -> Kinematics:
    """The kinematics of tracks born from the detections `rows` (k,), positions from `origin` (2,).

    flow  what traffic around tells of velocities that are not measured
    """
    boxes, measured, R = observed.boxes.select(rows), observed.with_velocity[rows], observed.R[rows]
    velocity, P_velocity = _unmeasured_velocity(boxes, classes, flow)
    return Kinematics(
        boxes.position[:, :2] - origin,
        np.where(measured[:, None], boxes.velocity, velocity),
        R[:, :2, :2],
        np.where(measured[:, None, None], R[:, 2:, 2:], P_velocity),
    )


def _unmeasured_velocity(
    boxes: Boxes, classes: Mapping[str, ClassSettings], flow: TrafficFlow | None
) -> tuple[FloatArray, FloatArray]:
    """Velocity (k, 2) and its covariance (k, 2, 2) by class, heading and traffic."""
    speed, drift = (class_values(classes, name, boxes.label) for name in ("birth_speed", "birth_drift"))
    mean, variance = np.zeros(len(boxes)), speed**2
    if flow is not None:
        mean, variance = flow.speed(boxes.label, boxes.position[:, :2], boxes.yaw, variance)
    known = np.isfinite(boxes.yaw)
    ahead = np.nan_to_num(np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=-1))
    along = np.where(known, variance - drift**2, 0.0)[:, None, None] * (ahead[:, :, None] * ahead[:, None])
    return mean[:, None] * ahead, along + (np.where(known, drift, speed) ** 2)[:, None, None] * np.eye(2)
