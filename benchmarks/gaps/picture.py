"""A picture of one gap, a panel for each contender: the hidden object, its neighbours, and the tracks that hold it.

The object travels from left to right. Its labels are a grey line, dashed where it has no detection; the boxes of its
neighbours are grey, and crosses are detections, at the last moment of the gap. Each track that holds the object has a
colour of its own, from the moment at which it does, with its 90 % ellipse at every second of the gap: one colour before
and after the gap is one identity. Where there is a road map, its lanes are thin lines, and its stop lines have the
colours that their lights show at the last moment of the gap; the next one ahead is in the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gaps.sources import RecordingSource
from data_tools.files.atomic_files import write_bytes
from data_tools.plots import png
from data_tools.plots.birds_eye import COLOURS, ellipse
from pipelines.learning.gap_judging import CAP, GapOutcome
from pipelines.learning.gap_runs import Contender, Life, Run, judged_run
from saga_fg.errors import InputError
from saga_fg.learning.gaps import Gap
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.learning.route import Route
from saga_fg.learning.situations import colours_at, first_line
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.types.road_map import RoadMap
from saga_fg.types.track import Tracks

BEFORE, AFTER = 1.5, 1.0  # s
LANE = "#bcd0e0"
MARGIN, LEAST = 8.0, 10.0  # m: before and after the object's way, and the least height of a panel
ROAD_MARGIN, ROAD_LEAST = 15.0, 16.0  # m: the same where there is a road map
BEYOND_LINE = 5.0  # m
RING = 0.9  # probability of the ellipses
LIGHTS = {"red": "#d62728", "amber": "#ff9f0e", "green": "#2ca02c"}


@dataclass(frozen=True, eq=False)
class DrawnGap:
    """A contender's run: its tracks (K,), the track that holds the object at each moment (K,), the outcome."""

    name: str
    tracks: Sequence[Tracks]
    holders: Sequence[int | None]
    outcome: GapOutcome


def telling_gap(first: Sequence[Run], second: Sequence[Run], situations: Sequence[str] = ()) -> tuple[str, Gap]:
    """The recording and the gap in which the first contender does better than the second by most.

    Where identity is kept by the first alone; among those, or else among all, of largest difference of errors. With
    situations, among made gaps in which the object is in one of them. Raises `InputError` where there is no gap.
    """
    best: tuple[tuple[int, float], str, Gap] | None = None
    for ours, theirs in zip(first, second, strict=True):
        for gap, at, mine, other in zip(ours.gaps, ours.situations, ours.outcomes, theirs.outcomes, strict=True):
            if situations and all(each.isdisjoint(situations) for each in at.values()):
                continue
            gain = min(other.error, CAP) - mine.error
            worth = (int(mine.kept is True) - int(other.kept is True), gain if np.isfinite(gain) else 0.0)
            if best is None or worth > best[0]:
                best = worth, ours.recording, gap
    if best is None:
        of = f" of objects {' or '.join(situations)}" if situations else ""
        raise InputError(f"--picture: expected recordings with gaps{of}, there are none")
    return best[1], best[2]


def write_telling_picture(
    path: Path,
    source: RecordingSource,
    runs: Sequence[Run],
    contenders: Sequence[Contender],
    situations: Sequence[str] = (),
) -> None:
    """Draw the gap, in one of some situations or any, in which the second of two contenders beats the first by most.

    Raises `InputError` for a path that is not writable, and where there is no gap.
    """
    life = runs[0].life
    first, second = ([run for run in runs if (run.life, run.contender) == (life, c.name)] for c in contenders)
    recording, gap = telling_gap(second, first, situations)
    labelled = LabelledScene.of(source.scene(recording), contenders[0].config.sensors)
    gaps = next(run.gaps for run in first if run.recording == recording)
    drawn = [drawn_gap(labelled, gaps, gap, contender, life) for contender in contenders]
    write_bytes(path, png(gap_picture(labelled, gap, drawn)))


