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

from saga_fg.kernels.speed_prior import prior_of_traffic
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray, distinct
from saga_fg.tracking.traffic import Passages, Traffic

_FARTHEST = 80.0  # exponent from which a passage is too far away to count among the digits
HEADING_SCALE = 0.3  # sigma of the kernel on the difference of headings, rad
SPREAD = 2.0  # standard deviation of the difference between the speeds of neighbours, m/s


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
    scales = settings.weight, settings.ahead_scale, settings.lateral_scale, HEADING_SCALE, SPREAD
    limits = settings.max_speed_deviation**2, _FARTHEST
    return SpeedPrior(*prior_of_traffic(*left, *latest, *new, stationary, *scales, *limits))


_Columns = tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def _columns(each: Passages, number: dict[str, int]) -> _Columns:
    """The columns of passages that the prior is made of, their classes by number."""
    of = _class_numbers(each.label, number)
    return each.id, of, each.position, each.heading, each.speed, each.variance, each.stationary


def _class_numbers(label: StrArray, number: dict[str, int]) -> IntArray:
    """(n,) numbers of the classes of labels (n,), by `number`, to which new ones are added."""
    names, of_row = distinct(label)
    return np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64)[of_row]
