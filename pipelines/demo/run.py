"""Simulate, track with every method, compare; write a picture and a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import atomic_directory
from data_tools.plots import Panel, birds_eye_view, png
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import Method, TrackConfig
from pipelines.configuration import write_settings
from pipelines.demo.comparison import Comparison, compare, comparison_table
from pipelines.report import Report, report_page, scene_of_run
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import IntArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Detections

METHODS: tuple[Method, ...] = ("centerpoint", "kf", "saga")
TITLES: dict[Method, str] = {
    "centerpoint": "centerpoint: greedy nearest centre",
    "kf": "kf: every object on its own",
    "saga": "saga: objects coupled by the scene graph",
}

NOTE = (
    "Traffic seen by a LiDAR and a front camera on one of the cars, tracked by three methods. Watch cars that are "
    "hidden: where kf and centerpoint let them drive on, saga lets them brake with the queue they are in."
)
TABLE_TITLE = (
    "Errors of tracks matched to true objects within 2 m; occluded: tracked while in view, seen by no sensor now, a "
    "lost one counts with 5 m; times are of the machine that made this page"
)


@dataclass(frozen=True, eq=False)
class DemoResult:
    """The comparison, and the paths of the files."""

    comparison: Comparison
    picture: Path
    page: Path


def run_demo(
    output: Path,
    config: TrackConfig,
    simulator: SimulatorSettings | None = None,
    scenes: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
) -> DemoResult:
    """Run the demonstration and write `birds_eye.png` and `index.html` into the folder `output`.

    Raises `InputError` where the folder can't be written, before any work is done.
    """
    with atomic_directory(output) as folder:
        comparison = compare(SimulatedTraffic(simulator, scenes, seed), config, METHODS, progress=progress)
        scene, moment = hardest_moment(comparison)
        picture = png(_picture(comparison, scene, moment))
        (folder / "birds_eye.png").write_bytes(picture)
        (folder / "index.html").write_text(report_page(_report(comparison, config, scene, moment)), encoding="utf-8")
    return DemoResult(comparison, output / "birds_eye.png", output / "index.html")


def _report(comparison: Comparison, config: TrackConfig, first: int, start: int) -> Report:
    """All scenes, that of row `first` first, at its moment `start`."""
    count = len(comparison.runs[METHODS[0]])
    order = [first, *(k for k in range(count) if k != first)]
    rules = config.tracker.edges
    return Report(
        "saga-fg demo",
        [f"{count} simulated scene" + "s" * (count != 1), *TITLES.values()],
        [scene_of_run({m: comparison.runs[m][k] for m in METHODS}, rules, config.sensors) for k in order],
        [comparison_table(comparison, TABLE_TITLE)],
        configuration=write_settings(config, comments=False),
        notes=[NOTE],
        start=start,
        ghosts=True,  # of these it tells
        beside="kf",
    )


def hardest_moment(comparison: Comparison) -> tuple[int, int]:
    """The scene and the moment in it (rows) with the most moving objects near the vehicle that no sensor sees."""
    hidden = [_hidden_nearby(run.scene) for run in comparison.runs[METHODS[0]]]
    scene = max(range(len(hidden)), key=lambda k: int(hidden[k].max(initial=0)))
    return scene, int(np.argmax(hidden[scene]))


def _hidden_nearby(scene: Scene, radius: float = 40.0, speed: float = 0.5) -> IntArray:
    """Hidden objects within `radius` m of the vehicle and faster than `speed` m/s at each moment (K,)."""
    assert scene.ground_truth is not None
    counts = []
    for truth, pose in zip(scene.ground_truth, scene.world_T_ego, strict=True):
        near = np.linalg.norm(truth.boxes.position[:, :2] - pose[:2, 3], axis=1) < radius
        moving = np.linalg.norm(truth.boxes.velocity, axis=1) > speed
        counts.append(int(np.sum(~truth.visible & near & moving)))
    return np.array(counts, dtype=np.int64)


def _picture(comparison: Comparison, scene_row: int, moment: int) -> Any:
    shown: tuple[Method, ...] = ("kf", "saga")
    runs = {method: comparison.runs[method][scene_row] for method in shown}
    scene = runs["saga"].scene
    assert scene.ground_truth is not None
    panels = [Panel(TITLES[m], run.tracks[: moment + 1]) for m, run in runs.items()]
    return birds_eye_view(
        panels, scene.world_T_ego[moment], scene.ground_truth[moment], latest_detections(scene, moment)
    )


def latest_detections(scene: Scene, moment: int) -> Detections:
    """The detections of each sensor's last frame up to a moment of the scene."""
    latest = {frame.sensor: frame for frame in scene.frames if frame.timestamp <= scene.timestamps[moment]}
    tables = [frame.detections for frame in latest.values()]
    score = np.concatenate([np.empty(0), *(table.score for table in tables)])
    return Detections(Boxes.concatenate([table.boxes for table in tables]), score)
