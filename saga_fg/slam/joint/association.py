"""Stationarity of objects: the probability that each one is at rest, from its detections along a path.

Around each detection of an object, within a window, D is the mean place of the later half of the detections less that
of the earlier half, in the world along the path assumed so far, and T the time between the two. A stationary object
has D ~ N(0, S): noise of the detections and of the odometry over the T seconds and s metres in between,

    S = R (1/n_1 + 1/n_2) + shift + (scale^2 + course^2) s^2 + range^2 (turn + (bias T)^2)

where shift and turn are the summed variances of the increments in between, in translation and in heading; scale, bias
and course are the odometry's deviations as known so far. A moving object has D ~ N(0, S + (u T)^2), with the usual
speed u_2 of its class (`moving_speed`), or u_1 = 0.3 u_2 where traffic creeps. By Bayes, with u_0 = 0 and shares q_k,

    P(stationary | D) = q_0 N(D; 0, S) / sum_k q_k N(D; 0, S + (u_k T)^2)

Where T is short, all these variances are nearly equal, and P is about q_0; so it is for slow classes far away.

In a queue, cars too far to be seen creeping look parked, and the vehicle's path would bend until they are. But others,
nearer, are seen to creep. So q_0 is one half, and the other half is divided as the traffic moves then, within 10 s:
maximum likelihood of all detections by expectation maximisation, with a Dirichlet prior worth a few detections.

Online the window ends now, and T is short: q_0 is `ONLINE_STATIONARY_SHARE`, q_1 = 0, and the last term of S, errors
of the heading, counts across the line of sight only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, transform_points
from saga_fg.slam.joint.record import JointSettings, RecordedEpoch, motion_covariances
from saga_fg.types import class_numbers

_CREEPING = 0.3  # speed of creeping traffic, as a share of the usual one
_ALIKE = 10.0  # s, time over which traffic keeps its shares
_PRIOR = 10.0  # detections of each hypothesis that the prior of the shares is worth
_ROUNDS = 30  # of expectation maximisation
ONLINE_STATIONARY_SHARE = 0.1  # prior share of stationary objects online: queues look parked


@dataclass(frozen=True)
class SlowErrors:
    """Standard deviations of the odometry's scale, its bias of the yaw rate (rad/s) and its course (rad), as known."""

    scale: float
    bias: float
    course: float

    @classmethod
    def at_start(cls, settings: JointSettings) -> SlowErrors:
        """The deviations of the settings, before any measurement."""
        return cls(settings.odometry.scale, settings.odometry.bias, settings.odometry.course)


@dataclass(frozen=True, eq=False)
class _PlacedDetections(Columns):
    """All detections, by object and time: object, row of the record, time (N,), place (N, 2), variance, range, u (N,).

    sight (N, 2): the place less the vehicle's, m
    drift (N, 3): way driven, m, variance of the translation, m^2, and of the heading, rad^2, from the first epoch on
    """

    object: IntArray
    row: IntArray
    time: FloatArray
    place: FloatArray
    sight: FloatArray
    variance: FloatArray
    range: FloatArray
    speed: FloatArray
    drift: FloatArray


def stationary_probabilities(
    record: Sequence[RecordedEpoch], path: FloatArray, slow: SlowErrors, settings: JointSettings, online: bool = False
) -> list[FloatArray]:
    """For each epoch the probabilities (n,) that its objects are stationary; path (K, 4, 4) assumed so far.

    0 where there are too few detections. Between two detections it is the smaller one of theirs.
    """
    seen = _place(record, path, settings)
    p = _probabilities(seen, slow, settings, online)
    result = [np.zeros(len(now.objects.id)) for now in record]
    if not len(p):
        return result
    first = np.flatnonzero(np.append(True, seen.object[1:] != seen.object[:-1]))
    for start, end in zip(first, np.append(first[1:], len(p)), strict=True):
        name, rows, mine = seen.object[start], seen.row[start:end], p[start:end]
        for k in range(int(rows[0]), int(rows[-1]) + 1):
            after = int(np.searchsorted(rows, k))
            value = mine[after] if rows[after] == k else min(mine[after - 1], mine[after])
            row = int(np.searchsorted(record[k].objects.id, name))
            if row < len(record[k].objects.id) and record[k].objects.id[row] == name:
                result[k][row] = value
    return result


