"""Objects that nobody sees for some seconds, through the whole tracker on detections: identity and place.

Every contender tracks every recording, with all detections and with some taken away.
Intervals are paired bootstraps over recordings; those that overlap in time count as one.

Figures of runs through gaps: means with intervals over recordings, and by the situation of the hidden object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import typer

from benchmarks.gap_runs import LIVES, GapBenchSettings, Judgement, LivedRun, Prediction, bench_gaps, by_hindsight
from benchmarks.recording_sets import TRAFFIC_SETS, RecordingOptions, chosen_sets
from benchmarks.recordings.sources import ABOVE
from benchmarks.runner import (
    Comparison,
    Data,
    Interval,
    Row,
    Rows,
    chosen,
    difference,
    paired_bootstrap,
    ratio_of_sums,
    relative_change,
)
from benchmarks.situations import SITUATIONS
from benchmarks.variants import contenders
from data_tools.metrics import coverage
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config
from pipelines.config import load_config
from saga_fg.errors import InputError
from saga_fg.learning.labelled_scene import LENGTHS, Gap
from saga_fg.numerics import FloatArray

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


def situation_figures(runs: Sequence[LivedRun], reference: str) -> list[SituationFigure]:
    """All lengths, situations that occur, and contenders, of runs whose tracks are kept alive."""
    mine = {name: [run for run in runs if run.contender == name] for name in dict.fromkeys(r.contender for r in runs)}
    base = mine.get(reference, next(iter(mine.values()), []))
    figures = []
    for length in LENGTHS:
        for situation in SITUATIONS:
            if any(situation in at.get(length, ()) for run in base for at in run.situations):
                figures += [_figure(situation, length, found, base) for found in mine.values()]
    return figures


def _figure(situation: str, length: float, runs: Sequence[LivedRun], base: Sequence[LivedRun]) -> SituationFigure:
    def values(of: Sequence[LivedRun], value: Callable[[Prediction], float]) -> list[FloatArray]:
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


def _values(run: LivedRun, situation: str, length: float, value: Callable[[Prediction], float]) -> FloatArray:
    """Values of the gaps in the situation, NaN where the track is lost."""
    found = [
        outcome.predicted.get(length)
        for outcome, at in zip(run.outcomes, run.situations, strict=True)
        if situation in at.get(length, ())
    ]
    return np.array([float("nan") if each is None else value(each) for each in found], dtype=np.float64)


def by_cluster(runs: Sequence[LivedRun], values: Callable[[LivedRun], FloatArray]) -> list[FloatArray]:
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


CONTENDERS = "saga,without trails,without lights,kf,constant velocity,turn,stationary,stationary + turn,centerpoint"
FEWEST = 10  # gaps of a class that has rows of its own
TITLES = {"kept": "tracks kept alive", "shipped": "tracks end as configured"}


@dataclass(frozen=True)
class GapOptions:
    """Which gaps are made, and who is judged in them after which fit."""

    compared_by_name: Annotated[
        str, typer.Option("--contenders", help="Names, with commas; those without effect are left out.")
    ] = CONTENDERS
    against: Annotated[str, typer.Option("--against", help="The contender that all others are compared with.")] = "kf"
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--contender",
            help="One more, from a YAML file over the settings; METHOD is saga if left out; repeatable.",
            metavar="NAME[:METHOD]=FILE",
        ),
    ] = None
    passes: Annotated[
        int, typer.Option("--passes", min=0, help="Runs over each recording with made gaps; 0: real gaps alone.")
    ] = 2
    life: Annotated[
        Literal["both", "kept", "shipped"],
        typer.Option("--life", help="Tracks kept alive through all gaps, ended as configured, or both."),
    ] = "both"
    lengths: Annotated[str, typer.Option("--lengths", help="Of made gaps, s, with commas.")] = "1,2,3,5"
    of: Annotated[
        str | None,
        typer.Option(
            "--of", help="Make gaps of objects in one of these situations alone, with commas.", metavar="SITUATIONS"
        ),
    ] = None


@dataclass(frozen=True)
class TrafficOptions(RecordingOptions):
    """Recordings that are tracked, and how much of them."""

    longest: Annotated[
        float | None,
        typer.Option(
            "--longest",
            min=1.0,
            help="Of recordings of ngsim, openacc, dut, av2 and crossings, s, from the middle of longer ones.",
        ),
    ] = None


@dataclass(frozen=True)
class ShownOptions:
    """What is shown of the figures."""

    by_class: Annotated[bool, typer.Option("--by-class", help="Rows for classes of objects as well.")] = False
    situations: Annotated[
        bool,
        typer.Option("--situations", help="Tables by situation as well: leaders, halting, turning, at red, ..."),
    ] = False


def gaps(
    *,
    data: Data = None,
    recorded: TrafficOptions,
    made: GapOptions,
    shown: ShownOptions,
    config: Config = None,
) -> Rows:
    """Objects that are not detected for some seconds: is their identity kept, and where are they?

    Real gaps: a labelled object has no detection for 1 to 6 s, and then again. Made gaps: the detections of one object
    are taken away for 1, 2, 3 or 5 s, while all others stay. Every contender tracks the same detections. A track that
    is not known counts with an error of 10 m. Of saga and trails alone, edges by hindsight have the lower error in each
    gap, the limit of choosing edges. Intervals are paired bootstraps over recordings, of 3 at least; those that overlap
    in time count as one.

    \b
    Examples:
      python -m benchmarks gaps --sets simulated --scenes 4
      python -m benchmarks gaps --data data --sets megvii,kitti --json gaps.json
      python -m benchmarks gaps --data data --sets kitti --contenders saga,kf --contender trial=trial.yaml
      python -m benchmarks gaps --data data --sets ngsim --life kept --lengths 3,5 --situations
      python -m benchmarks gaps --data data --sets ngsim --life kept --of 'at red'
      python -m benchmarks gaps --data data --sets openacc --life kept --longest 20
    """
    found = chosen_sets(
        recorded.sets, data, recorded.scenes, recorded.test, recorded.viewpoint, recorded.longest, usual=ABOVE
    )
    wanted = chosen("--of", made.of, SITUATIONS) if made.of is not None else ()
    settings = GapBenchSettings(
        made.passes, LIVES if made.life == "both" else (made.life,), chosen_lengths(made.lengths), of=wanted
    )
    for recordings in found:
        base, complete = (
            load_config(recordings.family, config),
            recordings.name in TRAFFIC_SETS and recorded.viewpoint in (None, ABOVE),
        )
        tried = contenders(recordings.family, base, made.compared_by_name, made.own or ())
        chosen("--against", made.against, [one.name for one in tried])
        judged = replace(settings, real=not complete)  # from above nothing is hidden, there are no gaps but made ones
        with progress_bar(unit="runs") as progress:
            runs = bench_gaps(recordings, recordings.dataset.scenes, tried, judged, progress)
        if not any(run.gaps for run in runs):
            raise InputError(f"set {recordings.name}: expected recordings with gaps: longer ones, or more --passes")
        runs += by_hindsight(runs)
        yield from rows_of(recordings.name, runs, made.against, shown.by_class, shown.situations)


def chosen_lengths(text: str) -> tuple[float, ...]:
    """Lengths of made gaps, s. Raises `InputError` for others than those there are."""
    return tuple(sorted(map(float, chosen("--lengths", text, [f"{length:g}" for length in LENGTHS]))))


class Group(NamedTuple):
    """Gaps of one kind of objects that move or don't, of one class or all (None), and, if made, of one length."""

    made: bool
    moving: bool
    label: str | None
    length: float | None

    def has(self, gap: Gap, label: str) -> bool:
        """Return True if a gap belongs to the group, whatever its length."""
        return (gap.run > 0) == self.made and gap.moving == self.moving and self.label in (None, label)

    def exactly(self, gap: Gap, label: str) -> bool:
        """Return True if its length is that of the group, too."""
        return self.has(gap, label) and self.length in (None, gap.length)

    def error(self, outcome: Judgement) -> float:
        """Over the gap, or at the end of the length; NaN where it does not reach that."""
        return outcome.error if self.length is None else outcome.at.get(self.length, float("nan"))


