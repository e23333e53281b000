r"""How fast traffic goes here: the speed of a new track from tracks of its class that head, or headed, the same way.

    k_j = weight * max over where j passed of
              exp( -ahead^2 / (2 ahead_scale^2) - lateral^2 / (2 lateral_scale^2) - turn^2 / (2 heading_scale^2) )
    p(speed) ~ N(0, initial_speed_deviation^2) + sum_j k_j N(s_j, sigma_j^2 + spread^2)

Every neighbour j counts once, by the nearest place it passed within `memory`, with its speed s_j along its heading
there (parked ones with a speed near 0). The new track takes the mean and the variance of the mixture, which is as wide
as the neighbours disagree, and that of knowing nothing where nobody was.

Where standing is a case of its own (`saga_fg.tracking.standing`), neighbour j stands with the belief b_j and an object
of which nothing is known with b_0. The new one stands with the mean of these, weighted by k, and the mixture is that of
those that move, with the weights 1 - b_0 and k_j (1 - b_j).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.settings import TrafficFlowSettings


@dataclass(frozen=True, eq=False)
class Passages(Columns):
    """n places where tracks were: track id, class, position (n, 2), heading, speed along it if it moves, its variance,
    the belief that it stands, time."""

    id: IntArray
    label: StrArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    variance: FloatArray
    standing: FloatArray
    time: FloatArray


class Expected(NamedTuple):
    """Of k new tracks, each (k,): the belief that they stand; if they move, their speed ahead, and its variance."""

    standing: FloatArray
    speed: FloatArray
    variance: FloatArray


@dataclass(eq=False)
class TrafficFlow:
    """The passages of the last `memory` seconds."""

    settings: TrafficFlowSettings
    passages: Passages | None = None

    def pass_by(self, passages: Passages) -> None:
        """Remember where tracks are now; those of unknown heading or speed are left out."""
        settings = self.settings
        if settings.weight == 0:
            return
        known = np.isfinite(passages.heading) & (passages.variance < settings.max_speed_deviation**2)
        if len(known) == 0:
            return
        new = passages.select(known)
        if self.passages is not None:
            new = self.passages.select(self.passages.time >= passages.time[0] - settings.memory).extended(new)
        self.passages = new

    def expected(
        self, label: StrArray, position: FloatArray, heading: FloatArray, variance: FloatArray, standing: float = 0.0
    ) -> Expected:
        """What is to be expected of new tracks at `position` (k, 2).

        variance, standing  (k,) of the speed of one of which nothing is known, and the belief that it stands
        """
        passages, settings = self.passages, self.settings
        if passages is None or len(passages.id) == 0 or len(label) == 0:
            return Expected(np.full(len(label), standing), np.zeros(len(label)), variance.copy())
        offset = passages.position - position[:, None]
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        ahead, lateral = offset[..., 0] * c + offset[..., 1] * s, offset[..., 1] * c - offset[..., 0] * s
        turn = wrap_angle(passages.heading - heading[:, None])
        exponent = (
            (ahead / settings.ahead_scale) ** 2
            + (lateral / settings.lateral_scale) ** 2
            + (turn / settings.heading_scale) ** 2
        )
        k = settings.weight * np.exp(-exponent / 2)
        k = np.where((passages.label == label[:, None]) & np.isfinite(heading)[:, None], k, 0.0)
        k = _nearest_of_each(k, passages.id)
        stands = (standing + k @ passages.standing) / (1 + k.sum(axis=1))
        k = k * (1 - passages.standing)
        norm = 1 - standing + k.sum(axis=1)
        mean = k @ passages.speed / norm
        square = passages.speed**2 + passages.variance + settings.spread**2
        return Expected(stands, mean, ((1 - standing) * variance + k @ square) / norm - mean**2)


def _nearest_of_each(k: FloatArray, ids: IntArray) -> FloatArray:
    """k (m, n) with all but the largest entry of each track id (n,) in each row set to 0."""
    order = np.lexsort((k, np.broadcast_to(ids, k.shape)), axis=1)
    sorted_ids = ids[order]
    last = np.ones(k.shape, dtype=bool)
    last[:, :-1] = sorted_ids[:, 1:] != sorted_ids[:, :-1]
    kept = np.zeros(k.shape, dtype=bool)
    np.put_along_axis(kept, order, last, axis=1)
    return np.where(kept, k, 0.0)
