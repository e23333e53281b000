"""The picture `scaling.png`: cost and error of filters over the number of objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.scaling import scaling
from data_tools.figures import png
from data_tools.files.file_access import write_bytes


def write_scaling_picture(path: Path) -> None:
    """Measure, and draw."""
    write_picture(path, [row for _, row in scaling()])


def write_picture(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw a PNG: times on logarithmic axes to the left, errors of hidden objects to the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    cost, accuracy = figure.subplots(1, 2)
    names = list(dict.fromkeys(row["filter"] for row in rows))
    for number, name in enumerate(names):
        mine = [row for row in rows if row["filter"] == name]
        for ax, column in ((cost, "ms a frame"), (accuracy, "RMSE hidden, m")):
            # the first on top, and finer, so that one that agrees with it stays in sight
            style = {"lw": 1.2 + number, "ms": 3 + 2 * number, "zorder": 9 - number}
            ax.plot([row["objects"] for row in mine], [row[column] for row in mine], "o-", label=name, **style)
    cost.set(xscale="log", yscale="log", xlabel="objects", ylabel="CPU time a frame, ms")
    accuracy.set(xscale="log", xlabel="objects", ylabel="position RMSE of hidden objects, m")
    accuracy.set_ylim(bottom=0.0)
    for ax in (cost, accuracy):
        ax.grid(alpha=0.3)
    figure.legend(*cost.get_legend_handles_labels(), loc="outside lower center", ncols=len(names), frameon=False)
    write_bytes(path, png(figure))
