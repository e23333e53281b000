"""Pictures of paths, maps, graphs and charts; matplotlib is imported when one is drawn."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from data_tools.figures import Chart
from saga_fg.numerics.arrays import BoolArray, FloatArray

__all__ = [
    "chart_picture",
    "new_figure",
    "occupancy_picture",
    "paths_from_above",
    "png",
    "running_graph_picture",
    "scan_map_from_above",
]

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#e377c2", "#8c564b", "#637939", "#3949ab")


def new_figure(width: float, height: float, **options: Any) -> Any:
    """Return an empty matplotlib `Figure` of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), **{"layout": "constrained", **options})


def _above(figure: Any) -> Any:
    """Return axes for a picture from above, with a grid."""
    ax = figure.subplots()
    ax.set(xlabel="x, m", ylabel="y, m")
    ax.grid(color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)
    return ax


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


MAX_POINTS = 60_000  # of a map that are drawn, evenly chosen
MARGIN = 30.0  # m around the paths


def paths_from_above(paths: Mapping[str, FloatArray], points: Mapping[str, FloatArray] | None = None) -> Any:
    """Return a matplotlib `Figure` of paths (N, 2 or 3) and sets of points (K, 2 or 3), m, each under its name.

    The first path is grey and wide, to be seen under those that lie on it.
    """
    figure = new_figure(8.0, 8.0)
    ax = _above(figure)
    ax.set_aspect("equal")
    for row, ((name, path), colour) in enumerate(zip(paths.items(), ("#c0c0c0", *COLOURS), strict=False)):
        ax.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.0 if row else 5.0, label=name)
    others = COLOURS[max(len(paths) - 1, 1) :]
    for (name, set_), colour, marker in zip((points or {}).items(), others, "^x+os", strict=False):
        ax.plot(set_[:, 0], set_[:, 1], marker, color=colour, markersize=5, label=name)
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
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    driven = np.concatenate([path[:, :2] for path in paths.values()])
    (left, bottom), (right, top) = driven.min(axis=0) - MARGIN, driven.max(axis=0) + MARGIN
    wide = float(np.clip(7.5 * (right - left) / (top - bottom), 4.0, 14.0))
    tall = min(7.5, wide * (top - bottom) / (right - left))
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1)
    figure = new_figure(wide + 1.7, max(tall, 3.0) + 0.7, layout=layout)
    ax = figure.subplots()
    chosen = points[:: max(1, len(points) // MAX_POINTS)]
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
    width, height = probability.shape
    size = 12.0 / max(width, height)
    figure = new_figure(max(3.0, size * width), max(3.0, size * height), dpi=200)
    ax = figure.subplots()
    extent = (origin[0], origin[0] + width * cell, origin[1], origin[1] + height * cell)
    ax.imshow(1 - probability.T, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    ax.plot(path[:, 0], path[:, 1], color=COLOURS[0], linewidth=0.6)
    ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    return figure


def chart_picture(charts: Sequence[Chart]) -> Any:
    """Return a matplotlib `Figure` with a panel for each chart of curves."""
    figure = new_figure(4.5 * len(charts), 4.5)
    for ax, chart in zip(figure.subplots(1, len(charts), squeeze=False)[0], charts, strict=True):
        for series in chart.series:
            style = {"color": "black", "linewidth": 0.8} if series.faint else {"linewidth": 1.4}
            ax.plot(series.x, series.y, label=series.name, **style)
        ax.set(title=chart.title, xlabel=chart.x_label, ylabel=chart.y_label)
        ax.grid(alpha=0.3)
        ax.legend(frameon=False)
    return figure


FACTOR_COLOURS = {
    "interaction": "#4d4d4d",
    "detection": "#009e73",
    "initiation": "#cc79a7",
    "marginal prior": "#8c8c8c",
}
MORE = ("#d55e00", "#0072b2", "#e69f00", "#56b4e9", "#7b3294", "#a6761d", "#1b7837", "#b2182b")
MARKERS = {"object": "o", "ego pose": "^", "known ego pose": "^", "landmark": "D", "map node": "s"}
FACES = {"ego pose": "black", "known ego pose": "#9a9a9a", "landmark": "#e69f00", "map node": "#56b4e9"}
LABEL, APART, STUB = 7.0, 20.0, 11.0  # points: size of names; earlier from newest states, unary factors from nodes
LARGE = 15.0  # m, ellipses longer than this are not filled
WAYS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1))


def running_graph_picture(
    record: Mapping[str, Any], title: str = "", centre: Sequence[float] | None = None, radius: float = 30.0
) -> Any:
    """Return a matplotlib `Figure` of a graph as `saga_fg.tracking.journal` lists it.

    Variables of the newest time are filled and named; earlier ones are hollow, and set back where they would be hidden.
    `centre` (x, y) and `radius`, m, choose a part. Raises `KeyError`, `IndexError`, `TypeError` or `ValueError` for
    another kind of record.
    """
    nodes, factors = record["nodes"], record["factors"]
    places = np.array([node["position"] for node in nodes], dtype=float).reshape(-1, 2)
    if centre is None:
        ends = places if len(places) else np.zeros((1, 2))
        low, high = ends.min(axis=0) - 6.0, ends.max(axis=0) + 6.0
    else:
        low, high = np.asarray(centre) - radius, np.asarray(centre) + radius
    wide = float(np.clip((high - low)[1] / (high - low)[0], 0.35, 1.0))
    figure = new_figure(11.0, 10.0 * wide + 1.2)
    ax = _above(figure)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set_title(title, loc="left", fontsize=11)
    newest = max((node["time"] for node in nodes if node["time"] is not None), default=None)
    is_newest = np.array([node["time"] in (newest, None) for node in nodes], dtype=bool)
    colours = {factor["kind"]: "" for factor in factors}
    colours |= {edge[0]: "" for factor in factors for edge in factor.get("edges", ())}
    more = iter(MORE * (1 + len(colours)))
    colours = {kind: FACTOR_COLOURS.get(kind) or next(more) for kind in colours}
    figure.legend(
        handles=_legend(nodes, colours, newest), loc="outside lower center", ncols=5, frameon=False, fontsize=8.5
    )
    figure.draw_without_rendering()  # fixes the scale
    point = figure.dpi / 72.0 / (ax.transData.transform((1, 0)) - ax.transData.transform((0, 0)))[0]  # m
    behind = np.array([_behind(node) for node in nodes]).reshape(-1, 2)
    places = _set_back(nodes, places, behind, is_newest, APART * point)
    covered = _draw_factors(ax, factors, places, behind, colours, STUB * point)
    inside = ((places >= low) & (places <= high)).all(axis=1)
    for n in np.flatnonzero(inside).tolist():
        _draw_node(ax, nodes[n], places[n], bool(is_newest[n]))
    shown = np.flatnonzero(inside & is_newest)
    names = [nodes[n]["name"].split(" at ")[0] for n in shown.tolist()]
    _draw_names(ax, names, places[shown], np.concatenate([places, covered]), point)
    return figure


def _behind(node: Mapping[str, Any]) -> FloatArray:
    """Return the unit vector (2,) to the rear of a node's box, to the left without one."""
    corners = np.array(node.get("outline", ()), dtype=float)
    along = corners[1] - corners[0] if node["kind"] == "object" and len(corners) else np.array([-1.0, 0.0])
    return np.asarray(along / np.linalg.norm(along))


def _set_back(
    nodes: Sequence[Mapping[str, Any]], places: FloatArray, behind: FloatArray, newest: BoolArray, least: float
) -> FloatArray:
    """Return the places (n, 2), earlier states at least `least` m from the newest one of their name."""
    now = {node["name"].split(" at ")[0]: n for n, node in enumerate(nodes) if newest[n]}
    places = places.copy()
    for n, node in enumerate(nodes):
        k = now.get(node["name"].split(" at ")[0])
        if k is not None and not newest[n] and np.hypot(*(places[n] - places[k])) < least:
            places[n] = places[k] + least * behind[k]
    return places


def _draw_factors(
    ax: Any,
    factors: Sequence[Mapping[str, Any]],
    places: FloatArray,
    behind: FloatArray,
    colours: Mapping[str, str],
    stub: float,
) -> FloatArray:
    """Draw all factors, unary ones beside their node; return places (m, 2) of their squares and along their lines."""
    covered = [np.empty((0, 2))]
    beside: dict[int, int] = {}
    for factor in factors:
        kind, rows = factor["kind"], factor["nodes"]
        mine = places[rows]
        at = mine[:2].mean(axis=0) if kind == "interaction" else mine.mean(axis=0)
        apart = float(np.hypot(*(mine[-1] - mine[0])))
        if len(rows) == 2 and apart > 4 * stub:  # a measurement from afar is drawn beside the measured node
            at = mine[1] + 1.5 * stub / apart * (mine[0] - mine[1])
        if len(rows) == 1:
            turn = (-np.pi / 2, np.pi / 2, -np.pi / 4, np.pi / 4, np.pi)[beside.get(rows[0], 0) % 5]
            beside[rows[0]] = beside.get(rows[0], 0) + 1
            c, s = np.cos(turn), np.sin(turn)
            at = at + stub * np.array([[c, -s], [s, c]]) @ behind[rows[0]]
        for n, place in enumerate(mine):
            colour, width = colours[kind], 0.9
            if n >= 2 and "edges" in factor:
                name, rate = factor["edges"][n - 2]
                colour, width = colours[name], 1.0 + 1.2 * min(float(rate), 1.5)
                covered.append(np.linspace(at, place, 1 + int(np.hypot(*(place - at)) / stub)))
            faint = 0.45 if kind == "marginal prior" or (np.hypot(*(place - at)) > 3 * stub and n < 2) else 0.85
            ax.plot(*np.stack([at, place]).T, color=colour, linewidth=width, alpha=faint, zorder=3)
        ax.plot(*at, "s", color=colours[kind], markersize=4.0, markeredgewidth=0.0, zorder=5)
        covered.append(at[None])
    return np.concatenate(covered)


def _draw_node(ax: Any, node: Mapping[str, Any], place: FloatArray, newest: bool) -> None:
    outline = np.array(node.get("outline", ()), dtype=float)
    if len(outline):
        box = node["kind"] == "object"
        points = np.concatenate([outline, outline[:1]]) if box else outline
        ax.plot(*points.T, color="#9a9a9a" if box else "#56b4e9", linewidth=0.8, zorder=2)
    if "covariance" in node:
        ring = (place + ellipse(np.array(node["covariance"], dtype=float))).T
        ax.plot(*ring, color="#1f77b4", alpha=0.45, linewidth=0.6, zorder=2)
        if np.ptp(ring, axis=1).max() < LARGE:
            ax.fill(*ring, facecolor="#1f77b4", alpha=0.15, linewidth=0, zorder=2)
    ax.plot(*place, markersize=6.5 if newest else 4.5, zorder=6, **_style(node["kind"], newest))


def _style(kind: str, newest: bool) -> dict[str, Any]:
    face = FACES.get(kind, "#1f77b4")
    edge = {"markeredgecolor": "#333333", "markeredgewidth": 0.8}
    return {"marker": MARKERS.get(kind, "o"), "markerfacecolor": face if newest else "white", **edge}


def _draw_names(ax: Any, names: Sequence[str], places: FloatArray, obstacles: FloatArray, point: float) -> None:
    """Draw each name where it covers the least of nodes, factors and other names. Sizes in points."""
    places, boxes = places / point, np.concatenate([obstacles / point - 3.5, obstacles / point + 3.5], axis=1)
    for name, place in zip(names, places, strict=True):
        size = np.array([0.58 * LABEL * len(name), 1.15 * LABEL])
        offsets = [np.array(way) * (size / 2 + 5.0 + more) for more in (0.0, 8.0, 18.0) for way in WAYS]
        around = [np.concatenate([place + offset - size / 2, place + offset + size / 2]) for offset in offsets]
        cost = [_overlap(one, boxes) + 0.5 * n for n, one in enumerate(around)]
        best = int(np.argmin(cost))
        boxes = np.concatenate([boxes, around[best][None]])
        line = {"arrowstyle": "-", "color": "#999999", "linewidth": 0.5} if best >= len(WAYS) else None
        ax.annotate(
            name, place * point, xytext=offsets[best], textcoords="offset points", ha="center", va="center",
            fontsize=LABEL, color="#222222", zorder=8, arrowprops=line, annotation_clip=True,
        )  # fmt: skip


def _overlap(box: FloatArray, others: FloatArray) -> float:
    """Return the area, square points, that a box (left, low, right, high) has in common with others (n, 4), summed."""
    common = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    return float(np.prod(np.maximum(common, 0.0), axis=1).sum())


def _legend(nodes: Sequence[Mapping[str, Any]], colours: Mapping[str, str], newest: float | None) -> list[Any]:
    from matplotlib.lines import Line2D

    handles = []
    for kind in dict.fromkeys(node["kind"] for node in nodes):
        timed = any(node["kind"] == kind and node["time"] is not None for node in nodes)
        label = f"{kind} at {newest:.2f} s" if timed else kind
        handles.append(Line2D([], [], linestyle="none", label=label, **_style(kind, True)))
    if any(node["time"] not in (newest, None) for node in nodes):
        handles.append(Line2D([], [], linestyle="none", label="earlier", markersize=4.5, **_style("object", False)))
    acting = {edge for edge in colours if edge not in FACTOR_COLOURS}
    for kind, colour in colours.items():
        words = re.sub("(?<=[a-z])(?=[A-Z])", " ", kind).lower() if kind in acting else f"{kind} factor"
        handles.append(Line2D([], [], color=colour, label=words, linewidth=1.2, marker="s", markersize=4.0))
    return handles