def _probabilities(seen: _PlacedDetections, slow: SlowErrors, settings: JointSettings, online: bool) -> FloatArray:
    """P(stationary) (N,) of the object of each detection, around it."""
    n = len(seen.object)
    if n == 0:
        return np.empty(0)
    far = 4 * (seen.time.max() - seen.time.min() + settings.stationary_window)  # puts objects apart on one axis
    axis = seen.time - seen.time.min() + far * np.unique(seen.object, return_inverse=True)[1]
    low = np.searchsorted(axis, axis - settings.stationary_window / 2, "left")
    high = np.searchsorted(axis, axis + settings.stationary_window / 2, "right")
    start = np.searchsorted(seen.object, seen.object, "left")
    end = np.searchsorted(seen.object, seen.object, "right")
    # at the ends of its lifespan the window is shifted into it
    low = np.where(high == end, np.searchsorted(axis, axis[end - 1] - settings.stationary_window, "left"), low)
    low = np.maximum(low, start)
    high = np.where(low == start, np.searchsorted(axis, axis[start] + settings.stationary_window, "right"), high)
    high = np.minimum(high, end)
    middle = (low + high) // 2
    n1, n2 = middle - low, high - middle

    def half(values: FloatArray, a: IntArray, b: IntArray) -> FloatArray:
        total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        count = np.maximum(b - a, 1).reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray((total[b] - total[a]) / count)

    columns = np.column_stack([seen.place, seen.time - seen.time.min(), seen.drift])
    between = half(columns, middle, high) - half(columns, low, middle)
    D, (T, s, shift, turn) = between[:, :2], between[:, 2:].T
    S = half(seen.variance, low, high) * (1 / np.maximum(n1, 1) + 1 / np.maximum(n2, 1))
    S = S + shift + (slow.scale**2 + slow.course**2) * s**2
    turned = half(seen.range, low, high) ** 2 * (turn + (slow.bias * T) ** 2)
    sight = half(seen.sight, low, high)
    along = (D * sight).sum(axis=1) ** 2 / np.maximum((sight**2).sum(axis=1), 1e-9)
    d2 = np.stack([along, (D**2).sum(axis=1) - along])  # along the line of sight, and across
    S = np.stack([S if online else S + turned, S + turned])
    usual = (seen.speed * T) ** 2
    if online:
        q = ONLINE_STATIONARY_SHARE
        variances, shares = np.stack([S, S + usual]), np.array([[q], [1 - q]])
        log = _log_likelihoods(variances, d2)
    else:
        variances = np.stack([S, S + _CREEPING**2 * usual, S + usual])
        log = _log_likelihoods(variances, d2)
        shares = _shares_of_traffic(log, seen.time, n1 > 0)
    p = _posteriors(log, shares)[0]
    return np.where(n1 > 0, p, 0.0)


def _log_likelihoods(variances: FloatArray, d2: FloatArray) -> FloatArray:
    """Of each hypothesis (K, N), but for a constant: variances (K, 2, N) of distances whose squares are d2 (2, N)."""
    return np.asarray(-(np.log(variances) + d2 / variances).sum(axis=1) / 2)


def _posteriors(log: FloatArray, shares: FloatArray) -> FloatArray:
    """Probabilities (K, N) of hypotheses with log-likelihoods (K, N) and prior shares (K, N) or (K, 1)."""
    weight = np.log(shares) + log
    weight = np.exp(weight - weight.max(axis=0))
    return np.asarray(weight / weight.sum(axis=0))


def _shares_of_traffic(log: FloatArray, time: FloatArray, judged: BoolArray) -> FloatArray:
    """Shares (K, N) of the hypotheses around each detection; log-likelihoods (K, N), time (N,); judged (N,) count."""
    order = np.argsort(time, kind="stable")
    low = np.searchsorted(time[order], time - _ALIKE, "left")
    high = np.searchsorted(time[order], time + _ALIKE, "right")
    shares = np.tile([[0.5], [0.25], [0.25]], (1, log.shape[1]))
    for _ in range(_ROUNDS):
        p = np.where(judged, _posteriors(log, shares), 0.0)[:, order]
        total = np.concatenate([np.zeros((len(p), 1)), np.cumsum(p, axis=1)], axis=1)
        count = (total[:, high] - total[:, low] + _PRIOR)[1:]
        shares[1:] = 0.5 * count / count.sum(axis=0)
    return shares


def _place(record: Sequence[RecordedEpoch], path: FloatArray, settings: JointSettings) -> _PlacedDetections:
    row = np.repeat(np.arange(len(record)), [len(now.seen.id) for now in record]).astype(np.int64)
    place = [transform_points(pose, now.seen.z)[:, :2] for now, pose in zip(record, path, strict=True)]
    sight = [one - pose[:2, 3] for one, pose in zip(place, path, strict=True)]
    label = [np.array(now.objects.label)[np.isin(now.objects.id, now.seen.id)] for now in record]
    P = motion_covariances(record, settings)
    drift = np.zeros((len(record), 3))
    drift[:, 0] = np.cumsum([np.linalg.norm(now.a_T_b[:3, 3]) for now in record])
    drift[1:, 1] = np.cumsum((P[:, 3, 3] + P[:, 4, 4]) / 2)
    drift[1:, 2] = np.cumsum(P[:, 2, 2])
    placed = _PlacedDetections(
        np.concatenate([now.seen.id for now in record]),
        row,
        np.array([now.time for now in record])[row],
        np.concatenate(place),
        np.concatenate(sight),
        np.concatenate([np.trace(now.seen.R, axis1=1, axis2=2) / 2 for now in record]),
        np.concatenate([np.hypot(now.seen.z[:, 0], now.seen.z[:, 1]) for now in record]),
        class_numbers(settings.moving_speed, float, np.concatenate(label)),
        drift[row],
    )
    return placed.select(np.lexsort((placed.row, placed.object)))
