"""A tracker's runs through gaps that are made in recordings, judged gap by gap and by situation.

Labels and tracks that were detected at the moment are matched one to one (`data_tools.metrics.scene`). An object is
*held* by the track it was matched to last, at most `SETTLING` s ago. That track, which is kept alive while it has no
detections, is compared with the label: its error, m, which is `CAP` where it is not known or farther away, and how
likely the true place is by its covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import TypeVar

import numpy as np

from data_tools.figures import FigureTable, cell
from data_tools.metrics import Interval, coverage, paired_bootstrap
from data_tools.metrics.bootstrap import Comparison, difference, ratio_of_sums, relative_change
from data_tools.metrics.error_sample import nees, negative_log_density
from data_tools.metrics.scene import match_scene
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.learning.gaps import LENGTHS, LONGEST, SITUATIONS, Gap, made_gaps, reached, situations_of
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame
from saga_fg.types.track import Tracks

SETTLING = 0.6  # s: for so long a returning object may wait for its identity
DETECTED = 0.15  # s: a track counts as detected for so long, as sensors don't measure at the moments of labels
CAP = 10.0  # m
GATE = 2.0  # m, between a label and its track
LIFE = LONGEST + 1.0  # s: for so long tracks live without a detection

A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Prediction:
    """A track without detections against the label of its object.

    error   m, however large;  nees: its square by the covariance of the position, chi-squared with 2 degrees of freedom
    nll     negative logarithm of the density of the true position, nats;  NaN, as nees, without a covariance
    """

    error: float
    nees: float
    nll: float


@dataclass(frozen=True)
class GapOutcome:
    """The outcome of one gap of an object, by the lengths that the gap reaches.

    at         error at the end of the length, m
    predicted  where the track that had the object is, if it is among the results
    """

    at: Mapping[float, float]
    predicted: Mapping[float, Prediction]


class JudgedRun:
    """A run's tracks (K,) at the moments of a labelled scene.

    track_of  for each moment, the detected track of each object that has one, by its name
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks]) -> None:
        self.labelled, self.tracks = labelled, tracks
        truth = labelled.scene.ground_truth
        assert truth is not None
        self.detected = [found.select(found.coasting <= DETECTED) for found in tracks]
        self.track_of: list[dict[str, int]] = []
        for moment, found, match in zip(truth, self.detected, match_scene(truth, self.detected, GATE), strict=True):
            pairs = (moment.id[match.object_row].tolist(), found.id[match.track_row].tolist())
            self.track_of.append(dict(zip(*pairs, strict=True)))
        self.row_of = [{name: row for row, name in enumerate(found.id.tolist())} for found in tracks]

    def outcome(self, gap: Gap) -> GapOutcome:
        """Judge one gap."""
        ends, holder = reached(self.labelled.scene.timestamps, gap), self.holder(gap)
        if holder is None:
            return GapOutcome(dict.fromkeys(ends, CAP), {})
        at = {length: self.error(holder, gap.row, k) for length, k in ends.items()}
        predicted = {h: found for h, k in ends.items() if (found := self._prediction(holder, gap.row, k)) is not None}
        return GapOutcome({h: e for h, e in at.items() if np.isfinite(e)}, predicted)

    def holder(self, gap: Gap) -> int | None:
        """The track that held the object before the gap."""
        return self.last(self.track_of, str(self.labelled.id[gap.row]), gap.start, back=True)

    def last(self, of: Sequence[Mapping[A, B]], one: A, moment: int, back: bool) -> B | None:
        """The last partner within `SETTLING` s until a moment (`back`), or from it on."""
        after = (self.labelled.scene.timestamps - self.labelled.scene.timestamps[moment]) * (-1 if back else 1)
        near = np.flatnonzero((after >= 0) & (after <= SETTLING))
        return next((of[k][one] for k in near[::-1].tolist() if one in of[k]), None)

    def error(self, track: int, row: int, moment: int) -> float:
        """The error of a track at a moment, NaN where the object is not labelled."""
        truth = self.labelled.position[moment, row]
        if not np.isfinite(truth[0]):
            return float("nan")
        there = self.position(track, moment)
        return CAP if there is None else min(float(np.hypot(*(there - truth))), CAP)

    def position(self, track: int, moment: int) -> FloatArray | None:
        """The place (2,) of a track, None where it is not among the results."""
        row = self.row_of[moment].get(track)
        return None if row is None else np.asarray(self.tracks[moment].boxes.position[row, :2])

    def _prediction(self, track: int, row: int, moment: int) -> Prediction | None:
        truth, at = self.labelled.position[moment, row], self.row_of[moment].get(track)
        if at is None or not np.isfinite(truth[0]):
            return None
        error = self.tracks[moment].boxes.position[at, :2] - truth
        covariance = self.tracks[moment].position_covariance[at]
        squared = nees(error[None], covariance[None])
        nll = negative_log_density(squared, covariance[None])
        return Prediction(float(np.hypot(*error)), float(squared[0]), float(nll[0]))


