"""Tracks from above: their paths, and their boxes where they end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from data_tools.plots.birds_eye import COLOURS
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections
from saga_fg.types.track import Tracks

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
