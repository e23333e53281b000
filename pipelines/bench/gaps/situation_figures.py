"""Figures of made gaps by situation: errors, densities and ellipses of tracks that are kept alive."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics import Interval, coverage
from data_tools.metrics.bootstrap import difference, relative_change
from pipelines.bench.gaps.bench import Run
from pipelines.bench.gaps.gap import LENGTHS
from pipelines.bench.gaps.judging import Prediction
from pipelines.bench.gaps.situations import SITUATIONS
from pipelines.bench.gaps.summary import by_cluster, compared, interval
from saga_fg.numerics.arrays import FloatArray

PROBABILITIES = (0.5, 0.9)


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
