"""Pictures from above: objects around the vehicle, tracks, paths, and LiDAR maps.

Bird's-eye pictures of true objects, detections and tracks around the vehicle at one moment.

The picture is drawn in the vehicle's frame, driving direction to the right. True objects are grey areas, hatched where
no sensor can see them; detections are small crosses; tracks are coloured outlines, paler the lower their score, with
their past and their way in the next second; dashed while they coast, then with the 95 % ellipse of their position.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations
from saga_fg.types.frame import Detections
from saga_fg.types.track import Tracks

PAST = 3.0  # s, of the paths that are drawn
COASTING = 0.15  # s without detection from which a track is drawn as coasting
COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#e377c2", "#8c564b", "#637939", "#3949ab")
Extent = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of several side by side: the tracks of its moment, the last of `history`, and of those before."""

    title: str
    history: Sequence[Tracks]


def birds_eye_view(
    panels: Sequence[Panel],
    world_T_ego: FloatArray,
    truth: Annotations | None = None,
    detections: Detections | None = None,
    extent: Extent = (-40.0, 70.0, -22.0, 22.0),
) -> Any:
    """A matplotlib `Figure` with one panel below the other, all of the same moment.

    world_T_ego  (4, 4) pose of the vehicle; `extent` in its frame: rear, front, right, left, m
    detections   in world coordinates
    """
    from matplotlib.figure import Figure

    rear, front, right, left = extent
    height = 12.0 * (left - right) / (front - rear)
    figure = Figure(figsize=(12.0, (height + 0.45) * len(panels) + 0.5), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True, sharey=True))
    ego_T_world = inverse_transform(world_T_ego)
    for ax, panel in zip(axes, panels, strict=True):
        ax.set(xlim=(rear, front), ylim=(right, left), aspect="equal", ylabel="left, m")
        ax.set_title(panel.title, loc="left", fontsize=11)
        ax.grid(color="#e6e6e6", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.fill([2.2, -1.4, -0.6, -1.4], [0.0, 1.1, 0.0, -1.1], color="black", zorder=8)  # the vehicle
        if truth is not None:
            _draw_truth(ax, truth, ego_T_world)
        if detections is not None:
            x, y = transform_points(ego_T_world, detections.boxes.position)[:, :2].T
            ax.plot(x, y, "x", color="black", markersize=4, markeredgewidth=0.9, zorder=5)
        _draw_tracks(ax, panel, ego_T_world, extent)
    axes[-1].set_xlabel("ahead, m")
    figure.legend(handles=_legend(), loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    return figure


def png(figure: Any, dpi: int = 110) -> bytes:
    """Return a figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _draw_truth(ax: Any, truth: Annotations, ego_T_world: FloatArray) -> None:
    for corners, visible in zip(_outlines(truth.boxes, ego_T_world), truth.visible, strict=True):
        if visible:
            ax.fill(*corners.T, facecolor="#cfcfcf", edgecolor="none", zorder=1)
        else:
            ax.fill(*corners.T, facecolor="#f3dcc4", edgecolor="#b5651d", hatch="////", linewidth=0.5, zorder=1)


def _draw_tracks(ax: Any, panel: Panel, ego_T_world: FloatArray, extent: Extent) -> None:
    tracks = panel.history[-1]
    recent = [before for before in panel.history if tracks.timestamp - before.timestamp <= PAST + 1e-9]
    outlines = _outlines(tracks.boxes, ego_T_world)
    centres = transform_points(ego_T_world, tracks.boxes.position)[:, :2]
    velocity = tracks.boxes.velocity @ ego_T_world[:2, :2].T
    for row, (track, outline, centre) in enumerate(zip(tracks, outlines, centres, strict=True)):
        if not (extent[0] < centre[0] < extent[1] and extent[2] < centre[1] < extent[3]):
            continue
        colour = COLOURS[track.id % len(COLOURS)]
        coasting = track.coasting > COASTING
        style = {"color": colour, "alpha": 0.3 + 0.7 * min(max(track.score, 0.0), 1.0), "zorder": 6}
        closed = np.concatenate([outline, outline[:1]])
        ax.plot(*closed.T, linewidth=1.4, linestyle="--" if coasting else "-", **style)
        past = np.concatenate([before.boxes.position[before.id == track.id, :2] for before in recent])
        ax.plot(
            *(past @ ego_T_world[:2, :2].T + ego_T_world[:2, 3]).T, color=colour, linewidth=1.0, alpha=0.55, zorder=2
        )
        if np.hypot(*velocity[row]) > 0.5:
            ax.arrow(
                *centre, *velocity[row], width=0.12, head_width=0.7, length_includes_head=True, linewidth=0, **style
            )
        if coasting:
            ring = centre + ellipse(track.position_covariance) @ ego_T_world[:2, :2].T
            ax.plot(*ring.T, linewidth=0.8, **style)
        ax.annotate(
            str(track.id), centre, xytext=(0, 7), textcoords="offset points", fontsize=7, ha="center",
            annotation_clip=True, **style,
        )  # fmt: skip


def _outlines(boxes: Boxes, ego_T_world: FloatArray) -> FloatArray:
    """Return footprints (N, 4, 2) in the vehicle's frame; a metre square where size or heading are unknown."""
    local = boxes.transformed(ego_T_world)
    known = np.isfinite(local.size).all(axis=1) & np.isfinite(local.yaw)
    size = np.where(known[:, None], local.size, 1.0)
    return Boxes(local.label, local.position, size, np.where(known, local.yaw, 0.0), local.velocity).corners()


def ellipse(covariance: FloatArray, probability: float = 0.95) -> FloatArray:
    """Return the ellipse (64, 2) of a probability of a position covariance (2, 2), about the origin."""
    values, vectors = np.linalg.eigh(covariance)
    squared = -2 * np.log(1 - probability)  # chi-squared with two degrees of freedom
    angle = np.linspace(0.0, 2 * np.pi, 64)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * np.sqrt(squared * np.maximum(values, 0.0))
    return np.asarray(circle @ vectors.T)


def _legend() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Line2D([], [], color="black", marker=">", linestyle="none", label="own vehicle"),
        Patch(facecolor="#cfcfcf", label="true object, in view"),
        Patch(facecolor="#f3dcc4", edgecolor="#b5651d", hatch="////", label="true object, hidden"),
        Line2D([], [], color="black", marker="x", linestyle="none", markersize=5, label="detection"),
        Line2D([], [], color=COLOURS[0], linewidth=1.4, label="track"),
        Line2D([], [], color=COLOURS[1], linewidth=1.4, linestyle="--", label="coasting, 95 % ellipse"),
    ]


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