def drawn_gap(labelled: LabelledScene, gaps: Sequence[Gap], gap: Gap, contender: Contender, life: Life) -> DrawnGap:
    """Track the recording again as the gap was judged; gaps: all of the recording."""
    judged = judged_run(labelled, [each for each in gaps if each.run == gap.run], contender, life)
    return DrawnGap(contender.name, judged.tracks, judged.holders(gap), judged.outcome(gap))


def gap_picture(labelled: LabelledScene, gap: Gap, drawn: Sequence[DrawnGap]) -> Any:
    """A matplotlib `Figure`."""
    from matplotlib.figure import Figure

    time = labelled.scene.timestamps
    shown = np.flatnonzero((time >= time[gap.start] - BEFORE) & (time <= time[gap.stop] + AFTER))
    way = labelled.position[shown, gap.row]
    known = np.isfinite(way[:, 0])
    road, colours = colours_at(labelled, float(time[gap.stop - 1]))
    margin, least = (MARGIN, LEAST) if road is None else (ROAD_MARGIN, ROAD_LEAST)
    origin, turn = _frame(way[known], float(labelled.yaw[gap.start, gap.row]))
    way = (way - origin) @ turn
    left, right = way[known][:, 0].min() - margin, way[known][:, 0].max() + margin
    route = Route.of(labelled, gap.row, gap.start)
    if route is not None and (line := first_line(road, route)) is not None:
        right = max(right, float(((line[1].ends - origin) @ turn)[:, 0].max()) + BEYOND_LINE)
    length = right - left
    height = max(float(np.ptp(way[known][:, 1])) + margin, least)
    figure = Figure(figsize=(11.0, (11.0 * height / length + 0.6) * len(drawn) + 0.5), layout="constrained")
    axes = figure.subplots(len(drawn), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for ax, each in zip(axes, drawn, strict=True):
        if road is not None:
            _draw_road(ax, road, colours, origin, turn)
        _draw_scene(ax, labelled, gap, origin, turn)
        unseen = (shown > gap.start) & (shown < gap.stop)
        ax.plot(*np.where(unseen[:, None], np.nan, way).T, color="#555555", linewidth=3.0, zorder=2)
        ax.plot(*np.where(_widened(unseen)[:, None], way, np.nan).T, ":", color="#555555", linewidth=2.0, zorder=2)
        _draw_tracks(ax, time, gap, shown, each, origin, turn)
        fate = "identity kept" if each.outcome.kept else "identity lost"
        error = f"mean error in the gap {each.outcome.error:.2f} m"
        ax.set_title(f"{each.name}: {fate}, {error}", loc="left", fontsize=10)
        ax.set(aspect="equal", ylabel="m")
        ax.set_xlim(left, right)
        ax.set_ylim(way[known][:, 1].mean() - height / 2, way[known][:, 1].mean() + height / 2)
        ax.grid(color="#e6e6e6", linewidth=0.6)
        ax.set_axisbelow(True)
    axes[-1].set_xlabel(f"m; {labelled.label[gap.row]} without detections for {time[gap.stop] - time[gap.start]:.1f} s")
    handles = _legend(road)
    columns = len(handles) if len(handles) <= 5 else 4
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    return figure


def _frame(way: FloatArray, yaw: float) -> tuple[FloatArray, FloatArray]:
    """Origin (2,), and the rotation (2, 2), to be applied from the right, that turns the way to the right."""
    offset = way[-1] - way[0]
    angle = np.arctan2(offset[1], offset[0]) if np.hypot(*offset) > 1.0 else np.nan_to_num(yaw)
    c, s = np.cos(angle), np.sin(angle)
    return way[0], np.array([[c, -s], [s, c]])


def _widened(unseen: BoolArray) -> FloatArray:
    """With the moments beside, so that lines meet."""
    return np.asarray(unseen | np.append(unseen[1:], False) | np.append(False, unseen[:-1]))


def _draw_road(ax: Any, road: RoadMap, colours: Mapping[str, str], origin: FloatArray, turn: FloatArray) -> None:
    """Lanes, and stop lines in the colours of their lights."""
    for lane in road.lanes:
        ax.plot(*((np.array(lane.centre) - origin) @ turn).T, color=LANE, linewidth=0.8, zorder=0)
    for line in road.stop_lines:
        colour = LIGHTS.get(colours.get(line.light, ""), "#808080")
        ax.plot(*((line.ends - origin) @ turn).T, color=colour, linewidth=3.0, solid_capstyle="butt", zorder=2)


def _draw_scene(ax: Any, labelled: LabelledScene, gap: Gap, origin: FloatArray, turn: FloatArray) -> None:
    """Boxes and detections at the last moment of the gap."""
    k = gap.stop - 1
    truth = labelled.scene.ground_truth
    assert truth is not None
    for name, corners in zip(truth[k].id.tolist(), truth[k].boxes.corners(), strict=True):
        if np.isfinite(corners).all():
            mine = name == labelled.id[gap.row]
            style = {"facecolor": "#f3dcc4", "edgecolor": "#b5651d"} if mine else {"facecolor": "#d8d8d8"}
            ax.fill(*((corners - origin) @ turn).T, linewidth=0.8, zorder=1, **style)
    times = np.array([frame.timestamp for frame in labelled.scene.frames])
    there = labelled.boxes[int(np.argmin(np.abs(times - labelled.scene.timestamps[k])))].position[:, :2]
    ax.plot(*((there - origin) @ turn).T, "x", color="black", markersize=4, zorder=3)


def _draw_tracks(
    ax: Any, time: FloatArray, gap: Gap, shown: IntArray, drawn: DrawnGap, origin: FloatArray, turn: FloatArray
) -> None:
    """The way of each track that holds the object before or after the gap, and its ellipses in the gap."""
    holders = list(dict.fromkeys(name for k in shown.tolist() if (name := drawn.holders[k]) is not None))
    for number, name in enumerate(holders):
        colour, first = COLOURS[number % len(COLOURS)], drawn.holders.index(name)
        places, seconds = list[FloatArray](), 1.0
        for k in shown.tolist():
            row = np.flatnonzero(drawn.tracks[k].id == name)
            if len(row) == 0 or k < first:
                continue
            if k == gap.stop and places:  # where the object returns, the track jumps to it
                places.append(np.full(2, np.nan))
            at = (drawn.tracks[k].boxes.position[row[0], :2] - origin) @ turn
            places.append(at)
            if gap.start < k < gap.stop and time[k] - time[gap.start] >= seconds - 1e-6:
                seconds += 1.0
                ring = at + ellipse(drawn.tracks[k].position_covariance[row[0]], RING) @ turn
                ax.plot(*ring.T, color=colour, linewidth=1.0, alpha=0.8, zorder=5)
        if places:
            ax.plot(*np.array(places).T, "-o", color=colour, markersize=3, linewidth=1.2, zorder=6)
            ax.annotate(f"track {name}", places[0], xytext=(0, 9), textcoords="offset points", color=colour, fontsize=8)


def _legend(road: RoadMap | None) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lane = Line2D([], [], color=LANE, linewidth=0.8, label="centre of a lane")
    line = Line2D([], [], color=LIGHTS["red"], linewidth=3.0, label="stop line: colour of its light")
    return [
        Line2D([], [], color="#555555", linewidth=3.0, label="labels, detected"),
        Line2D([], [], color="#555555", linewidth=2.0, linestyle=":", label="labels, no detection"),
        Patch(facecolor="#f3dcc4", edgecolor="#b5651d", label="the object at the end of the gap"),
        Patch(facecolor="#d8d8d8", label="other objects then"),
        Line2D([], [], color="black", linestyle="", marker="x", markersize=4, label="detections then"),
        Line2D([], [], color=COLOURS[0], marker="o", markersize=3, label="track N, a colour each; ring: 90 % ellipse"),
        *((lane,) if road is not None and road.lanes else ()),
        *((line,) if road is not None and road.stop_lines else ()),
    ]
