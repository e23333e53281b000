"""Runs of trackers through gaps of recordings, judged gap by gap and by situation.

A tracker's run judged on the gaps of a recording.

Labels and tracks that were detected at the moment are matched one to one (`data_tools.metrics.matching`). An object is
*held* by the track it was matched to last, at most `SETTLING` s ago.

kept      the track that holds the object `SETTLING` s after the gap is the one that held it before
error     distance of that track, while it is not detected, to the label, m; `CAP` where it is not known or farther away
link      a track that is detected again after `SHORTEST` s or more; it is right if it holds the object it held before,
          false if it holds another, unknown if it holds none before or after
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from math import inf, isfinite
from typing import Literal, Protocol, TypeVar

import numpy as np

from data_tools.figures import FigureTable, cell
from data_tools.metrics import Interval, coverage, paired_bootstrap
from data_tools.metrics.bootstrap import Comparison, difference, ratio_of_sums, relative_change
from data_tools.metrics.error_sample import nees, negative_log_density
from data_tools.metrics.matching import match_scene
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.learning.gaps import (
    LENGTHS,
    LONGEST,
    SHORTEST,
    SITUATIONS,
    Gap,
    made_gaps,
    reached,
    real_gaps,
    situations_of,
)
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame
from saga_fg.types.track import Tracks

SETTLING = 0.6  # s: for so long a returning object may wait for its identity
DETECTED = 0.15  # s: a track counts as detected for so long, as sensors don't measure at the moments of labels
CAP = 10.0  # m
GATE = 2.0  # m, between a label and its track

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
    """The outcome of one gap of an object.

    held, kept   whether a track had it before, and whether that track has it after; kept: None without tracks
    reported     whether that track is among the results at the last moment of the gap; None without tracks
    error        mean over the gap, m
    at           error at the end of each length that the gap reaches, m
    predicted    where the track that had it is, at these moments, if it is among the results
    """

    held: bool
    kept: bool | None
    reported: bool | None
    error: float
    at: Mapping[float, float]
    predicted: Mapping[float, Prediction]


@dataclass(frozen=True)
class Links:
    """Tracks that were detected again after a gap, by whom they hold."""

    right: int = 0
    false: int = 0
    unknown: int = 0


class JudgedRun:
    """A run's tracks (K,) at the moments of a labelled scene.

    extrapolated  whether a track that is not reported is taken to move on as it was last reported
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks], extrapolated: bool = False) -> None:
        self._labelled, self.tracks, self._extrapolated = labelled, tracks, extrapolated
        truth = labelled.scene.ground_truth
        assert truth is not None
        detected = [found.select(found.coasting <= DETECTED) for found in tracks]
        self._track_of: list[dict[str, int]] = []
        self._object_of: list[dict[int, str]] = []
        for moment, found, match in zip(truth, detected, match_scene(truth, detected, GATE), strict=True):
            pairs = (moment.id[match.object_row].tolist(), found.id[match.track_row].tolist())
            self._track_of.append(dict(zip(*pairs, strict=True)))
            self._object_of.append(dict(zip(*pairs[::-1], strict=True)))
        self._detected = [set(found.id.tolist()) for found in detected]
        self._row_of = [{name: row for row, name in enumerate(found.id.tolist())} for found in tracks]

    def outcome(self, gap: Gap) -> GapOutcome:
        """Judge one gap."""
        name, ends = str(self._labelled.id[gap.row]), reached(self._labelled.scene.timestamps, gap)
        before = self._last(self._track_of, name, gap.start, back=True)
        after = self._last(self._track_of, name, gap.stop, back=False)
        if before is None:
            return GapOutcome(False, False, False, CAP, dict.fromkeys(ends, CAP), {})
        moments = range(gap.start + 1, gap.stop)
        errors = np.array([self._error(before, gap.row, k) for k in moments])
        reported = before in self._row_of[gap.stop - 1]
        at = {length: float(errors[k - gap.start - 1]) for length, k in ends.items()}
        known = errors[np.isfinite(errors)]
        mean = float(known.mean()) if len(known) else float("nan")
        predicted = {h: found for h, k in ends.items() if (found := self._prediction(before, gap.row, k)) is not None}
        at = {h: e for h, e in at.items() if np.isfinite(e)}
        return GapOutcome(True, after == before, reported, mean, at, predicted)

    def holders(self, gap: Gap) -> list[int | None]:
        """The detected track of the object of a gap at each moment, None where there is none."""
        name = str(self._labelled.id[gap.row])
        return [found.get(name) for found in self._track_of]

    def links(self) -> Links:
        """Judge all tracks that were detected again."""
        time = self._labelled.scene.timestamps
        latest: dict[int, int] = {}
        right = false = unknown = 0
        for k, detected in enumerate(self._detected):
            for track in detected:
                since = latest.get(track)
                latest[track] = k
                if since is None or not SHORTEST - 1e-6 <= time[k] - time[since] <= LONGEST + 1e-6:
                    continue
                before = self._last(self._object_of, track, since, back=True)
                after = self._last(self._object_of, track, k, back=False)
                if before is None or after is None:
                    unknown += 1
                elif before == after:
                    right += 1
                else:
                    false += 1
        return Links(right, false, unknown)

    def _last(self, of: Sequence[Mapping[A, B]], one: A, moment: int, back: bool) -> B | None:
        """The last partner within `SETTLING` s until a moment (`back`), or from it on."""
        after = (self._labelled.scene.timestamps - self._labelled.scene.timestamps[moment]) * (-1 if back else 1)
        near = np.flatnonzero((after >= 0) & (after <= SETTLING))
        return next((of[k][one] for k in near[::-1].tolist() if one in of[k]), None)

    def _error(self, track: int, row: int, moment: int) -> float:
        """The error of a track at a moment, NaN where the object is not labelled."""
        truth = self._labelled.position[moment, row]
        if not np.isfinite(truth[0]):
            return float("nan")
        there = self._position(track, moment)
        return CAP if there is None else min(float(np.hypot(*(there - truth))), CAP)

    def _prediction(self, track: int, row: int, moment: int) -> Prediction | None:
        truth, at = self._labelled.position[moment, row], self._row_of[moment].get(track)
        if at is None or not np.isfinite(truth[0]):
            return None
        error = self.tracks[moment].boxes.position[at, :2] - truth
        covariance = self.tracks[moment].position_covariance[at]
        squared = nees(error[None], covariance[None])
        nll = negative_log_density(squared, covariance[None])
        return Prediction(float(np.hypot(*error)), float(squared[0]), float(nll[0]))

    def _position(self, track: int, moment: int) -> FloatArray | None:
        for k in range(moment, -1, -1):
            row = self._row_of[k].get(track)
            if row is not None:
                found = self.tracks[k]
                elapsed = float(self.tracks[moment].timestamp - found.timestamp)
                return np.asarray(found.boxes.position[row, :2] + elapsed * found.boxes.velocity[row])
            if not self._extrapolated:
                return None
        return None


