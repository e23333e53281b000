"""Errors and kept identities over the length of made gaps, a line with its band for each contender."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gaps.summary import GapFigure, gap_figures
from data_tools.files.atomic_files import write_bytes
from data_tools.plots import png
from pipelines.learning.gap_runs import Run

ROWS = {"error": "error at the end, m", "kept": "identities kept, %"}
FEWEST = 3  # gaps of a point


def gap_plot(runs: Mapping[str, Sequence[Run]], reference: str) -> Any:
    """A matplotlib `Figure`: for each set a column for moving and for stationary objects.

    Bands are 95 % intervals over recordings, where there is one. Points of fewer than `FEWEST` gaps are left out.
    Drawn are tracks that are kept alive, if these were run.
    """
    from matplotlib.figure import Figure

    columns = [(name, moving) for name in runs for moving in (True, False)]
    figure = Figure(figsize=(1 + 3.4 * len(columns), 6.4), layout="constrained")
    axes = figure.subplots(2, len(columns), sharex=True, squeeze=False)
    for column, (name, moving) in zip(axes.T, columns, strict=True):
        figures = gap_figures(runs[name], reference)
        life = figures[0].life if figures else "kept"
        made = [f for f in figures if (f.kind, f.moving, f.label, f.life) == ("made", moving, None, life)]
        column[0].set_title(f"{name}, {'moving' if moving else 'stationary'}", fontsize=10)
        for number, contender in enumerate(dict.fromkeys(f.contender for f in made)):
            mine = [f for f in made if f.contender == contender]
            for ax, row in zip(column, ROWS, strict=True):
                _line(ax, mine, row, f"C{number}", contender)
        column[-1].set_xlabel("length of the gap, s")
    for ax, title in zip(axes[:, 0], ROWS.values(), strict=True):
        ax.set_ylabel(title)
    for ax in axes.ravel():
        ax.grid(alpha=0.3)
        ax.set_ylim(bottom=0)
    for ax in axes[1]:
        ax.set_ylim(0, 104)
    handles = {label: line for ax in axes[0] for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    figure.suptitle(f"Made gaps. Points of fewer than {FEWEST} gaps are left out.", fontsize=9)
    return figure


def _line(ax: Any, figures: Sequence[GapFigure], row: str, colour: str, label: str) -> None:
    of = {
        f.length: f.error if row == "error" else f.kept
        for f in figures
        if (f.measured if row == "error" else f.gaps) >= FEWEST
    }
    if not of:
        return
    scale = 1.0 if row == "error" else 100.0
    values = scale * np.array([(each.estimate, each.low, each.high) for each in of.values()])
    ax.plot(list(of), values[:, 0], color=colour, marker="o", markersize=3, linewidth=1.4, label=label)
    ax.fill_between(list(of), values[:, 1], values[:, 2], color=colour, alpha=0.12, linewidth=0)


def write_plot(path: Path, runs: Mapping[str, Sequence[Run]], reference: str) -> None:
    """Write the plot as a PNG file. Raises `InputError` for a path that is not writable."""
    write_bytes(path, png(gap_plot(runs, reference)))