@dataclass(frozen=True)
class Contender:
    """A method with its configuration."""

    name: str
    method: Method
    config: TrackConfig

    def kept_alive(self) -> Contender:
        """The contender whose tracks live, and are reported, for as long as any gap."""
        config, own = self.config, self.config.tracker
        tracker = replace(
            own,
            report_coasting=inf,
            max_coasting=LIFE,
            max_out_of_view=inf,
            classes={label: replace(each, max_deviation=inf) for label, each in own.classes.items()},
            existence=replace(own.existence, delete_below=0.0, report_above=0.0),
        )
        greedy = replace(config.greedy, max_coasting=LIFE)
        return replace(self, config=replace(config, tracker=tracker, greedy=greedy))


@dataclass(frozen=True)
class Run:
    """A contender's outcomes in the gaps of one recording.

    cluster     the first of the recordings that overlap with this one, or itself
    situations  of the object of each gap, by the length until which; none for real gaps
    """

    recording: str
    cluster: str
    contender: str
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    situations: tuple[Mapping[float, frozenset[str]], ...]
    outcomes: tuple[GapOutcome, ...]


def judged_on(
    scenes: Mapping[str, Scene],
    contenders: Sequence[Contender],
    passes: int,
    seed: int,
    progress: Progress | None = None,
) -> list[Run]:
    """Runs of all contenders, whose sensors are the same, on recordings with made gaps, tracks kept alive."""
    runs: list[Run] = []
    for name, scene in scenes.items():
        labelled = LabelledScene.from_scene(scene, contenders[0].config.sensors)
        gaps = made_gaps(labelled, passes, seed)
        for contender in contenders:
            outcomes: dict[int, GapOutcome] = {}
            for number in sorted({gap.run for gap in gaps}):
                mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
                run = JudgedRun(labelled, tracks_without(labelled, list(mine.values()), contender.kept_alive()))
                outcomes |= {k: run.outcome(gap) for k, gap in mine.items()}
            about = gaps_of(labelled, gaps)
            runs.append(Run(name, name, contender.name, *about, tuple(outcomes[k] for k in range(len(gaps)))))
            if progress is not None:
                progress(f"held out {name} {contender.name}", len(runs), len(scenes) * len(contenders))
    return runs


def gaps_of(
    labelled: LabelledScene, gaps: Sequence[Gap]
) -> tuple[tuple[Gap, ...], tuple[str, ...], tuple[Mapping[float, frozenset[str]], ...]]:
    """Gaps, the classes of their objects, and the situations of these; none for real gaps."""
    label = tuple(str(labelled.label[gap.row]) for gap in gaps)
    return tuple(gaps), label, tuple(situations_of(labelled, gap) if gap.run > 0 else {} for gap in gaps)


def tracks_without(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender) -> Sequence[Tracks]:
    """A contender's tracks without the detections of some gaps."""
    scene = replace(labelled.scene, frames=hidden(labelled, gaps) if gaps else labelled.scene.frames)
    return track_scene(scene, contender.config.new_tracker(contender.method)).tracks


def hidden(labelled: LabelledScene, gaps: Sequence[Gap]) -> list[Frame]:
    """The frames without the detections of some gaps."""
    time = labelled.scene.timestamps
    start = np.array([time[gap.start] for gap in gaps])
    stop = np.array([time[gap.stop] for gap in gaps])
    return labelled.frames_without(np.array([gap.row for gap in gaps]), start, stop)


R = TypeVar("R", bound=Run)
PROBABILITIES = (0.5, 0.9)
FEWEST_RECORDINGS, FEWEST_GAPS = 3, 5  # of an interval


@dataclass(frozen=True)
class SituationFigure:
    """One contender at one time after the start of made gaps, in one situation.

    gaps      in which the track is still among the results;  lost: others
    error     mean, m, not capped; error_change: relative to the reference, over gaps in which both have a track
    median    of the errors, m
    nll       mean negative logarithm of the density of the true position, nats; nll_change: a difference
    coverage  share of true positions within the ellipse of each probability
    """

    situation: str
    length: float
    contender: str
    gaps: int
    lost: int
    error: Interval
    error_change: Interval | None
    median: float
    nll: Interval
    nll_change: Interval | None
    coverage: Mapping[float, float]


def situation_figures(runs: Sequence[Run], reference: str) -> list[SituationFigure]:
    """All lengths, situations that occur, and contenders, of runs whose tracks are kept alive."""
    mine = {name: [run for run in runs if run.contender == name] for name in dict.fromkeys(r.contender for r in runs)}
    base = mine.get(reference, next(iter(mine.values()), []))
    figures = []
    for length in LENGTHS:
        for situation in SITUATIONS:
            if any(situation in at.get(length, ()) for run in base for at in run.situations):
                figures += [_figure(situation, length, found, base) for found in mine.values()]
    return figures