def rows_of(name: str, runs: Sequence[LivedRun], against: str, by_class: bool, situations: bool) -> Iterator[Row]:
    """Real gaps, made gaps, situations and links, for each life of the tracks."""
    for life in dict.fromkeys(run.life for run in runs):
        title, mine = f"{name}, {TITLES[life]}", [run for run in runs if run.life == life]
        of = {each: [run for run in mine if run.contender == each] for each in dict.fromkeys(r.contender for r in mine)}
        for group in _groups(of[against], by_class):
            kind = "made gaps" if group.made else "real gaps of 1 to 6 s"
            for contender, found in of.items():
                if row := _row(group, found, of[against]):
                    yield f"{title}: {kind}", {"objects": _objects(group), "contender": contender, **row}
        for f in situation_figures(mine, against) if situations and life == "kept" else ():
            about = {"objects": f.situation, "contender": f.contender, "gaps": f.gaps, "lost": f.lost}
            errors = {"error, m": f.error.estimate, f"against {against}": f.error_change, "median, m": f.median}
            density = {"NLL, nats": f.nll.estimate, f"less that of {against}": f.nll_change}
            shares = {f"in {100 * p:g} %": share for p, share in f.coverage.items()}
            yield f"{title}: after {f.length:g} s, by situation", {**about, **errors, **density, **shares}
        for contender, found in of.items():
            links = [run.links for run in found if run.links is not None]
            if links:
                right, false, unknown = np.sum([(one.right, one.false, one.unknown) for one in links], axis=0).tolist()
                known = {"right": right, "false": false, "of unknown objects": unknown}
                share = false / (right + false) if right + false else float("nan")
                yield f"{title}: links through gaps", {"contender": contender, **known, "false share": share}


