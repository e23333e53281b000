r"""Headings without flips: the axis of a box is smoothed, then one decision per object says which end is the front.

A detector's heading is often off by half a turn, but its axis is good; where an object moves, so is the direction of
its velocity. Both are read modulo pi. The front is where the motion goes, each metre a vote,

    sum_k |v_k| dt cos(course_k - axis_k)

where that comes to at least `TELLING_PATH`, else where most of the detections, weighted by probability, see it. A
vehicle that backs out of a bay and drives away is right in the longer part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.random_walk import ScalarReadings, previous_rows, scalar_readings, smooth_walks
from saga_fg.smoothing.states import Lives, StateTable

TELLING_PATH = 10.0  # m
CLEAR = 3.0  # standard deviations by which a motion is no estimation error
COURSE_NOISE = 0.1  # standard deviation between heading and direction of motion, rad


@dataclass(frozen=True, eq=False)
class Headings:
    """Of R states: yaw (R,), rad, NaN where nothing tells; variance (R,), rad^2; and what says that yaw is no half turn
    off: path (R,), m moved along it on the way to each state, and votes (R,) of the detections at each."""

    yaw: FloatArray
    variance: FloatArray
    path: FloatArray
    votes: FloatArray


def smooth_headings(
    states: StateTable,
    lives: Lives,
    evidence: Evidence,
    detection: IntArray,
    row: IntArray,
    growth: FloatArray,
    moving: FloatArray,
) -> Headings:
    """Heading of every state.

    detection (m,) and row (m,): detections and the states they belong to; growth (R,): see `smooth_walks`; moving (n,):
    speed from which the motion of an object tells its heading, m/s
    """
    owner = lives.rows_of(states.id)
    speed = np.hypot(*states.mean[:, 2:].T)
    course = np.arctan2(states.mean[:, 3], states.mean[:, 2])
    across = np.stack([-np.sin(course), np.cos(course)], axis=-1)
    variance_across = np.einsum("ri,rij,rj->r", across, states.covariance[:, 2:, 2:], across)
    course_variance = variance_across / np.maximum(speed, 1e-9) ** 2 + COURSE_NOISE**2
    telling = np.flatnonzero((speed >= moving[owner]) & (speed > CLEAR * np.sqrt(variance_across)))
    readings = [ScalarReadings(telling, course[telling], course_variance[telling])]
    yaw, known = evidence.boxes.yaw[detection], np.isfinite(evidence.boxes.yaw[detection])
    mine = detection[known]
    readings += scalar_readings(row[known], yaw[known], evidence.yaw_noise[mine] ** 2)
    axis, variance = smooth_walks(states, growth, readings, period=np.pi)
    before = previous_rows(states)
    dt = np.where(before >= 0, evidence.times[states.moment] - evidence.times[states.moment[before]], 0.0)
    path = np.zeros(len(states))
    path[telling] = (speed * dt * np.cos(course - np.nan_to_num(axis)))[telling]
    seen = evidence.probability[detection] * np.cos(np.where(known, yaw - axis[row], np.pi / 2))
    votes = np.bincount(row, np.nan_to_num(seen), minlength=len(states))
    backwards = is_backwards(*(np.bincount(owner, w, len(lives)).astype(np.float64) for w in (path, votes)))
    sign = np.where(backwards, -1.0, 1.0)[owner]
    return Headings(wrap_angle(axis + np.pi * (sign < 0)), variance, sign * path, sign * votes)


def is_backwards(path: FloatArray, votes: FloatArray) -> BoolArray:
    """(n,) which objects face the other way, of the sums (n,) over their states."""
    return np.where(np.abs(path) >= TELLING_PATH, path, votes) < 0
