r"""How fast traffic goes here: the speed of a new track from tracks of its class that head, or headed, the same way.

    k_j = weight * max over where j passed of
              exp( -ahead^2 / (2 ahead_scale^2) - lateral^2 / (2 lateral_scale^2) - turn^2 / (2 heading_scale^2) )
    p(speed) ~ N(0, birth_speed^2) + sum_j k_j N(s_j, sigma_j^2 + spread^2)

Every neighbour j counts once, by the nearest place it passed within `memory`, with its speed s_j along its heading
there (parked ones with a speed near 0). The new track takes the mean and the variance of the mixture, which is as wide
as the neighbours disagree, and that of knowing nothing where nobody was.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.geometry import wrap_angle
from saga_fg.tracking.settings import FlowSettings


class Passages(NamedTuple):
    """n places where tracks were: track id, class, position (n, 2), heading, speed along it, its variance, time."""

    id: IntArray
    label: StrArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    variance: FloatArray
    time: FloatArray

    def select(self, rows: BoolArray) -> Passages:
        return Passages(
            self.id[rows],
            self.label[rows],
            self.position[rows],
            self.heading[rows],
            self.speed[rows],
            self.variance[rows],
            self.time[rows],
        )

    def extended(self, other: Passages) -> Passages:
        return Passages(
            np.concatenate([self.id, other.id]),
            np.concatenate([self.label, other.label]),
            np.concatenate([self.position, other.position]),
            np.concatenate([self.heading, other.heading]),
            np.concatenate([self.speed, other.speed]),
            np.concatenate([self.variance, other.variance]),
            np.concatenate([self.time, other.time]),
        )


class TrafficFlow:
    """The passages of the last `memory` seconds."""

    def __init__(self, settings: FlowSettings) -> None:
        self._settings = settings
        self._passages: Passages | None = None

    def pass_by(self, passages: Passages) -> None:
        """Remember where tracks are now; those of unknown heading or speed are left out."""
        settings = self._settings
        if settings.weight == 0:
            return
        known = np.isfinite(passages.heading) & (passages.variance < settings.known_speed**2)
        if len(known) == 0:
            return
        new = passages.select(known)
        if self._passages is not None:
            new = self._passages.select(self._passages.time >= passages.time[0] - settings.memory).extended(new)
        self._passages = new

    def speed(
        self, label: StrArray, position: FloatArray, heading: FloatArray, variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Speed (k,) along the heading of new tracks at `position` (k, 2), and its variance.

        variance  (k,) of the speed of one of which nothing is known
        """
        mean, total = np.zeros(len(label)), variance.copy()
        passages, settings = self._passages, self._settings
        if passages is None or len(passages.id) == 0 or len(label) == 0:
            return mean, total
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
        norm = 1 + k.sum(axis=1)
        mean = k @ passages.speed / norm
        square = passages.speed**2 + passages.variance + settings.spread**2
        return mean, (variance + k @ square) / norm - mean**2


def _nearest_of_each(k: FloatArray, ids: IntArray) -> FloatArray:
    """k (m, n) with all but the largest entry of each track id (n,) in each row set to 0."""
    order = np.lexsort((k, np.broadcast_to(ids, k.shape)), axis=1)
    sorted_ids = ids[order]
    last = np.ones(k.shape, dtype=bool)
    last[:, :-1] = sorted_ids[:, 1:] != sorted_ids[:, :-1]
    kept = np.zeros(k.shape, dtype=bool)
    np.put_along_axis(kept, order, last, axis=1)
    return np.where(kept, k, 0.0)
