"""A picture of a crossing without signals: who yields to whom, and a vehicle that is not detected for some seconds.

On the left arrows lead from vehicles that yield to those to which they do, with the probability that `saga` tells, at
the last detection of the hidden one. Then a panel for each contender at the end of the gap, drawn as in `gap_picture`.
Dashed are the 90 % ellipses of the modes that `saga` predicted for then, `AFTER` s after the last detection.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gap_picture import draw_surroundings, draw_tracks, ellipse

from benchmarks.gap_runs import GapBenchSettings, judged_run, judgement, prepared
from benchmarks.recording_sets import recording_set
from benchmarks.variants import contenders
from data_tools.figures import png
from data_tools.files import write_bytes
from pipelines.config import load_config
from pipelines.learning.interactions import JudgedRun, hidden
from saga_fg import PredictedTracks, Tracker
from saga_fg.learning.labelled_scene import Gap, LabelledScene
from saga_fg.numerics import BoolArray, FloatArray
from saga_fg.types import SHOWN_MODE

SCENE, LENGTH = "priority_road-1000", 5.0  # s
REACH = 26.0  # m from the middle of the crossing to the border of a panel
YIELDS, MODE = "#b5179e", "#2a7f3f"
AFTER = 1.0  # s


def write_crossing_picture(path: Path) -> None:
    """Draw the gap of a vehicle that yields, in which `saga` does better than `kf` by most."""
    recordings = recording_set("crossings", None, 6)
    kf, saga = contenders(recordings.family, load_config(recordings.family), "kf,saga", ())
    settings = GapBenchSettings(1, ("kept",), (LENGTH,), real=False, of=("waiting",))
    labelled, gaps = prepared(recordings, SCENE, settings, saga.config.sensors)
    drawn = {one.name: judged_run(labelled, gaps, one, "kept") for one in (kf, saga)}

    def gain(gap: Gap) -> float:
        told = drawn["saga"].holder(gap) in drawn["saga"].tracks[gap.start].relations.source
        return told * (judgement(drawn["kf"], gap).error - judgement(drawn["saga"], gap).error)

    gap = max(gaps, key=gain)
    ahead, time = saga.kept_alive().config.new_tracker(saga.method), labelled.scene.timestamps
    assert isinstance(ahead, Tracker)
    for frame in hidden(labelled, gaps):
        if frame.timestamp <= time[gap.start] + AFTER:
            ahead.step(frame)
    told = ahead.predict([time[gap.stop - 1] - time[gap.start] - AFTER], hypotheses=True)
    write_bytes(path, png(crossing_picture(labelled, gap, drawn, told)))


def crossing_picture(labelled: LabelledScene, gap: Gap, drawn: dict[str, JudgedRun], told: PredictedTracks) -> Any:
    """A matplotlib `Figure`."""
    from matplotlib.figure import Figure

    figure, time = Figure(figsize=(13.0, 5.2), layout="constrained"), labelled.scene.timestamps
    first, *others = figure.subplots(1, 1 + len(drawn), sharex=True, sharey=True)
    first.set_title("saga: who yields to whom, at the last detection", loc="left", fontsize=10)
    draw_surroundings(first, labelled, gap, _as_it_is, gap.start)
    _draw_yields(first, drawn["saga"], gap.start)
    way = labelled.position[gap.start : gap.stop + 1, gap.row]
    for ax, (name, run) in zip(others, drawn.items(), strict=True):
        draw_surroundings(ax, labelled, gap, _as_it_is, gap.stop - 1)
        ax.plot(*way.T, ":", color="#555555", linewidth=2.0, label="labels, no detection")
        shown = list(range(gap.start, gap.stop))
        draw_tracks(ax, time, gap, shown, run, _as_it_is)
        error = judgement(run, gap).error
        ax.set_title(f"{name}: mean error in the gap {error:.2f} m", loc="left", fontsize=10)
    for ax in (first, *others):
        ax.set(aspect="equal", xlim=(-REACH, REACH), ylim=(-REACH, REACH), xlabel="m")
    _draw_modes(others[-1], told, told.id == drawn["saga"].holder(gap))
    handles, labels = others[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _draw_yields(ax: Any, run: JudgedRun, moment: int) -> None:
    """An arrow for each pair in the panel, of which the first yields to the second."""
    tracks, row_of = run.tracks[moment], run.row_of[moment]
    style = {"arrowstyle": "-|>", "color": YIELDS, "linewidth": 1.6, "shrinkB": 6.0}
    text = {"color": YIELDS, "fontsize": 9, "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.5}}
    for source, target, name, probability in tracks.relations.rows():
        begin, end = (tracks.boxes.position[row_of[one], :2] for one in (source, target))
        if name == "yields to" and np.abs([begin, end]).max() < REACH:
            ax.annotate("", end, begin, arrowprops=style, zorder=7)
            ax.text(*(begin + 0.6 * (end - begin)), f"{probability:.2f}", zorder=8, **text)


def _draw_modes(ax: Any, told: PredictedTracks, chosen: BoolArray) -> None:
    """The 90 % ellipse of each mode of one track at the first horizon, and its name and probability."""
    (row,) = chosen.nonzero()[0]
    likely = [mode for mode in told.modes if mode.probability[0, row] >= SHOWN_MODE]
    for number, mode in enumerate(likely):
        share, place = mode.probability[0, row], mode.position[0, row]
        ring = place + ellipse(mode.position_covariance[0, row])
        ax.plot(*_as_it_is(ring), "--", color=MODE, linewidth=1.2, alpha=0.3 + 0.7 * share, zorder=6)
        style = {"color": MODE, "linewidth": 0.6, "arrowstyle": "-"}
        where = (-24.0, 20.0 - 5.0 * number)
        ax.annotate(f"{mode.name} {share:.2f}", place, where, color=MODE, fontsize=9, arrowprops=style, zorder=8)


def _as_it_is(points: FloatArray) -> FloatArray:
    """Points (n, 2) as (2, n)."""
    return np.asarray(points[..., :2].T)


if __name__ == "__main__":
    write_crossing_picture(Path(__file__).with_name("crossing.png"))
