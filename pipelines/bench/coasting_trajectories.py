"""Coasting on real trajectories: an object is hidden for some seconds while its neighbours stay visible.

Each method is the joint filter of `saga_fg`, told which measurement is whose; the error is the distance between where
an object is predicted at the end of a gap and where it reappears. All methods start a gap from the same measurements:

    kf            independent objects (their joint filter falls apart into one of each)
    hand-crafted  the edge rules that the configuration of the kind of data ships
    learned       `fit_interactions` on the other recordings

The process noise of kf, by class, and the noise of the positions are the most likely ones, by the same likelihood of
reappearances and on the same recordings as the learned interactions; hand-crafted has those of kf. Recordings are dealt
into folds: what is measured on one was fitted on the others. Intervals are bootstraps over stretches of ten seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics import Interval
from data_tools.metrics.block_bootstrap import Average, relative_change_of_errors
from saga_fg.arrays import FloatArray, IntArray
from saga_fg.edge_rules import EdgeRule
from saga_fg.learning.gap_prediction import gap_errors, predict_gaps
from saga_fg.learning.gaps import GapSample, GapSettings, gap_moments, sample_gaps
from saga_fg.learning.interaction_fit import FittedInteractions, fit_interactions
from saga_fg.learning.joint_gaps import JointGaps
from saga_fg.learning.own_motion_fit import OwnMotion, OwnMotionLikelihood
from saga_fg.learning.trajectories import Trajectories

Method = str
Progress = Callable[[str, int, int], None]
STRETCH = 10.0  # s


@dataclass(frozen=True, eq=False)
class CoastingErrors:
    """n gaps: recording (n,) and stretch (n,) numbers, label (n,), gap (S,) lengths, s, errors (n, S) by method, m."""

    recording: IntArray
    stretch: IntArray
    label: np.ndarray
    gap: FloatArray
    errors: dict[Method, FloatArray]

    def change(self, method: Method, base: Method, label: str, gap: float, average: Average) -> Interval:
        """Relative change of the average error of a class at the end of gaps of `gap` seconds."""
        rows, column = self._rows(label, gap)
        a, b = (self.errors[name][rows, column] for name in (method, base))
        return relative_change_of_errors(a, b, self.stretch[rows], average)

    def of(self, method: Method, label: str, gap: float) -> FloatArray:
        """The errors of a class at the end of gaps of `gap` seconds, m."""
        rows, column = self._rows(label, gap)
        return np.asarray(self.errors[method][rows, column])

    def _rows(self, label: str, gap: float) -> tuple[IntArray, int]:
        column = int(np.argmin(np.abs(self.gap - gap)))
        known = np.all([np.isfinite(e[:, column]) for e in self.errors.values()], axis=0)
        return np.flatnonzero(known & (self.label == label)), column


def coasting_errors(
    recordings: Mapping[str, Trajectories],
    classes: tuple[str, ...],
    hand_crafted: Sequence[EdgeRule],
    folds: int = 3,
    settings: GapSettings | None = None,
    progress: Progress | None = None,
) -> tuple[CoastingErrors, list[FittedInteractions]]:
    """Fit and measure on some recordings of one kind, fold by fold; returns what each fold learned, too."""
    settings = settings or GapSettings()
    names = list(recordings)
    folds = min(folds, len(names))
    likelihoods = [OwnMotionLikelihood(recordings[name], classes, settings) for name in names]
    parts: list[tuple[GapSample, FloatArray, dict[Method, FloatArray]]] = []
    learned = []
    for fold in range(folds):
        training = [k for k in range(len(names)) if k % folds != fold]
        own = OwnMotion.most_likely([likelihoods[k] for k in training])
        sample = GapSample.pool([_sample(recordings[names[k]], own, classes, settings, k) for k in training])
        fitted = fit_interactions(sample, own.position_noise, own.acceleration_noise)
        learned.append(fitted)
        for k in range(fold, len(names), folds):
            trajectories = recordings[names[k]]
            filtered = own.filtered(trajectories)
            gaps = sample_gaps(trajectories, filtered, classes, settings, k)
            joint = (
                ("hand-crafted", tuple(hand_crafted), own.acceleration_noise, 0.0),
                ("learned", fitted.rules, fitted.acceleration_noise, fitted.explained_noise),
            )
            errors = {"kf": gap_errors(gaps, predict_gaps(gaps, lambda _features, _seen: [], 0.0, 0.0))}
            for method, rules, noise, explained in joint:
                filters = JointGaps(trajectories, filtered, noise, own.position_noise, rules, explained)
                errors[method] = filters.errors(gaps, settings)
            parts.append((gaps, trajectories.time[gaps.moment] // STRETCH, errors))
            if progress is not None:
                progress(f"coasting {names[k]}", len(parts), len(names))
    recording = np.concatenate([gaps.recording for gaps, _, _ in parts])
    stretch = np.unique(np.stack([recording, np.concatenate([s for _, s, _ in parts])]), axis=1, return_inverse=True)[1]
    first = next(iter(recordings.values()))
    _, stride, steps = gap_moments(first, settings)
    step = stride * float(np.median(np.diff(first.time)))
    return CoastingErrors(
        recording,
        stretch,
        np.concatenate([gaps.label for gaps, _, _ in parts]),
        step * np.arange(1, steps + 1),
        {method: np.concatenate([errors[method] for _, _, errors in parts]) for method in parts[0][2]},
    ), learned


def _sample(
    trajectories: Trajectories, own: OwnMotion, classes: tuple[str, ...], settings: GapSettings, number: int
) -> GapSample:
    return sample_gaps(trajectories, own.filtered(trajectories), classes, settings, number)
