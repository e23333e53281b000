"""Pictures from above: tracks, paths, and LiDAR maps."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections
from saga_fg.types.track import Tracks

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#e377c2", "#8c564b", "#637939", "#3949ab")


def png(figure: Any, dpi: int = 110) -> bytes:
    """Return a figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def ellipse(covariance: FloatArray, probability: float = 0.95) -> FloatArray:
    """Return the ellipse (64, 2) of a probability of a position covariance (2, 2), about the origin."""
    values, vectors = np.linalg.eigh(covariance)
    squared = -2 * np.log(1 - probability)  # chi-squared with two degrees of freedom
    angle = np.linspace(0.0, 2 * np.pi, 64)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * np.sqrt(squared * np.maximum(values, 0.0))
    return np.asarray(circle @ vectors.T)


UNMEASURED = (1.0, 1.0, 1.0)
"""Size of an object of unknown size, m."""


def plot(tracks: Tracks | Sequence[Tracks] | Any, detections: Detections | None = None, ids: bool = True) -> Any:
    """Return a matplotlib `Figure` of tracks from above: a colour for each, a path, and a box at its end.

    tracks      of one moment, of several, or the `pandas.DataFrame` of `saga_fg.track`
    detections  crosses, in world coordinates
    ids         whether the boxes have their numbers

    Raises `InputError` for anything else.
    """
    from matplotlib.figure import Figure

    names, boxes = _rows(tracks)
    figure = Figure(figsize=(10.0, 6.0), layout="constrained")
    ax = figure.subplots()
    ax.set(xlabel="x, m", ylabel="y, m")
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)
    if detections is not None:
        ax.plot(*detections.boxes.position[:, :2].T, "x", color="#27313b", markersize=4, markeredgewidth=0.8)
    for k, name in enumerate(dict.fromkeys(names.tolist())):
        rows = np.flatnonzero(names == name)
        colour, last = COLOURS[k % len(COLOURS)], boxes.select(rows[-1:])
        ax.plot(*boxes.position[rows, :2].T, color=colour, linewidth=1.2, alpha=0.7)
        ax.fill(*_footprint(last).T, facecolor=colour + "33", edgecolor=colour, linewidth=1.6)
        if ids:
            x, y, _ = last.position[0].tolist()
            ax.annotate(name, (x, y), xytext=(5, 5), textcoords="offset points", color=colour, fontsize=9)
    return figure


def _rows(tracks: Any) -> tuple[StrArray, Boxes]:
    """Return the ids (N,) and boxes of all rows in order of time."""
    if isinstance(tracks, Tracks):
        tracks = [tracks]
    if hasattr(tracks, "iloc") and {"id", "x", "y"} <= set(tracks.columns):
        table = tracks.sort_values("timestamp") if "timestamp" in tracks.columns else tracks
        return table["id"].to_numpy().astype(np.str_), Detections.from_pandas(table).boxes
    if isinstance(tracks, Sequence) and all(isinstance(each, Tracks) for each in tracks):
        names = np.concatenate([np.empty(0, dtype=np.int64), *(each.id for each in tracks)]).astype(np.str_)
        return names, Boxes.concatenate([each.boxes for each in tracks])
    raise InputError(f"tracks: expected Tracks, a list of them, or a table of tracks, got {type(tracks).__name__}")


def _footprint(box: Boxes) -> FloatArray:
    known = Boxes(
        box.label,
        box.position,
        np.where(np.isnan(box.size), UNMEASURED, box.size),
        np.nan_to_num(box.yaw),
        box.velocity,
    )
    return np.asarray(known.corners()[0])


MOST_POINTS = 60_000  # of a map that are drawn, evenly chosen
MARGIN = 30.0  # m around the paths


def paths_from_above(paths: Mapping[str, FloatArray], points: Mapping[str, FloatArray] | None = None) -> Any:
    """Return a matplotlib `Figure` of paths (N, 2 or 3) and sets of points (K, 2 or 3), m, each under its name.

    The first path is grey and wide, to be seen under those that lie on it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    ax = figure.subplots()
    for row, ((name, path), colour) in enumerate(zip(paths.items(), ("#c0c0c0", *COLOURS), strict=False)):
        ax.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.0 if row else 5.0, label=name)
    others = COLOURS[max(len(paths) - 1, 1) :]
    for (name, set_), colour, marker in zip((points or {}).items(), others, "^x+os", strict=False):
        ax.plot(set_[:, 0], set_[:, 1], marker, color=colour, markersize=5, label=name)
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    ax.grid(color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.legend(frameon=False, fontsize=9)
    return figure


def scan_map_from_above(
    points: FloatArray,
    paths: Mapping[str, FloatArray],
    poles: FloatArray,
    lines: Mapping[str, FloatArray],
    tracks: Sequence[FloatArray] = (),
) -> Any:
    """Return a matplotlib `Figure`; all in world coordinates, m.

    points  (N, 3) of the map, coloured by height
    paths   (K, 3) by name
    poles   (P, 2)
    lines   (W, 2, 2) the two ends of walls and road lines, by kind
    tracks  (n, 2) of objects
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    driven = np.concatenate([path[:, :2] for path in paths.values()])
    (left, bottom), (right, top) = driven.min(axis=0) - MARGIN, driven.max(axis=0) + MARGIN
    wide = float(np.clip(7.5 * (right - left) / (top - bottom), 4.0, 14.0))
    tall = min(7.5, wide * (top - bottom) / (right - left))
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = Figure(figsize=(wide + 1.7, max(tall, 3.0) + 0.7), layout=layout)  # inches
    ax = figure.subplots()
    chosen = points[:: max(1, len(points) // MOST_POINTS)]
    low, high = np.percentile(chosen[:, 2], [5, 95]) if len(chosen) else (0.0, 1.0)
    x, y, z = chosen.T
    dots = ax.scatter(x, y, c=z, s=1.2, cmap="viridis", vmin=low, vmax=high, linewidths=0)
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
    for row, ((name, path), colour) in enumerate(zip(paths.items(), ("black", "#1f77b4", "#e377c2"), strict=False)):
        ax.plot(*path[:, :2].T, color=colour, linewidth=1.5 if row else 4.0, label=name)
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m", xlim=(left, right), ylim=(bottom, top))
    ax.legend(frameon=True, fontsize=9, loc="upper right")
    return figure


def occupancy_picture(probability: FloatArray, origin: FloatArray, cell: float, path: FloatArray) -> Any:
    """Return a matplotlib `Figure` of an occupancy grid (W, H), dark where occupied, and a path (N, 2), m."""
    from matplotlib.figure import Figure

    width, height = probability.shape
    size = 12.0 / max(width, height)
    figure = Figure(figsize=(max(3.0, size * width), max(3.0, size * height)), dpi=200, layout="constrained")
    ax = figure.subplots()
    extent = (origin[0], origin[0] + width * cell, origin[1], origin[1] + height * cell)
    ax.imshow(1 - probability.T, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    ax.plot(path[:, 0], path[:, 1], color=COLOURS[0], linewidth=0.6)
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    return figure
