"""Sizes, heights and headings of boxes, smoothed as random walks.

Sizes and headings of boxes: one size an object, and headings without flips.

A rigid object has one size; a detector measures it well from near and guesses it from far. Length, width and height are
each the weighted median of the measured ones, with weight probability / (1 + (distance / FAR)^2): half the weight may
be wrong without harm.

A detector's heading is often off by half a turn, but its axis is good; where an object moves, so is the direction of
its velocity. Both are smoothed modulo pi, then one decision an object says which end is the front: the direction of
motion, each metre a vote,

    sum_k |v_k| dt cos(course_k - axis_k)

where that comes to at least `TELLING_PATH`, else that of most detections, weighted by probability. A vehicle that backs
out of a bay and drives away is right in the longer part. Of vehicles that stand in a row most face one way: to
the votes w_i of one are added those of the others in its lane or row whose axes are those of its own to `ALIGNED`,

    clip( sum_j `SHARED` min(w_j, `MOST`) cos(yaw_j - axis_i), -1, 1 )

Scalar random walks, one an object, smoothed together: heights and headings.

    s(k+1) = s(k) + q,  q ~ N(0, drift^2 dt)        z = s + v,  v ~ N(0, sigma^2)

Kalman filter forwards and Rauch-Tung-Striebel smoother backwards. With a `period` p only s modulo p is measured (the
axis of a box is its heading up to half a turn, p = pi): the innovation is taken to [-p/2, p/2), and s runs on
continuously over all turns.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 8.6.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.numerics import BoolArray, FloatArray, IntArray, near_pairs, wrap_angle
from saga_fg.smoothing.association import Evidence
from saga_fg.smoothing.states import Lifespans, StateTable


class ScalarReadings(NamedTuple):
    """Readings of some states: rows (m,) of the table, each at most once; value (m,); variance (m,)."""

    rows: IntArray
    value: FloatArray
    variance: FloatArray


def scalar_readings(rows: IntArray, value: FloatArray, variance: FloatArray) -> list[ScalarReadings]:
    """Readings (m,) of rows that may repeat, as groups in which each row occurs once at most."""
    order = np.argsort(rows, kind="stable")
    rank = np.empty(len(rows), dtype=np.int64)
    rank[order] = np.arange(len(rows)) - np.searchsorted(rows[order], rows[order])
    groups = (np.flatnonzero(rank == k) for k in range(int(rank.max(initial=-1)) + 1))
    return [ScalarReadings(rows[group], value[group], variance[group]) for group in groups]


def smooth_walks(
    states: StateTable, growth: FloatArray, readings: Sequence[ScalarReadings], period: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Means and variances (R,), NaN for objects without any reading.

    growth (R,): of the variance from the object's row before to each row
    """
    mean, variance = np.full(len(states), np.nan), np.full(len(states), np.nan)
    before = states.previous
    moments = range(int(states.moment[0]), int(states.moment[-1]) + 1) if len(states) else range(0)
    by_moment = [_split(states, reading) for reading in readings]
    for k in moments:
        rows = np.arange(*states.at(k).indices(len(states)))
        old = rows[before[rows] >= 0]
        mean[old] = mean[before[old]]
        variance[old] = variance[before[old]] + growth[old]
        for split in by_moment:
            if k in split:
                _update(mean, variance, split[k], period)
    filtered = variance.copy()
    for k in reversed(moments):
        rows = np.arange(*states.at(k).indices(len(states)))
        new = rows[before[rows] >= 0]
        old = before[new]
        unknown = np.isnan(mean[old])
        share = np.where(unknown, 1.0, filtered[old] / (filtered[old] + growth[new]))
        spread = np.where(unknown, growth[new], filtered[old] * (1 - share))
        mean[old] = np.where(unknown, mean[new], mean[old] + share * (mean[new] - mean[old]))
        variance[old] = spread + share**2 * variance[new]
    return mean, variance


def _split(states: StateTable, reading: ScalarReadings) -> dict[int, ScalarReadings]:
    """The readings of each moment."""
    order = np.argsort(reading.rows)
    rows, value, variance = reading.rows[order], reading.value[order], reading.variance[order]
    moments, starts = np.unique(states.moment[rows], return_index=True)
    ends = np.append(starts[1:], len(rows))[: len(starts)].tolist()
    return {
        int(k): ScalarReadings(rows[a:b], value[a:b], variance[a:b])
        for k, a, b in zip(moments, starts.tolist(), ends, strict=True)
    }


def _update(mean: FloatArray, variance: FloatArray, reading: ScalarReadings, period: float | None) -> None:
    rows, value, noise = reading
    first = np.isnan(mean[rows])
    innovation = np.where(first, 0.0, value - mean[rows])
    if period is not None:
        innovation = (innovation + period / 2) % period - period / 2
    gain = np.where(first, 0.0, variance[rows] / (variance[rows] + noise))
    mean[rows] = np.where(first, value, mean[rows] + gain * innovation)
    variance[rows] = np.where(first, noise, variance[rows] * (1 - gain))


FAR = 20.0  # distance at which a detection's size counts half, m
TELLING_PATH = 10.0  # m
CLEAR = 3.0  # standard deviations by which a motion is no estimation error
CERTAIN = 1e6  # m, of a heading that a person gave
COURSE_NOISE = 0.1  # standard deviation between heading and direction of motion, rad
ROW_LENGTH, ROW_WIDTH, ALIGNED = 30.0, 2.0, 0.9  # m along and across, and cosine between the axes, of neighbours
ELONGATED, SHARED, MOST = 1.5, 0.25, 3.0  # length by width of what stands in rows; share and most of its votes


