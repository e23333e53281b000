"""Artificial gaps in trajectories: an object is hidden for some seconds while its neighbours stay in view.

Interactions are learned from, and evaluated by, the innovations at the steps of a gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.learning.independent_filter import FilteredTrajectories
from saga_fg.learning.trajectories import Trajectories
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns


@dataclass(frozen=True)
class GapSettings:
    """longest gap and time between its steps, s; how long an object is in view before; how often gaps start, s;

    neighbours: at most so many, within `reach` m when the gap starts
    """

    longest: float = 3.0
    step: float = 0.5
    followed: float = 1.0
    spacing: float = 1.0
    neighbours: int = 8
    reach: float = 50.0


@dataclass(frozen=True, eq=False)
class GapSample(Columns):
    """W gaps of S steps with at most M neighbours.

    moment, row      (W,) where in the recording, and of which object; recording (W,) number, label (W,)
    mean, P          (W, 4), (W, 4, 4) of the object when the gap starts; heading, has_moved (W,) then
    dt               (W, S) lengths of the steps, s; 0 after the end of the recording
    measured         (W, S, 2) where it truly is at the end of each step, NaN where unknown
    other_mean       (W, S, M, 4) of the neighbours when the step starts; other_heading, other_moved, other_seen
                     (W, S, M); other_label (W, M)
    """

    moment: IntArray
    row: IntArray
    recording: IntArray
    label: StrArray
    mean: FloatArray
    P: FloatArray
    heading: FloatArray
    has_moved: FloatArray
    dt: FloatArray
    measured: FloatArray
    other_mean: FloatArray
    other_heading: FloatArray
    other_moved: FloatArray
    other_seen: FloatArray
    other_label: StrArray

    def sampled(self, most: int, seed: int) -> Self:
        """At most `most` of the gaps, chosen at random."""
        if len(self) <= most:
            return self
        return self.select(np.sort(np.random.default_rng(seed).choice(len(self), most, replace=False)))


def gap_moments(trajectories: Trajectories, settings: GapSettings) -> tuple[IntArray, int, int]:
    """Moments at which gaps start, how many moments a step has, and how many steps a gap."""
    dt = _interval(trajectories, settings)
    stride = max(1, round(settings.step / dt))
    spacing = max(1, round(settings.spacing / dt))
    steps = max(1, round(settings.longest / (stride * dt)))
    return np.arange(0, max(len(trajectories) - 1, 1), spacing), stride, steps


def gap_ends(trajectories: Trajectories, settings: GapSettings) -> FloatArray:
    """Times (S,) from the beginning of a gap to the ends of its steps, s."""
    _, stride, steps = gap_moments(trajectories, settings)
    return stride * _interval(trajectories, settings) * np.arange(1, steps + 1, dtype=np.float64)


def _interval(trajectories: Trajectories, settings: GapSettings) -> float:
    """Return the median interval between moments, s."""
    return float(np.median(np.diff(trajectories.time))) if len(trajectories) > 1 else settings.step


def sample_gaps(
    trajectories: Trajectories,
    filtered: FilteredTrajectories,
    classes: tuple[str, ...],
    settings: GapSettings | None = None,
    recording: int = 0,
) -> GapSample:
    """All gaps of objects of some classes; neighbours may be of any. Raises `InputError` for an empty recording."""
    settings = settings or GapSettings()
    if len(trajectories) == 0:
        raise InputError("trajectories: expected at least one moment")
    starts, stride, steps = gap_moments(trajectories, settings)
    K, M = len(trajectories), settings.neighbours
    seen = np.isfinite(filtered.mean[..., 0])
    target = np.isin(trajectories.label, classes)
    parts: list[list[FloatArray | IntArray | StrArray]] = []
    for k in starts.tolist():
        moments = k + stride * np.arange(steps + 1)
        inside = moments < K
        at = np.minimum(moments, K - 1)
        known = seen[at[1:]] & inside[1:, None]
        enough = np.nan_to_num(filtered.followed[k], nan=-1.0) >= settings.followed - 1e-6
        rows = np.flatnonzero(target & enough & known.any(axis=0))
        position = filtered.mean[k, :, :2]
        distance = np.hypot(*np.moveaxis(position[None] - position[rows, None], -1, 0))
        distance = np.where(np.isfinite(distance) & (distance <= settings.reach), distance, np.inf)
        distance[np.arange(len(rows)), rows] = np.inf
        near = np.argsort(distance, axis=1)[:, :M]
        there = np.isfinite(np.take_along_axis(distance, near, axis=1))
        near, there = _padded(near, M), _padded(there, M)
        step = at[:-1, None, None]  # neighbours (S, W, M) as they are when a step starts
        in_view = seen[step, near] & inside[:-1, None, None] & there
        measured = np.where(known[:, rows, None], trajectories.position[at[1:]][:, rows], np.nan)
        dt = np.where(inside[1:], np.diff(trajectories.time[at]), 0.0)
        n = len(rows)
        parts.append(
            [
                np.full(n, k),
                rows,
                np.full(n, recording),
                trajectories.label[rows],
                filtered.mean[k, rows],
                filtered.covariance[k, rows],
                filtered.heading[k, rows],
                filtered.has_moved[k, rows].astype(np.float64),
                np.tile(dt, (n, 1)),
                np.swapaxes(measured, 0, 1),
                np.swapaxes(np.where(in_view[..., None], filtered.mean[step, near], 0.0), 0, 1),
                np.swapaxes(np.where(in_view, filtered.heading[step, near], 0.0), 0, 1),
                np.swapaxes(np.where(in_view, filtered.has_moved[step, near], 0.0), 0, 1),
                np.swapaxes(in_view.astype(np.float64), 0, 1),
                np.where(there, trajectories.label[near], ""),
            ]
        )
    return GapSample(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _padded(columns: IntArray, M: int) -> IntArray:
    """(W, n <= M) with zeros up to M columns."""
    return np.pad(columns, ((0, 0), (0, M - columns.shape[1])))
