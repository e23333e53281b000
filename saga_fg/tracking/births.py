"""Where new tracks start: at their detection, with a velocity that is measured or as uncertain as the class says."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.boxes import Boxes
from saga_fg.tracking.joint_state import Kinematics
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.settings import ClassSettings, class_values


def newborn(observed: Observed, rows: IntArray, origin: FloatArray, classes: Mapping[str, ClassSettings]) -> Kinematics:
    """The kinematics of tracks born from the detections `rows` (k,), positions from `origin` (2,)."""
    boxes, measured, R = observed.boxes.select(rows), observed.with_velocity[rows], observed.R[rows]
    return Kinematics(
        boxes.position[:, :2] - origin,
        np.where(measured[:, None], boxes.velocity, 0.0),
        R[:, :2, :2],
        np.where(measured[:, None, None], R[:, 2:, 2:], _unknown_velocity(boxes, classes)),
    )


def _unknown_velocity(boxes: Boxes, classes: Mapping[str, ClassSettings]) -> FloatArray:
    """Covariance (k, 2, 2) of a velocity that nothing is known of but the class and the heading."""
    speed, drift = (class_values(classes, name, boxes.label) for name in ("birth_speed", "birth_drift"))
    ahead = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=-1)
    known = np.isfinite(boxes.yaw)
    along = np.where(known, speed**2 - drift**2, 0.0)[:, None, None] * np.nan_to_num(ahead[:, :, None] * ahead[:, None])
    return np.asarray(along + (np.where(known, drift, speed) ** 2)[:, None, None] * np.eye(2))
