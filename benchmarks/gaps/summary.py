"""Figures of the benchmark of gaps, with intervals of a paired bootstrap over recordings.

Recordings that overlap in time count as one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from data_tools.metrics import Interval
from data_tools.metrics.bootstrap import difference, relative_change
from pipelines.learning.gap_judging import GapOutcome
from pipelines.learning.gap_runs import Life, Run
from pipelines.learning.situation_figures import by_cluster, compared, interval
from saga_fg.learning.gaps import LENGTHS, Gap
from saga_fg.numerics.arrays import FloatArray

FEWEST = 10  # gaps of a class that has rows of its own
Kind = Literal["real", "made"]
KINDS: tuple[Kind, ...] = ("real", "made")
Selection = Callable[[Gap, str], bool]
Value = Callable[[GapOutcome], float | None]


@dataclass(frozen=True)
class GapFigure:
    """One contender on gaps of one kind and group. Changes are against the reference, None for itself.

    Intervals of fewer than `FEWEST_RECORDINGS` recordings or `FEWEST_GAPS` gaps are NaN.

    moving, label of the objects; label: None for all classes
    length        of made gaps, s; None for real ones
    gaps          that decide about identity; of made gaps, those of this length
    kept          share whose identity is kept; kept_change: difference of shares
    reported      share whose track is among the results at the last moment of the gap
    measured      gaps that have an error; made ones of this length or longer
    error         mean, m: over real gaps, or at the end of the length; error_change: relative
    median        of the same errors, m
    """

    kind: Kind
    life: Life
    moving: bool
    label: str | None
    length: float | None
    contender: str
    gaps: int
    kept: Interval
    kept_change: Interval | None
    reported: float
    measured: int
    error: Interval
    error_change: Interval | None
    median: float

    @property
    def group(self) -> str:
        """The objects, as a title."""
        motion = "moving" if self.moving else "stationary"
        return motion if self.label is None else f"{self.label}, {motion}"


@dataclass(frozen=True)
class LinkFigure:
    """Tracks of one contender that are detected again after a gap; false_share: of those that hold known objects."""

    life: Life
    contender: str
    right: int
    false: int
    unknown: int
    false_share: float


def link_figures(runs: Sequence[Run]) -> list[LinkFigure]:
    """All contenders and lives."""
    figures = []
    for life, contender in _kinds_of_runs(runs):
        links = [run.links for run in runs if (run.life, run.contender) == (life, contender) and run.links is not None]
        if not links:
            continue
        right, false, unknown = (sum(getattr(of, name) for of in links) for name in ("right", "false", "unknown"))
        known = right + false
        share = false / known if known else float("nan")
        figures.append(LinkFigure(life, contender, right, false, unknown, share))
    return figures


def gap_figures(runs: Sequence[Run], reference: str) -> list[GapFigure]:
    """All lives, kinds, groups, lengths and contenders on the recordings of one set."""
    figures = []
    lives = list(dict.fromkeys(run.life for run in runs))
    for life in lives:
        contenders = list(dict.fromkeys(run.contender for run in runs if run.life == life))
        mine = {name: [run for run in runs if (run.life, run.contender) == (life, name)] for name in contenders}
        for group in _groups(next(iter(mine.values()))):
            base = mine.get(reference, next(iter(mine.values())))
            for name in contenders:
                figures.append(_figure(mine[name], base, life, group))
    return figures


def _kinds_of_runs(runs: Sequence[Run]) -> list[tuple[Life, str]]:
    return list(dict.fromkeys((run.life, run.contender) for run in runs))


@dataclass(frozen=True)
class _Group:
    """Gaps of one kind of objects that move or don't, of one class or all, and, if made, of one length."""

    kind: Kind
    moving: bool
    label: str | None
    length: float | None

    def has(self, gap: Gap, label: str) -> bool:
        """Return True if a gap belongs to the group, whatever its length."""
        return (gap.run == 0) == (self.kind == "real") and gap.moving == self.moving and self.label in (None, label)

    def error(self, outcome: GapOutcome) -> float:
        """Over the gap, or at the end of the length; NaN where it does not reach that."""
        return outcome.error if self.length is None else outcome.at.get(self.length, float("nan"))


def _groups(runs: Sequence[Run]) -> Iterator[_Group]:
    """Groups of gaps that have rows: moving and stationary objects, and their classes."""
    every = [(gap, label) for run in runs for gap, label in zip(run.gaps, run.label, strict=True)]
    for moving, kind in product((True, False), KINDS):
        of_motion = [label for gap, label in every if gap.moving == moving and (gap.run == 0) == (kind == "real")]
        names, counts = np.unique(np.array(of_motion, dtype=np.str_), return_counts=True)
        labels = [str(name) for name, n in zip(names, counts, strict=True) if FEWEST <= n < len(of_motion)]
        for label in (None, *labels) if of_motion else ():
            for length in (None,) if kind == "real" else LENGTHS:
                yield _Group(kind, moving, label, length)


def _figure(runs: Sequence[Run], base: Sequence[Run], life: Life, group: _Group) -> GapFigure:
    def of_length(gap: Gap, label: str) -> bool:
        return group.has(gap, label) and group.length in (None, gap.length)

    kept = _values(runs, of_length, lambda outcome: outcome.kept)
    reported = _values(runs, of_length, lambda outcome: outcome.reported)
    errors = _values(runs, group.has, group.error)
    changes: list[Interval | None] = [None, None]
    if runs[0].contender != base[0].contender:
        changes = [
            compared(kept, _values(base, of_length, lambda outcome: outcome.kept), difference),
            compared(errors, _values(base, group.has, group.error), relative_change),
        ]
    every = np.concatenate([each[np.isfinite(each)] for each in errors])
    return GapFigure(
        group.kind,
        life,
        group.moving,
        group.label,
        group.length,
        runs[0].contender,
        sum(map(len, kept)),
        interval(kept),
        changes[0],
        _mean(np.concatenate(reported)),
        len(every),
        interval(errors),
        changes[1],
        float(np.median(every)) if len(every) else float("nan"),
    )


def _values(runs: Sequence[Run], chosen: Selection, value: Value) -> list[FloatArray]:
    """The value of each chosen gap, NaN where it has none, cluster by cluster."""

    def of_run(run: Run) -> FloatArray:
        every = zip(run.gaps, run.label, run.outcomes, strict=True)
        return np.array([value(outcome) for gap, label, outcome in every if chosen(gap, label)], dtype=np.float64)

    return by_cluster(runs, of_run)


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else float("nan")
