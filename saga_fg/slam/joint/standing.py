"""Which objects stand? The discrete part of the joint estimation, decided from where they were detected.

Around each detection of an object, within a window, D is the mean place of the later half of the detections less that
of the earlier half, in the world along the path assumed so far, and T the time between the two. An object that stands
has D ~ N(0, S): noise of the detections and of the odometry over the T seconds and s metres in between,

    S = R (1/n_1 + 1/n_2) + shift + (scale^2 + course^2) s^2 + range^2 (turn + (bias T)^2)

where shift and turn are the variances that the increments in between add up to in translation and in heading; scale,
bias and course the odometry's deviations as known so far. One that moves has D ~ N(0, S + (u T)^2), with the speed u
usual for its class (`moving_speed`). By Bayes, with a share q of objects that stand, one half in a whole recording,

    P(stands | D) = q N(D; 0, S) / (q N(D; 0, S) + (1 - q) N(D; 0, S + (u T)^2))

The odds weigh the time by themselves: where T is short, S and S + (u T)^2 are nearly the same, and P about one half. So
they do the speed: who walks far away is not taken for a car that stands.

Online the window ends now, T is short, and queues that creep look parked: q is `online_standing_share`, and the last
term of S, errors of the heading, counts across the line of sight only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.slam.joint.record import EgoMoment, motion_covariances
from saga_fg.slam.joint.settings import JointSettings
from saga_fg.types.by_class import class_numbers


@dataclass(frozen=True)
class SlowErrors:
    """Standard deviations of the odometry's scale, its bias of the yaw rate (rad/s) and its course (rad), as known."""

    scale: float
    bias: float
    course: float

    @classmethod
    def at_start(cls, settings: JointSettings) -> SlowErrors:
        """What is known beforehand."""
        return cls(settings.odometry.scale, settings.odometry.bias, settings.odometry.course)


@dataclass(frozen=True, eq=False)
class _Sightings:
    """All detections, by object and time: object, moment, time (N,), place (N, 2), variance, range, speed u (N,).

    sight (N, 2): the place less the vehicle's, m
    drift (N, 3): way driven, m, variance of the translation, m^2, and of the heading, rad^2, from the first moment on
    """

    object: IntArray
    moment: IntArray
    time: FloatArray
    place: FloatArray
    sight: FloatArray
    variance: FloatArray
    range: FloatArray
    speed: FloatArray
    drift: FloatArray


def standing_probabilities(
    record: list[EgoMoment], path: FloatArray, slow: SlowErrors, settings: JointSettings, online: bool = False
) -> list[FloatArray]:
    """For each moment the probabilities (n,) that its objects stand; path (K, 4, 4) assumed so far.

    0 where too little was seen to tell. Between two detections it is the smaller one of theirs.
    """
    seen = _sightings(record, path, settings)
    p = _probabilities(seen, slow, settings, online)
    result = [np.zeros(len(moment.objects.id)) for moment in record]
    if not len(p):
        return result
    first = np.flatnonzero(np.append(True, seen.object[1:] != seen.object[:-1]))
    for start, end in zip(first, np.append(first[1:], len(p)), strict=True):
        name, moments, mine = seen.object[start], seen.moment[start:end], p[start:end]
        for k in range(int(moments[0]), int(moments[-1]) + 1):
            after = int(np.searchsorted(moments, k))
            value = mine[after] if moments[after] == k else min(mine[after - 1], mine[after])
            row = int(np.searchsorted(record[k].objects.id, name))
            if row < len(record[k].objects.id) and record[k].objects.id[row] == name:
                result[k][row] = value
    return result


def _probabilities(seen: _Sightings, slow: SlowErrors, settings: JointSettings, online: bool) -> FloatArray:
    """P(stands) (N,) of the object of each detection, around it."""
    n = len(seen.object)
    if n == 0:
        return np.empty(0)
    far = 4 * (seen.time.max() - seen.time.min() + settings.standing_window)  # puts objects apart on one axis
    axis = seen.time - seen.time.min() + far * np.unique(seen.object, return_inverse=True)[1]
    low = np.searchsorted(axis, axis - settings.standing_window / 2, "left")
    high = np.searchsorted(axis, axis + settings.standing_window / 2, "right")
    start = np.searchsorted(seen.object, seen.object, "left")
    end = np.searchsorted(seen.object, seen.object, "right")
    # at an end of its life the window is shifted into it
    low = np.where(high == end, np.searchsorted(axis, axis[end - 1] - settings.standing_window, "left"), low)
    low = np.maximum(low, start)
    high = np.where(low == start, np.searchsorted(axis, axis[start] + settings.standing_window, "right"), high)
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
    M = S + (seen.speed * T) ** 2
    q = settings.online_standing_share if online else 0.5
    odds = np.log(q / (1 - q)) + (np.log(M / S) - d2 * (1 / S - 1 / M)).sum(axis=0) / 2  # log
    p = 1 / (1 + np.exp(-np.clip(odds, -50, 50)))
    return np.where(n1 > 0, p, 0.0)


def _sightings(record: list[EgoMoment], path: FloatArray, settings: JointSettings) -> _Sightings:
    moments = np.repeat(np.arange(len(record)), [len(moment.seen.id) for moment in record]).astype(np.int64)
    names = np.concatenate([moment.seen.id for moment in record])
    order = np.lexsort((moments, names))
    place = [transform_points(pose, moment.seen.z)[:, :2] for moment, pose in zip(record, path, strict=True)]
    sight = [one - pose[:2, 3] for one, pose in zip(place, path, strict=True)]
    variance = np.concatenate([np.trace(moment.seen.R, axis1=1, axis2=2) / 2 for moment in record])
    distance = np.concatenate([np.hypot(moment.seen.z[:, 0], moment.seen.z[:, 1]) for moment in record])
    label = np.concatenate(
        [np.array(moment.objects.label)[np.isin(moment.objects.id, moment.seen.id)] for moment in record]
    )
    driven = np.array([np.linalg.norm(moment.a_T_b[:3, 3]) for moment in record])
    P = motion_covariances(record, settings)
    drift = np.zeros((len(record), 3))
    drift[:, 0] = np.cumsum(driven)
    drift[1:, 1] = np.cumsum((P[:, 3, 3] + P[:, 4, 4]) / 2)
    drift[1:, 2] = np.cumsum(P[:, 2, 2])
    time = np.array([moment.time for moment in record])[moments]
    return _Sightings(
        names[order],
        moments[order],
        time[order],
        np.concatenate(place)[order],
        np.concatenate(sight)[order],
        variance[order],
        distance[order],
        class_numbers(settings.moving_speed, float, label)[order],
        drift[moments][order],
    )
