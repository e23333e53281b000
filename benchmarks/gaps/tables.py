"""The benchmark of gaps as tables, and as figures for programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.gaps.summary import GapFigure, LinkFigure, gap_figures, link_figures
from data_tools.figures import FigureTable, cell
from pipelines.learning.gap_runs import Life, Run
from pipelines.learning.situation_figures import change_cell, situation_figures, situation_tables

LIVES: dict[Life, str] = {"kept": "tracks kept alive", "shipped": "tracks end as configured"}


def tables(
    name: str, runs: Sequence[Run], reference: str, by_class: bool = False, situations: bool = False
) -> list[FigureTable]:
    """For people: real gaps, made gaps and links, for each life of the tracks; with rows for classes if wanted.

    With `situations`, a table of these for each time after the start of made gaps.
    """
    figures, links = gap_figures(runs, reference), link_figures(runs)
    figures = [figure for figure in figures if by_class or figure.label is None]
    found = []
    for life in dict.fromkeys(run.life for run in runs):
        title = f"{name}, {LIVES[life]}"
        mine = [figure for figure in figures if figure.life == life]
        found += [
            _gaps([f for f in mine if f.kind == "real"], f"{title}: real gaps of 1 to 6 s", reference),
            _gaps([f for f in mine if f.kind == "made"], f"{title}: made gaps", reference),
            *(situation_tables(runs, title, reference) if life == "kept" and situations else ()),
            _links([each for each in links if each.life == life], f"{title}: links through gaps"),
        ]
    return [table for table in found if table.rows]


def figures(runs: Sequence[Run], reference: str, situations: bool = False) -> dict[str, Any]:
    """For programs: what the tables show, and each gap."""
    return {
        "recordings": list(dict.fromkeys(run.recording for run in runs)),
        "reference": reference,
        "gaps": gap_figures(runs, reference),
        "links": link_figures(runs),
        "situations": situation_figures(runs, reference) if situations else [],
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
                "reported": outcome.reported,
                "error": outcome.error,
                "at": outcome.at,
                "predicted": outcome.predicted,
                "situations": {length: sorted(names) for length, names in at.items()},
            }
            for run in runs
            for gap, label, at, outcome in zip(run.gaps, run.label, run.situations, run.outcomes, strict=True)
        ],
    }


def _gaps(figures: Sequence[GapFigure], title: str, reference: str) -> FigureTable:
    """A row for each group, length and contender; errors only of tracks that are kept alive."""
    against = f"against {reference}"
    columns: tuple[str, ...] = ("objects", "contender", "gaps", "identity kept, %", f"{against}, percentage points")
    columns += ("reported at the end, %",)
    if figures and figures[0].life == "kept":
        counted = "gaps with labels" if figures[0].kind == "real" else "gaps this long or longer"
        columns += (counted, "error, m", f"{against}, %", "median, m")
    rows = []
    for f in figures:
        length = "" if f.length is None else f", {f.length:g} s"
        row: tuple[str, ...] = (
            f.group + length,
            f.contender,
            str(f.gaps),
            cell(100 * f.kept.estimate, 1),
            change_cell(f.kept_change),
            cell(100 * f.reported, 1),
            str(f.measured),
            cell(f.error.estimate),
            change_cell(f.error_change),
            cell(f.median),
        )
        if f.measured:
            rows.append(row[: len(columns)])
    return FigureTable(title, columns, tuple(rows))


def _links(links: Sequence[LinkFigure], title: str) -> FigureTable:
    columns = ("contender", "links", "right", "false", "of unknown objects", "false, % of right and false")
    rows = [
        (
            x.contender,
            str(x.right + x.false + x.unknown),
            str(x.right),
            str(x.false),
            str(x.unknown),
            cell(100 * x.false_share, 1),
        )
        for x in links
    ]
    return FigureTable(title, columns, tuple(rows))