def _figure(situation: str, length: float, runs: Sequence[Run], base: Sequence[Run]) -> SituationFigure:
    def values(of: Sequence[Run], value: Callable[[Prediction], float]) -> list[FloatArray]:
        return by_cluster(of, lambda run: _values(run, situation, length, value))

    error, nll = (lambda found: found.error), (lambda found: found.nll)
    errors, densities, nees = values(runs, error), values(runs, nll), values(runs, lambda found: found.nees)
    changes: list[Interval | None] = [None, None]
    if runs[0].contender != base[0].contender:
        changes = [
            compared(errors, values(base, error), relative_change),
            compared(densities, values(base, nll), difference),
        ]
    every, squares = (np.concatenate(each) for each in (errors, nees))
    known = every[np.isfinite(every)]
    return SituationFigure(
        situation=situation,
        length=length,
        contender=runs[0].contender,
        gaps=len(known),
        lost=len(every) - len(known),
        error=interval(errors),
        error_change=changes[0],
        median=float(np.median(known)) if len(known) else float("nan"),
        nll=interval(densities),
        nll_change=changes[1],
        coverage={p: coverage(squares[np.isfinite(squares)], p) for p in PROBABILITIES},
    )


def _values(run: Run, situation: str, length: float, value: Callable[[Prediction], float]) -> FloatArray:
    """Values of the gaps in the situation, NaN where the track is lost."""
    found = [
        outcome.predicted.get(length)
        for outcome, at in zip(run.outcomes, run.situations, strict=True)
        if situation in at.get(length, ())
    ]
    return np.array([float("nan") if each is None else value(each) for each in found], dtype=np.float64)


def by_cluster(runs: Sequence[R], values: Callable[[R], FloatArray]) -> list[FloatArray]:
    """The values of the runs, those on recordings that overlap as one."""
    found: dict[str, list[FloatArray]] = {}
    for run in runs:
        found.setdefault(run.cluster, []).append(values(run))
    return [np.concatenate(each) for each in found.values()]


def compared(ours: Sequence[FloatArray], theirs: Sequence[FloatArray], compare: Comparison) -> Interval | None:
    """The change of the mean over gaps that both have a value of; None where there are none."""
    a, b = [], []
    for mine, other in zip(ours, theirs, strict=True):
        both = np.isfinite(mine) & np.isfinite(other)
        if both.any():
            a.append((mine[both].sum(), both.sum()))
            b.append((other[both].sum(), both.sum()))
    if not a:
        return None
    found = paired_bootstrap(np.array(a), np.array(b), ratio_of_sums, compare)
    if len(a) < FEWEST_RECORDINGS or sum(n for _, n in a) < FEWEST_GAPS:
        return replace(found, low=float("nan"), high=float("nan"))
    return found


def interval(values: Sequence[FloatArray]) -> Interval:
    """The mean of the known values, NaN where there are none."""
    found = compared(values, values, lambda ours, _theirs: ours)
    return Interval(float("nan"), float("nan"), float("nan"), 0.95) if found is None else found


def situation_tables(runs: Sequence[Run], title: str, reference: str) -> list[FigureTable]:
    """A table for each time after the start of made gaps, a row for each situation and contender."""
    figures = situation_figures(runs, reference)
    columns: tuple[str, ...] = (
        "objects",
        "contender",
        "gaps",
        "lost",
        "error, m",
        f"against {reference}, %",
        "median, m",
        "NLL, nats",
    )
    columns += (f"against {reference}", "in 50 %", "in 90 %")
    found = []
    for length in dict.fromkeys(f.length for f in figures):
        rows: list[tuple[str, ...]] = [
            (
                f.situation,
                f.contender,
                str(f.gaps),
                str(f.lost),
                cell(f.error.estimate, 2),
                change_cell(f.error_change),
                cell(f.median, 2),
                cell(f.nll.estimate, 2),
                change_cell(f.nll_change, 1, 2),
                *(cell(100 * share, 0) for share in f.coverage.values()),
            )
            for f in figures
            if f.length == length
        ]
        found.append(FigureTable(f"{title}: made gaps, after {length:g} s, by situation", columns, tuple(rows)))
    return found


def change_cell(change: Interval | None, scale: float = 100, digits: int = 1) -> str:
    """With the interval, or "(-)" where there is none; in hundredths if not scaled otherwise."""
    if change is None:
        return "-"
    estimate, low, high = (f"{scale * value:+.{digits}f}" for value in (change.estimate, change.low, change.high))
    return f"{estimate} ({low} to {high})" if isfinite(change.low) else f"{estimate} (-)"
