"""`python -m benchmarks gaps`: where is an object that is hidden for some seconds while its neighbours stay visible?

Recorded trajectories. Each method is the joint filter of `saga_fg`, told which measurement is of which object; the
error is the distance between the prediction at the end of a gap and the place where the object reappears. All methods
start a gap from the same measurements:

    kf            independent objects
    hand-crafted  the edge rules that the configuration of the kind of data ships
    learned       `fit_by_held_out` on the other recordings
    noise alone   the process noise learned with these interactions, without edges
    network       networks (`fit_networks`) fitted alike, if asked for (extra [learn])

The process noise of kf, by class, and the noise of the positions are the most likely ones on the recordings that the
interactions are learned from; hand-crafted has those of kf. Recordings are dealt into folds: each is tested with what
the others taught. Intervals are bootstraps over blocks of ten seconds.

Pedestrians with companions, who walk beside another that stays visible, are a group of their own as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.block_bootstrap import Average, relative_change_of_errors
from data_tools.datasets.registry import dataset_source
from data_tools.datasets.source import DatasetSource, names
from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.config import load_config
from pipelines.learning import trajectories
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
    "argoverse2": ("car",),
    "simulated": ("car",),
}
"""The classes that are hidden, by kind of recordings; all others are neighbours."""
GAPS = (1.0, 2.0, 3.0)  # s
Method = str
KF, HAND_CRAFTED, LEARNED, NETWORK = "kf", "hand-crafted", "learned", "network"
NOISE_ALONE = "noise alone"
AVERAGES: tuple[Average, Average] = ("median", "mean")
BLOCK = 10.0  # s
BESIDE, ALIKE = 2.0, 0.5  # a companion: another within so many m whose velocity differs by less than so many m/s


def annotated_source(kind: str, place: str, recordings: Sequence[str] | None = None) -> DatasetSource:
    """The recordings of a dataset in a folder, or so many simulated scenes; all, or those that are named.

    Raises `InputError` for a number of scenes that is none.
    """
    if kind == "simulated" and (not place.isdecimal() or int(place) == 0):
        raise InputError(f"--data simulated={place}: expected a number of scenes")
    chosen: dict[str, Any] = {"scenes": int(place)} if kind == "simulated" else {"dataroot": place}
    if kind == "nuscenes":
        chosen["split"] = "all"
    source = dataset_source(kind)(**chosen)
    return source if recordings is None else source.restricted(recordings)


@dataclass(frozen=True)
class GapBenchSettings:
    """How much is done: folds, how many of them are tested, gaps judged in a recording, whether by networks too."""

    folds: int = 3
    tested_folds: int | None = None
    most_gaps: int = 500
    network: bool = False


@dataclass(frozen=True, eq=False)
class GapErrors:
    """n gaps of up to S steps.

    recording, block (n,) numbers; label, with_companions (n,); gap (S,) lengths, s; errors (n, S) by method, m
    """

    recording: IntArray
    block: IntArray
    label: StrArray
    with_companions: BoolArray
    gap: FloatArray
    errors: dict[Method, FloatArray]

    def select(self, rows: IntArray | BoolArray) -> GapErrors:
        """Some of the gaps."""
        errors = {method: e[rows] for method, e in self.errors.items()}
        of_gaps = (self.recording[rows], self.block[rows], self.label[rows], self.with_companions[rows])
        return GapErrors(*of_gaps, self.gap, errors)

    def groups(self) -> dict[str, GapErrors]:
        """By class, and the pedestrians with companions."""
        found = {label: self.select(self.label == label) for label in np.unique(self.label).tolist()}
        together = (self.label == "pedestrian") & self.with_companions
        return found | ({"pedestrian with companions": self.select(together)} if together.any() else {})

    def at(self, gap: float) -> tuple[float, GapErrors]:
        """The length nearest to `gap`, s, and those gaps, with the errors (n,) at its end, of which that is known."""
        column = int(np.argmin(np.abs(self.gap - gap)))
        known = np.all([np.isfinite(e[:, column]) for e in self.errors.values()], axis=0)
        kept = self.select(known)
        return float(self.gap[column]), replace(kept, errors={m: e[:, column] for m, e in kept.errors.items()})

    def change(self, method: Method, base: Method, average: Average) -> Interval:
        """Relative change of the average of all errors."""
        return relative_change_of_errors(self.errors[method], self.errors[base], self.block, average)


def gap_errors(
    recordings: Mapping[str, Trajectories],
    classes: tuple[str, ...],
    hand_crafted: Sequence[EdgeRule],
    settings: GapBenchSettings | None = None,
    progress: Progress | None = None,
) -> tuple[GapErrors, dict[Method, list[FittedInteractions]]]:
    """Fit and measure on some recordings of one kind, fold by fold; returns what each fold learned, too.

    Raises `InputError` where the recordings of a fold have nothing to learn from, or not all have one rate.
    """
    settings, lengths = settings or GapBenchSettings(), GapSettings()
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
            gaps = _sample(trajectories, own, classes, lengths, k).sampled(settings.most_gaps, seed=1)
            fitted = {method: found[-1] for method, found in learned.items()}
            errors = _errors(trajectories, gaps, own, hand_crafted, fitted, lengths)
            alone = FilterNoise(fitted[LEARNED].acceleration_noise, own.position_noise)
            same = _sample(trajectories, alone, classes, lengths, k).sampled(settings.most_gaps, seed=1)
            errors[NOISE_ALONE] = errors_alone(same)
            parts.append((gaps, trajectories.time[gaps.moment] // BLOCK, errors))
            if progress is not None:
                progress(f"coasting {names[k]}", len(parts), len(names))
    recording = np.concatenate([gaps.recording for gaps, _, _ in parts])
    block = np.unique(np.stack([recording, np.concatenate([s for _, s, _ in parts])]), axis=1, return_inverse=True)[1]
    return GapErrors(
        recording,
        block,
        np.concatenate([gaps.label for gaps, _, _ in parts]),
        np.concatenate([_with_companions(gaps) for gaps, _, _ in parts]),
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


def _with_companions(gaps: GapSample) -> BoolArray:
    """(n,) whether another of the class moves alike beside the object when it is hidden."""
    offset = gaps.other_mean[:, 0] - gaps.mean[:, None]
    near, alike = (np.hypot(offset[..., k], offset[..., k + 1]) for k in (0, 2))
    same = (gaps.other_seen[:, 0] > 0) & (gaps.other_label == gaps.label[:, None])
    return np.asarray((same & (near < BESIDE) & (alike < ALIKE)).any(axis=1))


@dataclass(frozen=True)
class GapFigure:
    """Errors of one method at the end of gaps of one class, m, and their changes against kf (None for kf itself)."""

    label: str
    gap: float
    method: Method
    gaps: int
    median: float
    mean: float
    median_change: Interval | None
    mean_change: Interval | None


def gap_figures(errors: GapErrors) -> list[GapFigure]:
    """All classes, gaps and methods."""
    rows = []
    for group, mine in errors.groups().items():
        for asked in GAPS:
            gap, there = mine.at(asked)
            for method, e in there.errors.items():
                if len(e):
                    changes = [None if method == KF else there.change(method, KF, average) for average in AVERAGES]
                    rows.append(GapFigure(group, gap, method, len(e), float(np.median(e)), float(e.mean()), *changes))
    return rows


def gap_table(figures: Sequence[GapFigure], title: str) -> FigureTable:
    """A row for each class, gap and method."""
    rows = []
    for row in figures:
        changes = ("-" if c is None else percent(c) for c in (row.median_change, row.mean_change))
        median, mean = changes
        name = f"{row.label}, {row.gap:.1f} s"
        rows.append((name, row.method, str(row.gaps), cell(row.median), median, cell(row.mean), mean))
    title = f"{title}: position error when a hidden object reappears, m; 95 % intervals"
    columns = ("class, gap", "method", "gaps", "median", "against kf", "mean", "against kf")
    return FigureTable(title, columns, tuple(rows))


def gaps(
    data: Annotated[
        list[str],
        typer.Option(
            "--data",
            help="Recordings with ground truth: kitti=, nuscenes=, eth_ucy=, argoverse2= with their folder, simulated= "
            "with a number of scenes; repeatable.",
            metavar="KIND=PLACE",
        ),
    ],
    recordings: Annotated[
        str | None, typer.Option("--recordings", help="Recordings of a single --data, with commas between them.")
    ] = None,
    folds: Annotated[int, typer.Option("--folds", min=2, help="Each is tested with what the others taught.")] = 3,
    tested_folds: Annotated[
        int | None, typer.Option("--tested-folds", min=1, help="Test the first folds only; all if left out.")
    ] = None,
    most: Annotated[int, typer.Option("--gaps", min=1, help="Gaps judged in a recording, sampled from all.")] = 500,
    network: Annotated[
        bool, typer.Option("--network", help="Train networks too (extra [learn]); minutes a fold.")
    ] = False,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Hide one object for 1, 2 and 3 s while its neighbours stay visible: the error when it reappears.

    Independent objects (kf) against the hand-crafted and the learned interactions. Process noise and interactions are
    fitted on other recordings than those that are tested. Intervals are bootstraps over blocks of 10 s.

    \b
    Examples:
      python -m benchmarks gaps --data kitti=data/kitti --json gaps.json
      python -m benchmarks gaps --data eth_ucy=data/eth_ucy --data simulated=6
      python -m benchmarks gaps --data kitti=data/kitti --network --tested-folds 1
    """
    if recordings is not None and len(data) != 1:
        raise InputError(f"--recordings {recordings}: goes with a single --data")
    chosen = names("--recordings", recordings) if recordings is not None else None
    shown, figures, settings = [], {}, GapBenchSettings(folds, tested_folds, most, network)
    for kind, _, place in (value.partition("=") for value in data):
        if kind not in CLASSES or not place:
            expected = f"expected KIND=PLACE of recordings with ground truth: {', '.join(CLASSES)}"
            raise InputError(f"--data {kind}={place}: {expected}")
        source = annotated_source(kind, place, chosen)
        found = trajectories(source, with_truth=True)
        if len(found) < 2:
            raise InputError(f"--data {kind}={place}: expected at least two recordings")
        rules = load_config(source.family, config).tracker.edges
        with progress_bar(unit="recordings") as progress:
            errors, learned = gap_errors(found, CLASSES[kind], rules, settings, progress)
        rows = gap_figures(errors)
        shown.append(gap_table(rows, f"{kind}, {len(found)} recordings"))
        figures[kind] = {"recordings": list(found), "figures": rows, "learned": learned}
    report(shown, figures, json_file)