def constant_sizes(owner: IntArray, count: int, size: FloatArray, weight: FloatArray) -> FloatArray:
    """(count, 3) length, width, height of each object, m, each NaN where it was not measured.

    owner (m,): row of the object of each detection; size (m, 3), NaN for unmeasured; weight (m,): of the size
    """
    known = np.isfinite(size).T
    columns = [weighted_medians(owner[k], count, side[k], weight[k]) for side, k in zip(size.T, known, strict=True)]
    return np.stack(columns, axis=-1)


def size_weights(evidence: Evidence) -> FloatArray:
    """(N,) the weight of detections' sizes."""
    detected = evidence.probability / (1 + (np.nan_to_num(evidence.distance) / FAR) ** 2)
    return np.where(evidence.corrected > 0, evidence.corrected, detected)


def weighted_medians(owner: IntArray, count: int, value: FloatArray, weight: FloatArray) -> FloatArray:
    """(count,) the weighted median of the values (m,) of each owner, NaN for one that has none.

    Between the two values around half the weight it is interpolated, so that of equal weights it is the usual median.
    """
    order = np.lexsort((value, owner))
    owner, value, weight = owner[order], value[order], weight[order]
    total = np.bincount(owner, weight, minlength=count)
    before = np.concatenate([[0.0], np.cumsum(total)])[:-1]
    share = (np.cumsum(weight) - weight / 2 - before[owner]) / total[owner]  # of the owner's weight up to a value
    result = np.full(count, np.nan)
    first = np.searchsorted(owner, np.arange(count))
    last = np.searchsorted(owner, np.arange(count), side="right") - 1
    there = np.flatnonzero(last >= first)
    key = owner + np.clip(share, 0.0, 1.0) * 0.999
    upper = np.clip(np.searchsorted(key, there + 0.5 * 0.999), first[there], last[there])
    lower = np.maximum(upper - 1, first[there])
    gap = share[upper] - share[lower]
    part = np.where(gap > 0, (0.5 - share[lower]) / np.where(gap > 0, gap, 1.0), 1.0)
    result[there] = value[lower] + np.clip(part, 0.0, 1.0) * (value[upper] - value[lower])
    return result


@dataclass(frozen=True, eq=False)
class Headings:
    """Headings of R states: yaw (R,), rad, NaN where unknown; variance (R,), rad^2; and evidence that yaw is not half a
    turn off: path (R,), m moved along it since the state before, and votes (R,) of the detections at each."""

    yaw: FloatArray
    variance: FloatArray
    path: FloatArray
    votes: FloatArray


def smooth_headings(
    states: StateTable,
    lifespans: Lifespans,
    evidence: Evidence,
    detection: IntArray,
    row: IntArray,
    growth: FloatArray,
    moving: FloatArray,
    size: FloatArray,
) -> Headings:
    """Heading of every state.

    detection (m,) and row (m,): detections and the states they belong to; growth (R,): see `smooth_walks`; moving (n,):
    speed from which the motion of an object tells its heading, m/s; size (n, 3): of the objects, m, NaN where unknown
    """
    owner = lifespans.rows_of(states.id)
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
    path = np.zeros(len(states))
    path[telling] = (speed * states.elapsed(evidence.times) * np.cos(course - np.nan_to_num(axis)))[telling]
    seen = evidence.probability[detection] * np.cos(np.where(known, yaw - axis[row], np.pi / 2))
    votes = np.bincount(row, np.nan_to_num(seen), minlength=len(states)).astype(np.float64)
    told = np.flatnonzero(known & (evidence.corrected[detection] > 0))
    np.add.at(path, row[told], CERTAIN * np.cos(yaw[told] - axis[row[told]]))
    in_row = size[:, 0] >= ELONGATED * size[:, 1]
    votes += row_votes(states.mean[:, :2], axis, path, votes, owner, in_row)[owner] / np.bincount(owner)[owner]
    reversed_ = is_reversed(*(np.bincount(owner, w, len(lifespans)).astype(np.float64) for w in (path, votes)))
    sign = np.where(reversed_, -1.0, 1.0)[owner]
    return Headings(wrap_angle(axis + np.pi * (sign < 0)), variance, sign * path, sign * votes)


def row_votes(
    place: FloatArray, axis: FloatArray, path: FloatArray, votes: FloatArray, owner: IntArray, in_row: BoolArray
) -> FloatArray:
    """(n,) votes of the others in its row for the axis of each object, 0 where one moves.

    place (R, 2), axis (R,), path (R,) and votes (R,) of the states of owners (R,); in_row (n,): which may stand in rows
    """
    n, first = len(in_row), np.unique(owner, return_index=True)[1]
    x, y, path, votes = (np.bincount(owner, w, n).astype(np.float64) for w in (*place.T, path, votes))
    standing = np.flatnonzero(in_row & (np.abs(path) < TELLING_PATH) & np.isfinite(axis[first]))
    place = np.stack([x, y], axis=-1) / np.bincount(owner, minlength=n)[:, None]
    place, yaw, votes = place[standing], axis[first][standing], votes[standing]
    a, b = near_pairs(place, place, np.full(len(place), ROW_LENGTH))
    across = np.abs(((place[b] - place[a]) * np.stack([-np.sin(yaw[a]), np.cos(yaw[a])], axis=-1)).sum(axis=1))
    alike = np.cos(yaw[b] - yaw[a])
    mine = (a != b) & (across < ROW_WIDTH) & (np.abs(alike) > ALIGNED)
    given = SHARED * alike * np.clip(votes[b], -MOST, MOST) * mine
    return np.asarray(np.clip(np.bincount(standing[a], given, n), -1.0, 1.0))


def is_reversed(path: FloatArray, votes: FloatArray) -> BoolArray:
    """(n,) which objects face the other way, of the sums (n,) over their states."""
    return np.where(np.abs(path) >= TELLING_PATH, path, votes) < 0
