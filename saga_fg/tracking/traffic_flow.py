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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.kinematics import Kinematics
from saga_fg.tracking.settings import TrafficFlowSettings
from saga_fg.tracking.track_table import TrackTable

_FARTHEST = 80.0  # exponent from which a passage is too far away to count among the digits


@dataclass(frozen=True, eq=False)
class Passages(Columns):
    """n passages of tracks: id, class, position (n, 2), world, m, heading, rad, speed along it if moving, m/s, its
    variance, probability of being stationary, time, s."""

    id: IntArray
    label: StrArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    variance: FloatArray
    stationary: FloatArray
    time: FloatArray

    @classmethod
    def of(cls, table: TrackTable, rows: IntArray, now: Kinematics, origin: FloatArray, time: float) -> Passages:
        """Return the passages of tracks `rows` (n,) with kinematics `now`, local from `origin`, at a time, s."""
        yaw = table.box.yaw[rows]
        ahead = np.nan_to_num(np.stack([np.cos(yaw), np.sin(yaw)], axis=-1))
        speed = np.einsum("ni,ni->n", ahead, now.velocity)
        variance = np.einsum("ni,nij,nj->n", ahead, now.P_velocity, ahead)
        stationary, position = table.stationarity.probability[rows], now.position + origin
        times = np.full(len(rows), time)
        return cls(table.id[rows], table.label[rows], position, yaw, speed, variance, stationary, times)


class SpeedPrior(NamedTuple):
    """Prior of k new tracks, each (k,): probability of being stationary; if moving, speed ahead, and its variance."""

    stationary: FloatArray
    speed: FloatArray
    variance: FloatArray


@dataclass(eq=False)
class TrafficFlowPrior:
    """The passages of the last `memory` seconds."""

    settings: TrafficFlowSettings
    passages: Passages | None = None

    def update(self, passages: Passages) -> None:
        """Remember passages of the present; those of unknown heading or speed are left out."""
        settings = self.settings
        known = np.isfinite(passages.heading) & (passages.variance < settings.max_speed_deviation**2)
        if settings.weight == 0 or len(known) == 0:
            return
        new = passages.select(known)
        if self.passages is not None:
            new = self.passages.select(self.passages.time >= passages.time[0] - settings.memory).append(new)
        self.passages = new

    def expected(
        self, label: StrArray, position: FloatArray, heading: FloatArray, variance: FloatArray, stationary: float = 0.0
    ) -> SpeedPrior:
        """The prior of new tracks at `position` (k, 2).

        variance (k,) and probability `stationary` of objects without neighbours
        """
        passages, settings = self.passages, self.settings
        if passages is None or len(passages.id) == 0 or len(label) == 0:
            return SpeedPrior(np.full(len(label), stationary), np.zeros(len(label)), variance.copy())
        offset = passages.position - position[:, None]
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        ahead, lateral = offset[..., 0] * c + offset[..., 1] * s, offset[..., 1] * c - offset[..., 0] * s
        turn = wrap_angle(passages.heading - heading[:, None])
        exponent = (
            (ahead / settings.ahead_scale) ** 2
            + (lateral / settings.lateral_scale) ** 2
            + (turn / settings.heading_scale) ** 2
        )
        new, passage = np.nonzero(exponent < _FARTHEST)  # false where the heading is unknown
        alike = passages.label[passage] == label[new]
        new, passage = new[alike], passage[alike]
        k = settings.weight * np.exp(-exponent[new, passage] / 2)
        nearest = _nearest_of_each(new, passages.id[passage], k)
        new, k, near = new[nearest], k[nearest], passages.select(passage[nearest])

        def total(values: FloatArray) -> FloatArray:
            return np.bincount(new, weights=values, minlength=len(label)).astype(np.float64, copy=False)

        still = (stationary + total(k * near.stationary)) / (1 + total(k))
        k = k * (1 - near.stationary)
        norm = 1 - stationary + total(k)
        mean = total(k * near.speed) / norm
        square = near.speed**2 + near.variance + settings.spread**2
        return SpeedPrior(still, mean, ((1 - stationary) * variance + total(k * square)) / norm - mean**2)


def _nearest_of_each(new: IntArray, ids: IntArray, k: FloatArray) -> IntArray:
    """Of pairs (e,) of new tracks and passages of tracks `ids`, those of the largest weight `k` of each two tracks."""
    order = np.lexsort((k, ids, new))
    last = np.ones(len(order), dtype=bool)
    last[:-1] = (np.diff(new[order]) != 0) | (np.diff(ids[order]) != 0)
    return order[last]
