"""Figures and pictures: tables of texts, charts as numbers, JSON with null for undefined numbers, and plots."""

import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from itertools import cycle
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from data_tools.files import write_text
from saga_fg.numerics import FloatArray


class Column(NamedTuple):
    """A column of figures: its title, the attribute that is shown, by dots, digits, and what it is multiplied by."""

    title: str
    attribute: str
    digits: int = 3
    scale: float = 1


@dataclass(frozen=True)
class FigureTable:
    """A table of texts; the first column names the rows."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @classmethod
    def of(
        cls, title: str, heads: tuple[str, ...], columns: Sequence[Column], rows: Iterable[tuple[tuple[str, ...], Any]]
    ) -> Self:
        """A table of objects with figures, each after as many names as there are `heads`."""
        shown = [(attrgetter(each.attribute), each) for each in columns]
        cells = (
            (*names, *(cell(each.scale * figure(found), each.digits) for figure, each in shown))
            for names, found in rows
        )
        return cls(title, (*heads, *(each.title for each in columns)), tuple(cells))

    def markdown(self) -> str:
        """The table in Markdown, its title in bold above it."""
        lines = [self.columns, ("---", *("---:" for _ in self.columns[1:])), *self.rows]
        return f"**{self.title}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def cell(value: float, digits: int = 3) -> str:
    """A number as text: whole numbers as they are, others to so many digits, "-" if it is not finite."""
    if isinstance(value, int | np.integer):
        return str(int(value))
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def count(value: float) -> str:
    """A count as text, "-" if it is not finite."""
    return cell(value, 0)


CURVE_POINTS = 100
FEWEST = 20  # values that make a curve


@dataclass(frozen=True)
class Series:
    """A curve, or the heights of bars; `faint`: the reference of the others."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    faint: bool = False


@dataclass(frozen=True)
class Chart:
    """Curves over common axes; with `bars`, the one series is drawn as bars from x[k] to x[k + 1]."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    bars: bool = False


def distribution(title: str, unit: str, share_of: str, samples: Sequence[tuple[str, FloatArray]]) -> Chart:
    """Return cumulative distributions up to the 99 % quantile, of the samples with enough values."""
    share = np.linspace(0.0, 0.99, CURVE_POINTS)
    series = [
        Series(name, np.quantile(values, share).tolist(), share.tolist())
        for name, values in samples
        if len(values) >= FEWEST
    ]
    return Chart(title, unit, share_of, series)


def as_json(value: Any) -> Any:
    """Dataclasses, mappings, sequences, arrays and numbers as values of JSON: null for numbers that are not finite."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return value


def write_figures(path: str | Path, figures: Any) -> None:
    """Write figures as JSON, whole or not at all. Raises `InputError` for a path that is not writable."""
    write_text(path, json.dumps(as_json(figures), indent=1, allow_nan=False) + "\n")


COLOURS = ("#0b6bcb", "#d1495b", "#2a9d61", "#8e5bd0", "#e08a1e", "#1aa0b8", "#c2529a", "#7a5c48", "#6b7d1f", "#4453b8")
_CLASSES = ("car", "pedestrian", "cyclist bicycle", "bus", "truck", "van", "motorcycle", "trailer")
CLASS_COLOURS = {name: colour for names, colour in zip(_CLASSES, COLOURS, strict=False) for name in names.split()}


def class_colours(labels: Iterable[str]) -> dict[str, str]:
    """Return the colour of each class: its own, or in order one that no class with a colour of its own has.

    The player, charts, figures and views in space all take these.
    """
    names = dict.fromkeys(labels)
    own = {name: CLASS_COLOURS[name] for name in names if name in CLASS_COLOURS}
    free = [colour for colour in COLOURS if colour not in own.values()] or COLOURS
    return own | dict(zip((name for name in names if name not in own), cycle(free), strict=False))


def new_figure(width: float, height: float, **options: Any) -> Any:
    """Return an empty matplotlib `Figure` of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), **{"layout": "constrained", **options})


def png(figure: Any, dpi: int = 110) -> bytes:
    """Return a figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


MAX_POINTS = 60_000  # of a map that are drawn, evenly chosen
MARGIN = 30.0  # m around the paths


def paths_from_above(paths: Mapping[str, FloatArray], points: Mapping[str, FloatArray] | None = None) -> Any:
    """Return a matplotlib `Figure` of paths (N, 2 or 3) and sets of points (K, 2 or 3), m, each under its name.

    The first path is grey and wide, to be seen under those that lie on it.
    """
    figure = new_figure(8.0, 8.0)
    ax = figure.subplots()
    ax.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    ax.grid(color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)
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
    for row, (name, path) in enumerate(paths.items()):
        ax.plot(*path[:, :2].T, color=f"C{row - 1}" if row else "black", linewidth=1.5 if row else 4.0, label=name)
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
