"""The benchmark of gaps as tables, and as figures for programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval
from pipelines.bench.gaps.bench import Run
from pipelines.bench.gaps.contenders import Life
from pipelines.bench.gaps.summary import GapFigure, LinkFigure, gap_figures, link_figures

LIVES: dict[Life, str] = {"kept": "tracks kept alive", "shipped": "tracks end as configured"}


def tables(name: str, runs: Sequence[Run], reference: str, by_class: bool = False) -> list[FigureTable]:
    """For people: real gaps, made gaps and links, for each life of the tracks; with rows for classes if wanted."""
    figures, links = gap_figures(runs, reference), link_figures(runs)
    figures = [figure for figure in figures if by_class or figure.label is None]
    found = []
    for life in dict.fromkeys(run.life for run in runs):
        title = f"{name}, {LIVES[life]}"
        mine = [figure for figure in figures if figure.life == life]
        found += [
            _gaps([f for f in mine if f.kind == "real"], f"{title}: real gaps of 1 to 6 s", reference),
            _gaps([f for f in mine if f.kind == "made"], f"{title}: made gaps", reference),
            _links([each for each in links if each.life == life], f"{title}: links through gaps"),
        ]
    return [table for table in found if table.rows]


def figures(runs: Sequence[Run], reference: str) -> dict[str, Any]:
    """For programs: what the tables show, and each gap."""
    return {
        "recordings": list(dict.fromkeys(run.recording for run in runs)),
        "reference": reference,
        "gaps": gap_figures(runs, reference),
        "links": link_figures(runs),
        "outcomes": [
            {
                "recording": run.recording,
                "contender": run.contender,
                "life": run.life,
                "object": label,
                "start": gap.start,
                "stop": gap.stop,
                "length": gap.length,
                "moving": gap.moving,
                "run": gap.run,
                "held": outcome.held,
                "kept": outcome.kept,
                "lost": outcome.lost,
                "error": outcome.error,
                "at": outcome.at,
            }
            for run in runs
            for gap, label, outcome in zip(run.gaps, run.label, run.outcomes, strict=True)
        ],
    }


def _gaps(figures: Sequence[GapFigure], title: str, reference: str) -> FigureTable:
    """A row for each group, length and contender; errors only of tracks that are kept alive."""
    against = f"against {reference}"
    columns: tuple[str, ...] = ("objects", "contender", "gaps", "identity kept, %", f"{against}, points", "lost, %")
    if figures and figures[0].life == "kept":
        columns += ("places", "error, m", against, "median, m")
    rows = []
    for f in figures:
        length = "" if f.length is None else f", {f.length:g} s"
        row: tuple[str, ...] = (
            f.group + length,
            f.contender,
            str(f.gaps),
            cell(100 * f.kept.estimate, 1),
            _points(f.kept_change),
        )
        row += (cell(100 * f.lost, 1), *_error(f))
        if f.places:
            rows.append(row[: len(columns)])
    return FigureTable(title, columns, tuple(rows))


def _error(f: GapFigure) -> tuple[str, ...]:
    change = "-" if f.error_change is None else percent(f.error_change)
    return str(f.places), cell(f.error.estimate), change, cell(f.median)


def _points(change: Interval | None) -> str:
    if change is None:
        return "-"
    estimate, low, high = (f"{100 * value:+.1f}" for value in (change.estimate, change.low, change.high))
    return f"{estimate} ({low} to {high})"


def _links(links: Sequence[LinkFigure], title: str) -> FigureTable:
    columns = ("contender", "right", "false", "not of labelled objects", "false, %")
    rows = [(x.contender, str(x.right), str(x.false), str(x.unknown), cell(100 * x.false_share, 1)) for x in links]
    return FigureTable(title, columns, tuple(rows))
