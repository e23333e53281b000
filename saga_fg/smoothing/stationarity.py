r"""Stationary objects, recognised from smoothed states and their detections.

A run of moments is a halt if the smoothed speed stays below `stationary_speed` for at least `min_time`, and the
positions measured meanwhile do not drift: with the weighted regression

    z_k = p + u (t_k - t_mean) + e_k,   weights w_k = 2 / tr R_k,   u* = sum w (t - t_mean) z / sum w (t - t_mean)^2

the drift |u*| T over its duration T is below `stationary_drift`. A parked vehicle is stationary all its life.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from saga_fg.numerics.arrays import BoolArray, IntArray
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.settings import OfflineClass, StationarySettings
from saga_fg.smoothing.states import Lifespans, StateTable
from saga_fg.types.by_class import class_values


@dataclass(frozen=True, eq=False)
class StationaryStates:
    """States (m,) of stationary objects: moments in ascending order, and ids; settings of how firmly they are held."""

    settings: StationarySettings = field(default_factory=StationarySettings)
    moment: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    id: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def at(self, moment: int, ids: IntArray) -> BoolArray:
        """(n,) which of these objects are stationary at a moment."""
        first, last = np.searchsorted(self.moment, [moment, moment + 1])
        return np.isin(ids, self.id[first:last])


def stationary_states(
    states: StateTable,
    lifespans: Lifespans,
    evidence: Evidence,
    object_of: IntArray,
    settings: StationarySettings,
    classes: Mapping[str, OfflineClass],
) -> StationaryStates:
    """The states in which objects are stationary."""
    order = np.lexsort((states.moment, states.id))
    ids, moments = states.id[order], states.moment[order]
    label = lifespans.label[lifespans.rows_of(ids)]
    max_speed, max_drift = class_values(classes, OfflineClass, label, "stationary_speed", "stationary_drift")
    slow = np.hypot(*states.mean[order, 2:].T) <= max_speed
    begins = np.flatnonzero(slow & np.concatenate([[True], (ids[1:] != ids[:-1]) | ~slow[:-1]]))
    ends = np.flatnonzero(slow & np.concatenate([(ids[1:] != ids[:-1]) | ~slow[1:], [True]]))
    times = evidence.times
    rows = np.flatnonzero(object_of >= 0)
    rows = rows[np.argsort(object_of[rows], kind="stable")]
    owner, seen_at = object_of[rows], evidence.moment[rows]
    kept: list[IntArray] = []
    for a, b in zip(begins.tolist(), ends.tolist(), strict=True):
        if times[moments[b]] - times[moments[a]] < settings.min_time:
            continue
        mine = slice(np.searchsorted(owner, ids[a]), np.searchsorted(owner, ids[a], side="right"))
        within = rows[mine][(seen_at[mine] >= moments[a]) & (seen_at[mine] <= moments[b])]
        if len(within) and _drift(evidence, within) <= max_drift[a]:
            kept.append(np.arange(a, b + 1))
    chosen = np.concatenate([np.empty(0, dtype=np.int64), *kept])
    chosen = chosen[np.argsort(moments[chosen], kind="stable")]
    return StationaryStates(settings, moments[chosen], ids[chosen])


def _drift(evidence: Evidence, rows: IntArray) -> float:
    """Drift of the measured positions of an object from its first to its last detection, m."""
    t = evidence.times[evidence.moment[rows]]
    w = 2 / np.trace(evidence.R[rows, :2, :2], axis1=1, axis2=2)
    dt = t - np.average(t, weights=w)
    spread = float(np.sum(w * dt**2))
    if spread == 0:
        return 0.0
    slope = (w * dt) @ evidence.boxes.position[rows, :2] / spread
    return float(np.hypot(*slope) * (t[-1] - t[0]))
