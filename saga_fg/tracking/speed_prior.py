r"""Prior of the speed of a new track, from tracks of its class that head, or headed, the same way.

    k_j = weight * max over the passages of j of
              exp( -ahead^2 / (2 ahead_scale^2) - lateral^2 / (2 lateral_scale^2) - turn^2 / (2 heading_scale^2) )
    p(speed) ~ N(0, initial_speed_deviation^2) + sum_j k_j N(s_j, sigma_j^2 + spread^2)

Every neighbour j counts once, by its nearest passage within `memory`, with its speed s_j along its heading there
(parked ones with a speed near 0). The new track takes the mean and the variance of the mixture: as wide as the
neighbours disagree, and the prior of the class where there are none.

Where stationary objects are modelled (`saga_fg.tracking.stationarity`), neighbour j is stationary with probability b_j
and an unknown object with b_0. The new one is stationary with the mean of these, weighted by k, and the mixture is that
of the moving ones, with the weights 1 - b_0 and k_j (1 - b_j).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.kernels.compilation import compiled_by
from saga_fg.kernels.speed_prior import Prior, prior_of_traffic
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray, distinct
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.numerics.near_pairs import near_pairs
from saga_fg.tracking.traffic import Passages, Traffic

_FARTHEST = 80.0  # exponent from which a passage is too far away to count among the digits
_MOST_PAIRS = 1_000_000  # of new tracks and passages that are compared at a time


class SpeedPrior(NamedTuple):
    """Prior of k new tracks, each (k,): probability of being stationary; if moving, speed ahead, and its variance."""

    stationary: FloatArray
    speed: FloatArray
    variance: FloatArray


def speed_prior(
    traffic: Traffic,
    label: StrArray,
    position: FloatArray,
    heading: FloatArray,
    variance: FloatArray,
    stationary: float = 0.0,
) -> SpeedPrior:
    """The prior of new tracks at `position` (k, 2).

    variance (k,) and probability `stationary` of objects without neighbours
    """
    settings, sets = traffic.settings.speed_prior, (traffic.left, traffic.latest)
    if settings.weight == 0 or len(label) == 0 or not any(map(len, sets)):
        return SpeedPrior(np.full(len(label), stationary), np.zeros(len(label)), variance.copy())
    number: dict[str, int] = {}
    left, latest = (_columns(each, number) for each in sets)
    new = _class_numbers(label, number), position, heading, variance
    scales = settings.weight, settings.ahead_scale, settings.lateral_scale, settings.heading_scale, settings.spread
    limits = settings.max_speed_deviation**2, _FARTHEST
    return SpeedPrior(*_prior(*left, *latest, *new, stationary, *scales, *limits))


_Columns = tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def _columns(each: Passages, number: dict[str, int]) -> _Columns:
    """The columns of passages that the prior is made of, their classes by number."""
    of = _class_numbers(each.label, number)
    return each.id, of, each.position, each.heading, each.speed, each.variance, each.stationary


def _class_numbers(label: StrArray, number: dict[str, int]) -> IntArray:
    """(n,) numbers of the classes of labels (n,), by `number`, to which new ones are added."""
    names, of_row = distinct(label)
    return np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64)[of_row]


@compiled_by(prior_of_traffic)
def _prior(
    left: IntArray,
    left_class: IntArray,
    left_position: FloatArray,
    left_heading: FloatArray,
    left_speed: FloatArray,
    left_variance: FloatArray,
    left_stationary: FloatArray,
    latest: IntArray,
    latest_class: IntArray,
    latest_position: FloatArray,
    latest_heading: FloatArray,
    latest_speed: FloatArray,
    latest_variance: FloatArray,
    latest_stationary: FloatArray,
    new_class: IntArray,
    position: FloatArray,
    heading: FloatArray,
    variance: FloatArray,
    stationary: float,
    weight: float,
    ahead_scale: float,
    lateral_scale: float,
    heading_scale: float,
    spread: float,
    most_variance: float,
    farthest: float,
) -> Prior:
    used = np.concatenate([left_variance, latest_variance]) < most_variance
    ids, classes = np.concatenate([left, latest])[used], np.concatenate([left_class, latest_class])[used]
    places = np.concatenate([left_position, latest_position])[used]
    headings = np.concatenate([left_heading, latest_heading])[used]
    speeds, variances = (
        np.concatenate(pair)[used] for pair in ((left_speed, latest_speed), (left_variance, latest_variance))
    )
    resting = np.concatenate([left_stationary, latest_stationary])[used]
    reach = np.where(np.isfinite(heading), np.sqrt(farthest) * max(ahead_scale, lateral_scale), np.nan)
    block, found = max(1, _MOST_PAIRS // max(1, len(ids))), []
    for begin in range(0, len(heading), block):
        new, passage = near_pairs(position[begin : begin + block], places, reach[begin : begin + block])
        new = new + begin
        offset, turn = places[passage] - position[new], wrap_angle(headings[passage] - heading[new])
        c, s = np.cos(heading[new]), np.sin(heading[new])
        ahead, lateral = offset[:, 0] * c + offset[:, 1] * s, offset[:, 1] * c - offset[:, 0] * s
        exponent = (ahead / ahead_scale) ** 2 + (lateral / lateral_scale) ** 2 + (turn / heading_scale) ** 2
        counts = (exponent < farthest) & (classes[passage] == new_class[new])
        new, passage, k = new[counts], passage[counts], weight * np.exp(-exponent[counts] / 2)
        nearest = _nearest_of_each(new, ids[passage], k)
        found.append((new[nearest], passage[nearest], k[nearest]))
    new, passage, k = (np.concatenate(column) for column in zip(*found, strict=True))

    def total(values: FloatArray) -> FloatArray:
        return np.bincount(new, weights=values, minlength=len(heading)).astype(np.float64, copy=False)

    still = (stationary + total(k * resting[passage])) / (1 + total(k))
    k, speed = k * (1 - resting[passage]), speeds[passage]
    norm = 1 - stationary + total(k)
    mean = total(k * speed) / norm
    square = speed**2 + variances[passage] + spread**2
    return still, mean, ((1 - stationary) * variance + total(k * square)) / norm - mean**2


def _nearest_of_each(new: IntArray, ids: IntArray, k: FloatArray) -> IntArray:
    """Select the pair of largest weight `k` of each two tracks, from pairs (e,) of new tracks and passages of `ids`."""
    order = np.lexsort((k, ids, new))
    last = np.ones(len(order), dtype=bool)
    last[:-1] = (np.diff(new[order]) != 0) | (np.diff(ids[order]) != 0)
    return order[last]
