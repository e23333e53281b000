"""Turns that are known when the state is predicted: seen in headings, or of the path that an undetected object is on.

A track that is not detected goes on along its path: that of earlier traffic where there is any
(`saga_fg.tracking.trails`), else that of its own heading and turn. Both are found anew for every interval and recorded
with it (`saga_fg.model.known_turn`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from saga_fg.model.known_turn import KnownTurns, turns_as_known
from saga_fg.model.motion import NodeType
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.box_filter import MOVING
from saga_fg.tracking.kinematics import Kinematics
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.trails import STEP

LEAST_TURN = 0.01  # rad/s; less is straight on: 0.2 m aside in 2 s at 10 m/s, within the noise of a detection
_ASTRAY = 0.5  # rad between heading and motion, from which the motion is noise
_LEAST = 1e-9  # (m/s)^2
LASTING = 1e9  # s; as good as no fading within an interval


def known_turns(state: TrackerState, dt: float, unseen: BoolArray) -> tuple[tuple[KnownTurns, ...], FloatArray]:
    """The turns of tracks within the next `dt` s, by motion and time constant, and the headings after it of those that
    are on a path (n,), rad, NaN for others.

    unseen (n,) tracks that are not detected
    """
    table = state.table
    fading_time, course_time = state.class_values(table.label, "turn_time", "course_time")
    velocity, rate = state.kinematics().velocity, np.where(fading_time > 0, table.turn.known(), 0.0)
    speed = np.hypot(*velocity.T)
    turning = (np.abs(rate) > LEAST_TURN) & (speed > MOVING)
    led = (course_time > 0) & unseen & np.isfinite(table.box.yaw)
    found, heading = [], np.full(len(table), np.nan)
    for node_type, rows in _rows_by_type(state, turning & ~led):
        for time in np.unique(fading_time[rows]).tolist():
            same = rows[fading_time[rows] == time]
            found.append(KnownTurns(node_type, table.id[same], rate[same], time))
    if led.any():
        rate[~turning] = 0.0
        course, rate[led] = _along_paths(state, np.flatnonzero(led), speed[led], rate[led], dt)
        for node_type, rows in _rows_by_type(state, led):
            at = np.searchsorted(np.flatnonzero(led), rows)
            heading[rows] = wrap_angle(course[at] + rate[rows] * dt)
            found.append(KnownTurns(node_type, table.id[rows], rate[rows], LASTING, course[at], 1 / course_time[rows]))
    return tuple(found), heading


def _along_paths(
    state: TrackerState, rows: IntArray, speed: FloatArray, rate: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Course of the paths (k,), rad, and mean turn rate along them within `dt` s (k,), rad/s, of tracks `rows` (k,)."""
    table, now, way = state.table, state.kinematics().select(rows), speed * dt
    steps = max(1, math.ceil(way.max() / STEP))
    heading = _course(table.box.yaw[rows], table.box.yaw_variance[rows], now)
    curvature = rate / np.maximum(speed, MOVING)
    paths = state.trails.paths(table.id[rows], now.position + state.origin, heading, curvature, steps)
    k = np.minimum((way / STEP).astype(np.int64), steps - 1)
    start, share, each = paths.heading[:, 0], way / STEP - k, np.arange(len(rows))
    end = paths.heading[each, k] + share * (paths.heading[each, k + 1] - paths.heading[each, k])
    return start, (end - start) / dt


def _course(yaw: FloatArray, variance: FloatArray, now: Kinematics) -> FloatArray:
    """Mean (k,) of headings (k,), rad, with their variances, and the directions of motion, by information."""
    v, P = now.velocity, now.P_velocity
    across, square = np.stack([-v[:, 1], v[:, 0]], axis=-1), np.maximum((v**2).sum(axis=1), _LEAST)
    off = wrap_angle(np.arctan2(v[:, 1], v[:, 0]) - yaw)
    variance_v = np.einsum("ki,kij,kj->k", across, P, across) / square**2
    return np.asarray(yaw + np.where(np.abs(off) < _ASTRAY, variance / (variance + variance_v), 0.0) * off)


def _rows_by_type(state: TrackerState, chosen: BoolArray) -> Iterator[tuple[NodeType, IntArray]]:
    """The chosen tracks (n,) whose motion is linear, by motion."""
    if not chosen.any():
        return
    for node_type, rows in state.joint.rows_by_type(state.table.label[chosen], moving=True):
        if turns_as_known(node_type):
            yield node_type, np.flatnonzero(chosen)[rows]
