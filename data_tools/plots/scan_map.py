"""A LiDAR map from above: points coloured by height, the paths driven, poles and walls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from saga_fg.numerics.arrays import FloatArray

MOST_POINTS = 60_000  # that are drawn, evenly chosen
MARGIN = 30.0  # m around the paths


def scan_map_from_above(
    points: FloatArray,
    paths: Mapping[str, FloatArray],
    poles: FloatArray,
    lines: Mapping[str, FloatArray],
    tracks: Sequence[FloatArray] = (),
) -> Any:
    """A matplotlib `Figure`; everything in world coordinates, m.

    points  (N, 3); paths (K, 3), each under its name; poles (P, 2); lines (W, 2, 2) of walls and edges,
    their two ends, under the name of their kind; tracks (n, 2) of objects
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    ax = figure.subplots()
    chosen = points[:: max(1, len(points) // MOST_POINTS)]
    low, high = np.percentile(chosen[:, 2], [5, 95]) if len(chosen) else (0.0, 1.0)
    x, y, z = chosen.T
    dots = ax.scatter(x, y, c=z, s=0.3, cmap="viridis", vmin=low, vmax=high, linewidths=0)
    figure.colorbar(dots, ax=ax, label="height, m", shrink=0.7)
    for (name, ends), colour in zip(lines.items(), ("#d62728", "#9467bd"), strict=False):
        if len(ends):
            ax.add_collection(LineCollection(list(ends), colors=colour, linewidths=1.5, label=name))
    if len(poles):
        ax.plot(
            *poles.T, "o", color="#ff7f0e", markersize=4, markeredgecolor="black", markeredgewidth=0.4, label="poles"
        )
    if tracks:
        ax.add_collection(LineCollection(list(tracks), colors="#2ca02c", linewidths=1.2, label="objects"))
        ax.plot(*np.array([track[-1] for track in tracks]).T, "s", color="#2ca02c", markersize=3)
    for (name, path), colour in zip(paths.items(), ("black", "#1f77b4", "#e377c2"), strict=False):
        ax.plot(*path[:, :2].T, color=colour, linewidth=1.5, label=name)
    driven = np.concatenate([path[:, :2] for path in paths.values()])
    (left, bottom), (right, top) = driven.min(axis=0) - MARGIN, driven.max(axis=0) + MARGIN
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m", xlim=(left, right), ylim=(bottom, top))
    ax.legend(frameon=True, fontsize=9, loc="upper right")
    return figure
