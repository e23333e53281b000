"""Figures of runs through gaps: means with intervals over recordings, and by the situation of the hidden object."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.bootstrap import Comparison, Interval, difference, paired_bootstrap, ratio_of_sums, relative_change
from benchmarks.gap_runs import LivedRun, Prediction
from benchmarks.situations import SITUATIONS
from data_tools.metrics import coverage
from saga_fg.learning.labelled_scene import LENGTHS
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
