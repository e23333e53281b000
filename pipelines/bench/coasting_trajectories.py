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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics import Interval
from data_tools.metrics.block_bootstrap import Average, relative_change_of_errors
from pipelines.figures import FigureTable, cell
from pipelines.tracking import Progress
from saga_fg.arrays import FloatArray, IntArray, StrArray
from saga_fg.edge_rules import EdgeRule
from saga_fg.errors import InputError
from saga_fg.learning import (
    FittedInteractions,
    GapSample,
    GapSettings,
    JointGaps,
    OwnMotion,
    OwnMotionLikelihood,
    Trajectories,
    fit_interactions,
    gap_errors,
    gap_moments,
    predict_gaps,
    sample_gaps,
)

CLASSES = {
    "kitti": ("car",),
    "nuscenes": ("car", "pedestrian"),
    "eth_ucy": ("pedestrian",),
    "argoverse": ("car",),
    "simulated": ("car",),
}
"""The classes that are hidden, by kind of recordings; all others are neighbours."""
GAPS = (1.0, 2.0, 3.0)  # s
Method = str
AVERAGES: tuple[Average, Average] = ("median", "mean")
STRETCH = 10.0  # s


@dataclass(frozen=True, eq=False)
class CoastingErrors:
    """n gaps: recording (n,) and stretch (n,) numbers, label (n,), gap (S,) lengths, s, errors (n, S) by method, m."""

    recording: IntArray
    stretch: IntArray
    label: StrArray
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
    """Fit and measure on some recordings of one kind, fold by fold; returns what each fold learned, too.

    Raises `InputError` where the recordings of a fold have nothing to learn from.
    """
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
        if len(sample) == 0:
            taught = ", ".join(names[k] for k in training)
            wanted = f"some {' or '.join(classes)}, followed for {settings.followed:g} s"
            raise InputError(f"recordings {taught}: expected {wanted}")
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
        np.asarray(step * np.arange(1, steps + 1), dtype=np.float64),
        {method: np.concatenate([errors[method] for _, _, errors in parts]) for method in parts[0][2]},
    ), learned


def _sample(
    trajectories: Trajectories, own: OwnMotion, classes: tuple[str, ...], settings: GapSettings, number: int
) -> GapSample:
    return sample_gaps(trajectories, own.filtered(trajectories), classes, settings, number)


@dataclass(frozen=True)
class CoastingFigure:
    """Errors of one method at the end of gaps of one class, m, and their changes against kf (None for kf itself)."""

    label: str
    gap: float
    method: Method
    gaps: int
    median: float
    mean: float
    median_change: Interval | None
    mean_change: Interval | None


def coasting_figures(errors: CoastingErrors) -> list[CoastingFigure]:
    """All classes, gaps and methods."""
    rows = []
    for label in np.unique(errors.label).tolist():
        for gap in GAPS:
            for method in errors.errors:
                e = errors.of(method, label, gap)
                if len(e):
                    changes = [
                        None if method == "kf" else errors.change(method, "kf", label, gap, average)
                        for average in AVERAGES
                    ]
                    rows.append(
                        CoastingFigure(label, gap, method, len(e), float(np.median(e)), float(e.mean()), *changes)
                    )
    return rows


def coasting_table(figures: Sequence[CoastingFigure], title: str) -> FigureTable:
    """The figures as people read them."""

    def change(of: Interval | None) -> str:
        return "-" if of is None else f"{100 * of.estimate:+.1f} % ({100 * of.low:+.1f} to {100 * of.high:+.1f})"

    return FigureTable(
        f"{title}: position error when a hidden object reappears, m; 95 % intervals",
        ("class, gap", "method", "gaps", "median", "against kf", "mean", "against kf"),
        tuple(
            (
                f"{row.label}, {row.gap:g} s",
                row.method,
                str(row.gaps),
                cell(row.median),
                change(row.median_change),
                cell(row.mean),
                change(row.mean_change),
            )
            for row in figures
        ),
    )