def _groups(runs: Sequence[LivedRun], by_class: bool) -> Iterator[Group]:
    """Groups of gaps that have rows: moving and stationary objects, and their classes."""
    every = [(gap, label) for run in runs for gap, label in zip(run.gaps, run.label, strict=True)]
    for moving, made in product((True, False), (False, True)):
        mine = [label for gap, label in every if gap.moving == moving and (gap.run > 0) == made]
        classes, counts = np.unique(np.array(mine, dtype=np.str_), return_counts=True)
        labels = [str(c) for c, n in zip(classes, counts, strict=True) if by_class and FEWEST <= n < len(mine)]
        for label, length in product((None, *labels) if mine else (), LENGTHS if made else (None,)):
            yield Group(made, moving, label, length)


def _objects(group: Group) -> str:
    words = (group.label, "moving" if group.moving else "stationary", group.length and f"{group.length:g} s")
    return ", ".join(word for word in words if word)


def _row(group: Group, runs: Sequence[LivedRun], base: Sequence[LivedRun]) -> Mapping[str, Any]:
    """The figures of a contender on a group; nothing where it has none. Errors over all gaps this long or longer."""

    def values(
        some: Sequence[LivedRun], has: Callable[[Gap, str], bool], value: Callable[[Judgement], Any]
    ) -> list[FloatArray]:
        def of_run(run: LivedRun) -> FloatArray:
            every = zip(run.gaps, run.label, run.outcomes, strict=True)
            return np.array([value(outcome) for gap, label, outcome in every if has(gap, label)], dtype=np.float64)

        return by_cluster(some, of_run)

    kept, reported, errors = (
        values(runs, group.exactly, lambda outcome: outcome.kept),
        np.concatenate(values(runs, group.exactly, lambda outcome: outcome.reported)),
        values(runs, group.has, group.error),
    )
    identities, known = np.concatenate(kept), np.concatenate(errors)
    known = known[np.isfinite(known)]
    if len(known) == 0:
        return {}
    others = values(base, group.exactly, lambda outcome: outcome.kept), values(base, group.has, group.error)
    same = runs[0].contender == base[0].contender
    return {
        "gaps": len(identities),
        "identity kept": float(identities.mean()) if len(identities) else float("nan"),
        "more": None if same else compared(kept, others[0], difference),
        "reported at the end": float(reported.mean()) if len(reported) else float("nan"),
        "with errors": len(known),
        "error, m": float(known.mean()),
        "relative change": None if same else compared(errors, others[1], relative_change),
        "median, m": float(np.median(known)),
    }
