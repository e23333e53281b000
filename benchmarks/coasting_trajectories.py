"""Coasting on real trajectories: an object is hidden for some seconds while its neighbours stay visible.

Each method is the joint filter of `saga_fg`, told which measurement is whose; the error is the distance between where
an object is predicted at the end of a gap and where it reappears. All methods start a gap from the same measurements:

    kf            independent objects (their joint filter falls apart into one of each)
    hand-crafted  the edge rules that the configuration of the kind of data ships
    learned       `fit_by_held_out` on the other recordings
    noise alone   the process noise that goes with these interactions, without edges: what is not the neighbours' doing
    network       networks (`fit_networks`) fitted alike, where they are asked for (extra [learn])

The process noise of kf, by class, and the noise of the positions are the most likely ones, by the same likelihood of
reappearances and on the same recordings as the learned interactions; hand-crafted has those of kf. Recordings are dealt
into folds: what is measured on one was fitted on the others. Intervals are bootstraps over stretches of ten seconds.

Pedestrians in company, who walk beside another that stays visible when they are hidden, are told apart as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.block_bootstrap import Average, relative_change_of_errors
from data_tools.metrics import Interval
from pipelines.figures import FigureTable, cell
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.learning import (
    FilterNoise,
    FilterNoiseLikelihood,
    FittedInteractions,
    GapSample,
    GapSettings,
    JointGaps,
    Trajectories,
    errors_alone,
    fit_by_held_out,
    fit_interactions,
    fit_networks,
    gap_ends,
    sample_gaps,
)
from saga_fg.model.edge_rules import EdgeRule
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray

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
KF, HAND_CRAFTED, LEARNED, NETWORK = "kf", "hand-crafted", "learned", "network"
NOISE_ALONE = "noise alone"
AVERAGES: tuple[Average, Average] = ("median", "mean")
STRETCH = 10.0  # s
BESIDE, ALIKE = 2.0, 0.5  # in company: another within so many m, whose velocity differs by less than so many m/s


@dataclass(frozen=True)
class CoastingSettings:
    """How much is done: folds, how many of them are tested, gaps judged in a recording, whether by networks too."""

    folds: int = 3
    tested_folds: int | None = None
    most_gaps: int = 500
    network: bool = False


@dataclass(frozen=True, eq=False)
class CoastingErrors:
    """n gaps of up to S steps.

    recording, stretch (n,) numbers; label, in_company (n,); gap (S,) lengths, s; errors (n, S) by method, m
    """

    recording: IntArray
    stretch: IntArray
    label: StrArray
    in_company: BoolArray
    gap: FloatArray
    errors: dict[Method, FloatArray]

    def select(self, rows: IntArray | BoolArray) -> CoastingErrors:
        """Some of the gaps."""
        errors = {method: e[rows] for method, e in self.errors.items()}
        of_gaps = (self.recording[rows], self.stretch[rows], self.label[rows], self.in_company[rows])
        return CoastingErrors(*of_gaps, self.gap, errors)

    def groups(self) -> dict[str, CoastingErrors]:
        """By class, and the pedestrians in company."""
        found = {label: self.select(self.label == label) for label in np.unique(self.label).tolist()}
        together = (self.label == "pedestrian") & self.in_company
        return found | ({"pedestrian in company": self.select(together)} if together.any() else {})

    def at(self, gap: float) -> tuple[float, CoastingErrors]:
        """The length nearest to `gap`, s, and those gaps, with the errors (n,) at its end, of which that is known."""
        column = int(np.argmin(np.abs(self.gap - gap)))
        known = np.all([np.isfinite(e[:, column]) for e in self.errors.values()], axis=0)
        kept = self.select(known)
        return float(self.gap[column]), replace(kept, errors={m: e[:, column] for m, e in kept.errors.items()})

    def change(self, method: Method, base: Method, average: Average) -> Interval:
        """Relative change of the average of all errors."""
        return relative_change_of_errors(self.errors[method], self.errors[base], self.stretch, average)


def coasting_errors(
    recordings: Mapping[str, Trajectories],
    classes: tuple[str, ...],
    hand_crafted: Sequence[EdgeRule],
    settings: CoastingSettings | None = None,
    progress: Progress | None = None,
) -> tuple[CoastingErrors, dict[Method, list[FittedInteractions]]]:
    """Fit and measure on some recordings of one kind, fold by fold; returns what each fold learned, too.

    Raises `InputError` where the recordings of a fold have nothing to learn from, or not all have one rate.
    """
    settings, lengths = settings or CoastingSettings(), GapSettings()
    names, ends = list(recordings), _ends(recordings, lengths)
    folds = min(settings.folds, len(names))
    likelihoods = []
    for done, name in enumerate(names):
        likelihoods.append(FilterNoiseLikelihood(recordings[name], classes, lengths))
        if progress is not None:
            progress(f"own motion {name}", done + 1, len(names))
    methods = {LEARNED: fit_interactions} | ({NETWORK: fit_networks} if settings.network else {})
    learned: dict[Method, list[FittedInteractions]] = {method: [] for method in methods}
    parts: list[tuple[GapSample, FloatArray, dict[Method, FloatArray]]] = []
    for fold in range(min(folds, settings.tested_folds or folds)):
        training = [k for k in range(len(names)) if k % folds != fold]
        own = FilterNoise.most_likely([likelihoods[k] for k in training])
        if not any(n for k in training for n in likelihoods[k].count.values()):
            taught = ", ".join(names[k] for k in training)
            wanted = f"some {' or '.join(classes)}, followed for {lengths.followed:g} s"
            raise InputError(f"recordings {taught}: expected {wanted}")
        teaching = [recordings[names[k]] for k in training]
        for method, fit in methods.items():
            learned[method].append(fit_by_held_out(teaching, classes, own, fit, lengths))
            if progress is not None:
                progress(f"{method}, fold {fold + 1}", len(learned[method]), folds)
        for k in range(fold, len(names), folds):
            trajectories = recordings[names[k]]
            gaps = _sample(trajectories, own, classes, lengths, k).drawn(settings.most_gaps, seed=1)
            fitted = {method: found[-1] for method, found in learned.items()}
            errors = _errors(trajectories, gaps, own, hand_crafted, fitted, lengths)
            alone = FilterNoise(fitted[LEARNED].acceleration_noise, own.position_noise)
            same = _sample(trajectories, alone, classes, lengths, k).drawn(settings.most_gaps, seed=1)
            errors[NOISE_ALONE] = errors_alone(same)
            parts.append((gaps, trajectories.time[gaps.moment] // STRETCH, errors))
            if progress is not None:
                progress(f"coasting {names[k]}", len(parts), len(names))
    recording = np.concatenate([gaps.recording for gaps, _, _ in parts])
    stretch = np.unique(np.stack([recording, np.concatenate([s for _, s, _ in parts])]), axis=1, return_inverse=True)[1]
    return CoastingErrors(
        recording,
        stretch,
        np.concatenate([gaps.label for gaps, _, _ in parts]),
        np.concatenate([_in_company(gaps) for gaps, _, _ in parts]),
        ends,
        {method: np.concatenate([errors[method] for _, _, errors in parts]) for method in parts[0][2]},
    ), learned


def _ends(recordings: Mapping[str, Trajectories], lengths: GapSettings) -> FloatArray:
    """Times (S,) from the beginning of a gap to the ends of its steps, s, which all recordings have in common."""
    (first, ends), *others = [(name, gap_ends(each, lengths)) for name, each in recordings.items()]
    for name, its in others:
        if len(its) != len(ends) or not np.allclose(its, ends, rtol=0.1):
            told = f"{ends[0]:.3g} s as in {first}, got {its[0]:.3g} s"
            raise InputError(f"recording {name}: expected moments that allow steps of {told}")
    return ends


def _errors(
    trajectories: Trajectories,
    gaps: GapSample,
    own: FilterNoise,
    hand_crafted: Sequence[EdgeRule],
    learned: Mapping[Method, FittedInteractions],
    lengths: GapSettings,
) -> dict[Method, FloatArray]:
    """(n, S) by method."""
    filtered = own.filtered(trajectories)
    errors = {KF: errors_alone(gaps)}
    joint: dict[Method, tuple[Sequence[EdgeRule], Mapping[str, float], float]]
    joint = {HAND_CRAFTED: (tuple(hand_crafted), own.acceleration_noise, 0.0)}
    joint |= {method: (f.rules, f.acceleration_noise, f.explained_noise) for method, f in learned.items()}
    for method, (rules, noise, explained) in joint.items():
        filters = JointGaps(trajectories, filtered, noise, own.position_noise, rules, explained)
        errors[method] = filters.errors(gaps, lengths)
    return errors


def _sample(
    trajectories: Trajectories, own: FilterNoise, classes: tuple[str, ...], lengths: GapSettings, number: int
) -> GapSample:
    return sample_gaps(trajectories, own.filtered(trajectories), classes, lengths, number)


def _in_company(gaps: GapSample) -> BoolArray:
    """(n,) whether another of the class moves alike beside the object when it is hidden."""
    offset = gaps.other_mean[:, 0] - gaps.mean[:, None]
    near, alike = (np.hypot(offset[..., k], offset[..., k + 1]) for k in (0, 2))
    same = (gaps.other_seen[:, 0] > 0) & (gaps.other_label == gaps.label[:, None])
    return np.asarray((same & (near < BESIDE) & (alike < ALIKE)).any(axis=1))


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
    for group, mine in errors.groups().items():
        for asked in GAPS:
            gap, there = mine.at(asked)
            for method, e in there.errors.items():
                if len(e):
                    changes = [None if method == KF else there.change(method, KF, average) for average in AVERAGES]
                    rows.append(
                        CoastingFigure(group, gap, method, len(e), float(np.median(e)), float(e.mean()), *changes)
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
                f"{row.label}, {row.gap:.1f} s",
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