Life = Literal["kept", "shipped"]
LIVES: tuple[Life, ...] = ("kept", "shipped")
LIFE = LONGEST + 1.0  # s: for so long tracks that are kept alive live without a detection


def with_life(config: TrackConfig, life: Life) -> TrackConfig:
    """The configuration, with tracks that live, and are reported, for as long as any gap if they are kept alive."""
    if life == "shipped":
        return config
    own = config.tracker
    tracker = replace(
        own,
        report_coasting=inf,
        max_coasting=LIFE,
        max_out_of_view=inf,
        classes={label: replace(each, max_deviation=inf) for label, each in own.classes.items()},
        existence=replace(own.existence, delete_below=0.0, report_above=0.0),
    )
    return replace(config, tracker=tracker, greedy=replace(config.greedy, max_coasting=LIFE))


class SceneSource(Protocol):
    """Recordings by name, with ground truth and detections."""

    @property
    def name(self) -> str: ...

    @property
    def clusters(self) -> Mapping[str, str]:
        """The first of the recordings that overlap in time with each, by name; empty where none can."""
        ...

    def scene(self, recording: str) -> Scene:
        """Read a recording."""
        ...


@dataclass(frozen=True)
class GapBenchSettings:
    """Passes over each recording with made gaps, the lives compared, lengths of made gaps, s, seed of their choice.

    real  whether the gaps of the recordings themselves are judged too, and the links
    of    situations, one of which objects are in at the end of made gaps (`saga_fg.learning.gaps`); none: any
    """

    passes: int = 2
    lives: tuple[Life, ...] = LIVES
    lengths: tuple[float, ...] = LENGTHS
    seed: int = 0
    real: bool = True
    of: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contender:
    """A method with its configuration."""

    name: str
    method: Method
    config: TrackConfig


@dataclass(frozen=True)
class Run:
    """A contender's outcomes in the gaps of one recording, and its links in the run without made gaps.

    links       None of a contender that does not track, and without real gaps
    cluster     the first of the recordings that overlap with this one, or itself
    situations  of the object of each gap, by the length until which; none for real gaps
    """

    recording: str
    cluster: str
    contender: str
    life: Life
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    situations: tuple[Mapping[float, frozenset[str]], ...]
    outcomes: tuple[GapOutcome, ...]
    links: Links | None


