"""A picture of one gap, a panel for each contender: the hidden object, its neighbours, and the tracks that hold it.

The object travels from left to right. Its labels are a grey line, dotted where it has no detection; the boxes of its
neighbours are grey, and crosses are detections, at the last moment of the gap. Each track that holds the object has a
colour of its own, from the moment at which it does, with its 90 % ellipse at every second of the gap: one colour before
and after the gap is one identity. Where there is a road map, its lanes are thin lines, and its stop lines have the
colours that their lights show at the last moment of the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap_runs import GapBenchSettings, LivedRun, bench_gaps, judged_run, judgement
from benchmarks.recording_sets import chosen_sets
from benchmarks.recordings.sources import ABOVE
from benchmarks.situations import colours_at
from benchmarks.variants import contenders
from data_tools.figures import COLOURS, png
from data_tools.files import write_bytes
from pipelines.config import load_config
from pipelines.learning.interactions import CAP, JudgedRun
from saga_fg.learning.labelled_scene import Gap, LabelledScene
from saga_fg.numerics import FloatArray

BEFORE, AFTER = 1.5, 1.0  # s
MARGIN, HEIGHT = 12.0, 12.0  # m: before and after the object's way, and the least height of a panel
RING = 0.9  # probability of the ellipses
LIGHTS = {"red": "#d62728", "amber": "#ff9f0e", "green": "#2ca02c"}

Turned = Callable[[FloatArray], FloatArray]  # points (n, 2) of the world as (2, n) along and across the object's way


def write_gap_picture(path: Path, data: Path) -> None:
    """Draw the gap of a window of NGSIM in which `saga` does better than `kf` by most."""
    (recordings,) = chosen_sets("ngsim", data, 1, "USA_US101-12_1_T-1", usual=ABOVE)
    settings = GapBenchSettings(2, ("kept",), (3.0, 5.0), real=False)
    pair = contenders(recordings.family, load_config(recordings.family), "kf,saga", ())
    runs = bench_gaps(recordings, recordings.dataset.scenes, pair, settings)
    first, second = ([run for run in runs if run.contender == one.name] for one in pair)
    recording, gap = telling_gap(second, first)
    labelled = LabelledScene.from_scene(recordings.scene(recording), pair[0].config.sensors)
    together = [one for run in first if run.recording == recording for one in run.gaps if one.run == gap.run]
    drawn = {one.name: judged_run(labelled, together, one, "kept") for one in pair}
    write_bytes(path, png(gap_picture(labelled, gap, drawn)))


def telling_gap(first: Sequence[LivedRun], second: Sequence[LivedRun]) -> tuple[str, Gap]:
    """The recording and the gap in which the first contender does better than the second by most.

    Where identity is kept by the first alone; among those, or else among all, of largest difference of errors.
    """
    every = [
        ((int(mine.kept) - int(other.kept), float(np.nan_to_num(min(other.error, CAP) - mine.error))), ours, gap)
        for ours, theirs in zip(first, second, strict=True)
        for gap, mine, other in zip(ours.gaps, ours.outcomes, theirs.outcomes, strict=True)
    ]
    _, run, gap = max(every, key=lambda one: one[0])
    return run.recording, gap


def gap_picture(labelled: LabelledScene, gap: Gap, drawn: dict[str, JudgedRun]) -> Any:
    """A matplotlib `Figure`."""
    from matplotlib.figure import Figure

    time = labelled.scene.timestamps
    shown = np.flatnonzero((time >= time[gap.start] - BEFORE) & (time <= time[gap.stop] + AFTER))
    labels = labelled.position[shown, gap.row]
    known = labels[np.isfinite(labels[:, 0])]
    offset, origin = known[-1] - known[0], known[0]
    angle = np.arctan2(*offset[::-1]) if np.hypot(*offset) > 1.0 else np.nan_to_num(labelled.yaw[gap.start, gap.row])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def turned(points: FloatArray) -> FloatArray:
        return np.asarray(((points - origin) @ turn).T)

    along, across = turned(known)
    left, right = along.min() - MARGIN, along.max() + MARGIN
    height = max(float(np.ptp(across)) + MARGIN, HEIGHT)
    size = (11.0, (11.0 * height / (right - left) + 0.6) * len(drawn) + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(drawn), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for ax, (name, run) in zip(axes, drawn.items(), strict=True):
        draw_surroundings(ax, labelled, gap, turned, gap.stop - 1)
        seen = (shown <= gap.start) | (shown >= gap.stop)
        ax.plot(*turned(labels), ":", color="#555555", linewidth=2.0, zorder=2, label="labels, no detection")
        ax.plot(
            *turned(np.where(seen[:, None], labels, np.nan)), color="#555555", linewidth=3.0, label="labels, detected"
        )
        draw_tracks(ax, time, gap, shown.tolist(), run, turned)
        outcome = judgement(run, gap)
        fate = "identity kept" if outcome.kept else "identity lost"
        ax.set_title(f"{name}: {fate}, mean error in the gap {outcome.error:.2f} m", loc="left", fontsize=10)
        ax.set(aspect="equal", ylabel="m", xlim=(left, right))
        ax.set_ylim(across.mean() - height / 2, across.mean() + height / 2)
    axes[-1].set_xlabel(f"m; {labelled.label[gap.row]} without detections for {time[gap.stop] - time[gap.start]:.1f} s")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return figure


def draw_surroundings(ax: Any, labelled: LabelledScene, gap: Gap, turned: Turned, k: int) -> None:
    """Lanes, and stop lines in the colours of their lights; boxes and detections; at the moment `k`."""
    truth = labelled.scene.ground_truth
    time = float(labelled.scene.timestamps[k])
    road, colours = colours_at(labelled, time)
    for lane in road.lanes if road is not None else ():
        ax.plot(*turned(np.array(lane.centre)), color="#bcd0e0", linewidth=0.8, zorder=0)
    for line in road.stop_lines if road is not None else ():
        ax.plot(*turned(line.ends), color=LIGHTS.get(colours.get(line.light, ""), "#808080"), linewidth=3.0, zorder=2)
    for name, corners in zip(truth[k].id.tolist(), truth[k].boxes.corners(), strict=True) if truth else ():
        if np.isfinite(corners).all():
            ax.fill(*turned(corners), color="#f3dcc4" if name == labelled.id[gap.row] else "#d8d8d8", zorder=1)
    nearest = int(np.argmin([abs(frame.timestamp - time) for frame in labelled.scene.frames]))
    there = labelled.boxes[nearest].position[:, :2]
    ax.plot(*turned(there), "x", color="black", markersize=4, zorder=3, label="detections")


def draw_tracks(ax: Any, time: FloatArray, gap: Gap, shown: list[int], run: JudgedRun, turned: Turned) -> None:
    """The way of each track that holds the object before or after the gap, and its ellipses in the gap."""
    name_of = str(run.labelled.id[gap.row])
    holders = [found.get(name_of) for found in run.track_of]
    for number, name in enumerate(dict.fromkeys(holders[k] for k in shown if holders[k] is not None)):
        colour, seconds, places = COLOURS[number % len(COLOURS)], 1.0, list[FloatArray]()
        for k in shown:
            row = np.flatnonzero(run.tracks[k].id == name)
            if len(row) == 0 or k < holders.index(name):
                continue
            if k == gap.stop and places:  # where the object returns, the track jumps to it
                places.append(np.full(2, np.nan))
            places.append(run.tracks[k].boxes.position[row[0], :2])
            if gap.start < k < gap.stop and time[k] - time[gap.start] >= seconds - 1e-6:
                seconds += 1.0
                ring = places[-1] + ellipse(run.tracks[k].position_covariance[row[0]])
                ax.plot(*turned(ring), color=colour, linewidth=1.0, alpha=0.8, zorder=5)
        if places:
            label = f"track {name}, 90 % ellipses"
            ax.plot(*turned(np.array(places)), "-o", color=colour, markersize=3, linewidth=1.2, zorder=6, label=label)


def ellipse(covariance: FloatArray) -> FloatArray:
    """The ellipse (64, 2) of the probability `RING` of a position covariance (2, 2), about the origin."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2 * np.pi, 64)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(circle * np.sqrt(-2 * np.log(1 - RING) * np.maximum(values, 0.0)) @ vectors.T)
