"""The picture of docs/tracking.md: a simulated crowd, with hard and with soft association, from above."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.recording_sets import recording_set
from data_tools.figures import new_figure, png
from data_tools.metrics import SceneBoxes
from data_tools.metrics.scene_boxes import nearest_pairs
from pipelines.config import TrackConfig, load_config
from pipelines.tracking import track_scene
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene

GATE = 0.6  # m between an object and its track
SCENE, MOMENTS = 4, slice(288, 329)  # four seconds in which the three streams meet


def write_crowd_picture(path: Path) -> None:
    """Draw where pedestrians went, where tracks were, and who ended with another track than he began with."""
    crowds = recording_set("crowds", None, SCENE + 1)
    scene = crowds.scene(crowds.dataset.scenes[SCENE])
    shipped = load_config(crowds.family)
    hard = replace(shipped.tracker, association=replace(shipped.tracker.association, clear_above=0.0))
    panels = {"hard association": replace(shipped, tracker=hard), "soft association, as shipped": shipped}
    figure = new_figure(12.0, 5.6)
    for ax, (title, config) in zip(figure.subplots(1, 2, sharex=True, sharey=True), panels.items(), strict=True):
        truth, found, lost = _tracked(scene, config)
        for id_ in np.unique(truth.id):
            ax.plot(*truth.boxes.position[truth.id == id_, :2].T, color="#d0d0d0", linewidth=6, solid_capstyle="round")
        for id_ in np.unique(found.id):
            ax.plot(*found.boxes.position[found.id == id_, :2].T, linewidth=1.6)
        ax.plot(*lost.T, "o", color="black", markersize=13, fillstyle="none")
        ax.set(aspect="equal", xlabel="m", xlim=(-9, 9), ylim=(-9, 9), title=f"{title}: {len(lost)} confused")
    path.write_bytes(png(figure))


def _tracked(scene: Scene, config: TrackConfig) -> tuple[SceneBoxes, SceneBoxes, FloatArray]:
    """True objects, tracks, and the last places (n, 2), m, of objects that then have another track than at first."""
    assert scene.ground_truth is not None
    run = track_scene(scene, config.new_tracker("saga"))
    truth, found = SceneBoxes.of_annotations(scene.ground_truth[MOMENTS]), SceneBoxes.of_tracks(run.tracks[MOMENTS])
    row, column, _ = nearest_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), GATE)
    track = dict(zip(row.tolist(), found.id[column].tolist(), strict=True))
    first, last = (
        {str(truth.id[k]): k for k in np.flatnonzero(truth.frame == at) if k in track} for at in (0, truth.frame[-1])
    )
    lost = [last[id_] for id_ in first.keys() & last.keys() if track[first[id_]] != track[last[id_]]]
    return truth, found, truth.boxes.position[sorted(lost), :2]
