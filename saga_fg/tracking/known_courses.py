"""Courses of vehicles that are known when the state is predicted: seen in headings, or of the path that they are on.

A track that is not detected goes on along its path: that of earlier traffic where there is any
(`saga_fg.tracking.trails`), else that of its own heading and turn. Both are found anew for every interval and recorded
with it (`saga_fg.model.known_course`).
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.model.known_course import KnownCourses, turning_time
from saga_fg.model.motion import Curvilinear
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.box_filter import MOVING
from saga_fg.tracking.kinematics import Kinematics
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.trails import STEP

COURSE_DEVIATION = 0.04  # rad, of a vehicle from the course of its path: it moves within its lane
_ASTRAY = 0.5  # rad between heading and motion, from which the motion is noise
_LEAST = 1e-9


def known_courses(state: TrackerState, dt: float, unseen: BoolArray) -> tuple[tuple[KnownCourses, ...], FloatArray]:
    """The courses of vehicles with a heading over the next `dt` s, by motion; their turn rates are predicted after.

    Returned as well: the headings after it (n,), rad, of the `unseen` (n,) that keep to their courses, NaN of others.
    """
    table, velocity = state.table, state.kinematics().velocity
    turn_time, found, after = np.zeros(len(table)), [], np.full(len(table), np.nan)
    for node_type, rows in state.joint.rows_by_type(table.label, moving=True):
        motion = node_type.motion
        if not isinstance(motion, Curvilinear):
            continue
        turn_time[rows] = motion.turn_time
        rows = rows[np.isfinite(table.box.yaw[rows])]
        if len(rows) == 0:
            continue
        rate, variance = table.turn.known(rows, motion.turning_share)
        turns = (motion.turn_time > 0) & (np.hypot(*velocity[rows].T) > MOVING)
        rate, variance = np.where(turns, rate, 0.0), np.where(turns, variance, 0.0)
        heading, settling, course_variance = table.box.yaw[rows], np.zeros(len(rows)), np.zeros(len(rows))
        led = np.flatnonzero(unseen[rows]) if motion.course_time > 0 else np.empty(0, dtype=np.int64)
        if len(led):
            heading[led], turn, course_variance[led] = _along_paths(state, rows[led], rate[led], dt)
            after[rows[led]] = wrap_angle(heading[led] + turn)
            rate[led], settling[led] = turn / turning_time(motion, dt), 1 / motion.course_time
        mean = state.joint.estimator.mean(table.id[rows])
        ids = table.id[rows]
        found.append(KnownCourses.of(node_type, ids, heading, rate, variance, mean, dt, settling, course_variance))
    if turn_time.any():
        table.turn.predict(dt, turn_time)
    return tuple(found), after


def _along_paths(
    state: TrackerState, rows: IntArray, rate: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Course of the paths (k,), rad, turn along them within `dt` s (k,), rad, and variance of the course (k,), rad^2,
    of tracks `rows` (k,)."""
    table, now = state.table, state.kinematics().select(rows)
    speed = np.hypot(*now.velocity.T)
    way = speed * dt
    steps = max(1, math.ceil(way.max() / STEP))
    heading = _course(table.box.yaw[rows], table.box.yaw_variance[rows], now)
    curvature = rate / np.maximum(speed, MOVING)
    paths = state.trails.paths(table.id[rows], now.position + state.origin, heading, curvature, steps)
    k = np.minimum((way / STEP).astype(np.int64), steps - 1)
    start, share, each = paths.heading[:, 0], way / STEP - k, np.arange(len(rows))
    end = paths.heading[each, k] + share * (paths.heading[each, k + 1] - paths.heading[each, k])
    return start, end - start, COURSE_DEVIATION**2 + paths.disagreement


def _course(yaw: FloatArray, variance: FloatArray, now: Kinematics) -> FloatArray:
    """Mean (k,) of headings (k,), rad, with their variances, and the directions of motion, by information."""
    v, P = now.velocity, now.P_velocity
    across, square = np.stack([-v[:, 1], v[:, 0]], axis=-1), np.maximum((v**2).sum(axis=1), _LEAST)
    off = wrap_angle(np.arctan2(v[:, 1], v[:, 0]) - yaw)
    variance_v = np.einsum("ki,kij,kj->k", across, P, across) / square**2
    return np.asarray(yaw + np.where(np.abs(off) < _ASTRAY, variance / (variance + variance_v), 0.0) * off)
