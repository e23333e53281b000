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

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.numerics.near_pairs import near_pairs
from saga_fg.tracking.traffic import Passages, SpeedPriorSettings, Traffic

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
    settings = traffic.settings.speed_prior
    passages = traffic.passages if settings.weight > 0 and len(label) else traffic.left.select(slice(0, 0))
    if len(passages) == 0:
        return SpeedPrior(np.full(len(label), stationary), np.zeros(len(label)), variance.copy())
    passages = passages.select(passages.variance < settings.max_speed_deviation**2)
    block = max(1, _MOST_PAIRS // max(1, len(passages)))
    parts = [
        _neighbours(settings, passages, np.arange(begin, min(begin + block, len(label))), label, position, heading)
        for begin in range(0, len(label), block)
    ]
    new, passage, k = (np.concatenate(column) for column in zip(*parts, strict=True))
    near = passages.select(passage)

    def total(values: FloatArray) -> FloatArray:
        return np.bincount(new, weights=values, minlength=len(label)).astype(np.float64, copy=False)

    still = (stationary + total(k * near.stationary)) / (1 + total(k))
    k = k * (1 - near.stationary)
    norm = 1 - stationary + total(k)
    mean = total(k * near.speed) / norm
    square = near.speed**2 + near.variance + settings.spread**2
    return SpeedPrior(still, mean, ((1 - stationary) * variance + total(k * square)) / norm - mean**2)


def _neighbours(
    settings: SpeedPriorSettings,
    passages: Passages,
    rows: IntArray,
    label: StrArray,
    position: FloatArray,
    heading: FloatArray,
) -> tuple[IntArray, IntArray, FloatArray]:
    """The new tracks among `rows`, each with the nearest passage of every neighbour and its weight, each (e,)."""
    farthest = np.sqrt(_FARTHEST) * max(settings.ahead_scale, settings.lateral_scale)
    reach = np.where(np.isfinite(heading[rows]), farthest, np.nan)
    new, passage = near_pairs(position[rows], passages.position, reach)
    new = rows[new]
    offset, turn = passages.position[passage] - position[new], wrap_angle(passages.heading[passage] - heading[new])
    c, s = np.cos(heading[new]), np.sin(heading[new])
    ahead, lateral = offset[:, 0] * c + offset[:, 1] * s, offset[:, 1] * c - offset[:, 0] * s
    exponent = (
        (ahead / settings.ahead_scale) ** 2
        + (lateral / settings.lateral_scale) ** 2
        + (turn / settings.heading_scale) ** 2
    )
    counts = (exponent < _FARTHEST) & (passages.label[passage] == label[new])
    new, passage, k = new[counts], passage[counts], settings.weight * np.exp(-exponent[counts] / 2)
    nearest = _nearest_of_each(new, passages.id[passage], k)
    return new[nearest], passage[nearest], k[nearest]


def _nearest_of_each(new: IntArray, ids: IntArray, k: FloatArray) -> IntArray:
    """Select the pair of largest weight `k` of each two tracks, from pairs (e,) of new tracks and passages of `ids`."""
    order = np.lexsort((k, ids, new))
    last = np.ones(len(order), dtype=bool)
    last[:-1] = (np.diff(new[order]) != 0) | (np.diff(ids[order]) != 0)
    return order[last]