def bench_gaps(
    source: SceneSource,
    recordings: Sequence[str],
    contenders: Sequence[Contender],
    settings: GapBenchSettings,
    progress: Progress | None = None,
) -> list[Run]:
    """All runs on some recordings of a set."""
    cluster, runs, jobs = source.clusters, list[Run](), list(product(recordings, contenders))
    for done, (name, contender) in enumerate(jobs):
        labelled, gaps = prepared(source, name, settings, contender.config.sensors)
        for life in settings.lives:
            run = run_of(labelled, gaps, contender, life, settings.real)
            runs.append(replace(run, cluster=cluster.get(name, name)))
        if progress is not None:
            progress(f"{source.name} {name} {contender.name}", done + 1, len(jobs))
    return runs


@dataclass(frozen=True)
class _Preparation:
    """Everything that the gaps of a recording depend on; sensors place detections alike for all contenders."""

    source: SceneSource
    recording: str
    settings: GapBenchSettings
    sensors: Mapping[str, Sensor] = field(compare=False)


def prepared(
    source: SceneSource, recording: str, settings: GapBenchSettings, sensors: Mapping[str, Sensor]
) -> tuple[LabelledScene, list[Gap]]:
    """A recording and its gaps; the latest one is kept, for the next contender."""
    return _prepared(_Preparation(source, recording, settings, sensors))


@lru_cache(maxsize=1)
def _prepared(of: _Preparation) -> tuple[LabelledScene, list[Gap]]:
    labelled, settings = LabelledScene.of(of.source.scene(of.recording), of.sensors), of.settings
    real = real_gaps(labelled) if settings.real else []

    def wanted(gap: Gap) -> bool:
        return not situations_of(labelled, gap).get(gap.length, frozenset()).isdisjoint(settings.of)

    chosen = wanted if settings.of else None
    return labelled, [*real, *made_gaps(labelled, settings.passes, settings.seed, settings.lengths, chosen)]


def run_of(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender, life: Life, real: bool = True) -> Run:
    """Track without the detections of each pass, and before, for `real` gaps and links, with all; judge."""
    outcomes: dict[int, GapOutcome] = {}
    links = Links() if real else None
    for number in sorted({*([0] if real else []), *(gap.run for gap in gaps)}):
        mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
        judged = judged_run(labelled, list(mine.values()), contender, life)
        outcomes |= {k: judged.outcome(gap) for k, gap in mine.items()}
        if number == 0:
            links = judged.links()
    label = tuple(str(labelled.label[gap.row]) for gap in gaps)
    ordered = tuple(outcomes[k] for k in range(len(gaps)))
    situations = tuple(situations_of(labelled, gap) if gap.run > 0 else {} for gap in gaps)
    name = labelled.scene.name
    return Run(name, name, contender.name, life, tuple(gaps), label, situations, ordered, links)


def judged_run(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender, life: Life) -> JudgedRun:
    """Track without the detections of the made ones among the gaps of one run."""
    scene, config = labelled.scene, with_life(contender.config, life)
    made = [gap for gap in gaps if gap.run > 0]
    frames = hidden(labelled, made) if made else scene.frames
    tracks = track_scene(replace(scene, frames=frames), config.new_tracker(contender.method)).tracks
    return JudgedRun(labelled, tracks, extrapolated=contender.method == "centerpoint")


def hidden(labelled: LabelledScene, gaps: Sequence[Gap]) -> list[Frame]:
    """The frames without the detections of some gaps."""
    time = labelled.scene.timestamps
    start = np.array([time[gap.start] for gap in gaps])
    stop = np.array([time[gap.stop] for gap in gaps])
    return labelled.frames_without(np.array([gap.row for gap in gaps]), start, stop)


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
    """All lengths, situations that occur, and contenders, of the runs whose tracks are kept alive."""
    kept = [run for run in runs if run.life == "kept"]
    mine = {name: [run for run in kept if run.contender == name] for name in dict.fromkeys(r.contender for r in kept)}
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
        situation,
        length,
        runs[0].contender,
        len(known),
        len(every) - len(known),
        interval(errors),
        changes[0],
        float(np.median(known)) if len(known) else float("nan"),
        interval(densities),
        changes[1],
        {p: coverage(squares[np.isfinite(squares)], p) for p in PROBABILITIES},
    )


def _values(run: Run, situation: str, length: float, value: Callable[[Prediction], float]) -> FloatArray:
    """Values of the gaps in the situation, NaN where the track is lost."""
    found = [
        outcome.predicted.get(length)
        for outcome, at in zip(run.outcomes, run.situations, strict=True)
        if situation in at.get(length, ())
    ]
    return np.array([float("nan") if each is None else value(each) for each in found], dtype=np.float64)


def by_cluster(runs: Sequence[Run], values: Callable[[Run], FloatArray]) -> list[FloatArray]:
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
