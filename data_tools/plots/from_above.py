"""Pictures from above: paths, and what stands beside them, in world coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from data_tools.plots.birds_eye import COLOURS
from saga_fg.numerics.arrays import FloatArray


def paths_from_above(paths: Mapping[str, FloatArray], points: Mapping[str, FloatArray] | None = None) -> Any:
    """A matplotlib `Figure` of paths (N, 2 or 3) and sets of points (K, 2 or 3), m, each under its name.

    The first path is grey, as what the others are to be compared with.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    ax = figure.subplots()
    colours = ("#b0b0b0", *COLOURS)
    for (name, path), colour in zip(paths.items(), colours, strict=False):
        ax.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.0, label=name)
    for (name, set_), colour, marker in zip((points or {}).items(), COLOURS[1:], "^x+os", strict=False):
        ax.plot(set_[:, 0], set_[:, 1], marker, color=colour, markersize=5, label=name)
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    ax.grid(color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.legend(frameon=False, fontsize=9)
    return figure
