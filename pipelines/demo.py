"""The demo: simulated traffic, several trackers compared, a table and a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from data_tools.figures import FigureTable, cell
from data_tools.files import atomic_directory, write_text
from data_tools.metrics import SceneMetrics, scene_metrics
from data_tools.simulator import SimulatedTraffic, SimulatorSettings, simulate_scene, write_tables
from pipelines.config import Method, TrackConfig, load_config
from pipelines.configuration import write_settings
from pipelines.report import Report, report_page, scene_of_run
from pipelines.tracking import Progress, TrackedScene, track_scene
from saga_fg import Dataset, InputError, Scene
from saga_fg.numerics import IntArray
from saga_fg.types import DEFAULT, RELATIONS

__all__ = ["run_demo"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs of each method over the same scenes, and their metrics pooled over the scenes.

    merge  runs of a merge between cones, by method, which is in no metrics
    """

    runs: dict[Method, tuple[TrackedScene, ...]]
    metrics: dict[Method, SceneMetrics]
    merge: Mapping[str, TrackedScene] = field(default_factory=dict)

    def milliseconds_per_frame(self, method: Method) -> float:
        """Median of the time the tracker took for a frame: the first ones may compile kernels."""
        return float(np.median([time for run in self.runs[method] for time in run.milliseconds] or [0.0]))


def compare(
    dataset: Dataset,
    config: TrackConfig,
    methods: Sequence[Method],
    progress: Progress | None = None,
) -> Comparison:
    """Track every scene with every method. Raises `InputError` for a scene without ground truth."""
    runs: dict[Method, list[TrackedScene]] = {method: [] for method in methods}
    metrics: dict[Method, list[SceneMetrics]] = {method: [] for method in methods}
    for name in dataset.scenes:
        scene = dataset.scene(name)
        if scene.ground_truth is None:
            raise InputError(f"scene {name}: expected ground truth to compare methods with")
        for method in methods:
            run = track_scene(scene, config.new_tracker(method), progress)
            runs[method].append(run)
            metrics[method].append(scene_metrics(scene.ground_truth, run.tracks))
    return Comparison(
        {method: tuple(runs[method]) for method in methods},
        {method: SceneMetrics.pool(metrics[method]) for method in methods},
    )


def comparison_table(comparison: Comparison, title: str) -> FigureTable:
    """Return a table with a row for each method.

    Occluded: objects that were tracked while in view and are hidden now; a lost one counts with the cap.
    """
    columns = ("method", "position RMSE, m", "velocity RMSE, m/s", "occluded position RMSE, m", "MOTA")
    rows = []
    for method, m in comparison.metrics.items():
        numbers = (m.position.rmse, m.velocity.rmse, m.carried.rmse, m.mota)
        texts = (*map(cell, numbers), str(m.switches), f"{comparison.milliseconds_per_frame(method):.1f}")
        rows.append((method, *texts))
    return FigureTable(title, (*columns, "ID switches", "ms per frame"), tuple(rows))


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
MERGE_METHODS: tuple[Method, ...] = ("kf", "saga")
MERGE_SEED = 6  # after that of the others: of a merge in which somebody takes the right of way
MERGE_NOTE = "The last scene is a merge between cones, seen from a mast; saga says who took whose right of way."
TABLE_TITLE = (
    "Errors of tracks matched to true objects within 2 m; occluded: tracked while in view, seen by no sensor now, a "
    "lost one counts with 5 m; times are of the machine that made this page"
)


def run_demo(
    output: Path,
    config: TrackConfig,
    simulator: SimulatorSettings | None = None,
    scenes: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
    merge: SimulatorSettings | None = None,
) -> Comparison:
    """Run the demonstration and write `index.html` into the folder `output`.

    merge  of the last scene, between cones, by the settings for dense traffic; none if left out

    Raises `InputError` where the folder can't be written, before any work is done.
    """
    with atomic_directory(output) as folder:
        comparison = compare(SimulatedTraffic(simulator, scenes, seed), config, METHODS, progress=progress)
        if merge is not None:
            last, dense = simulate_scene(merge, seed + MERGE_SEED, "merge"), load_config("traffic")
            runs = {str(method): track_scene(last, dense.new_tracker(method), progress) for method in MERGE_METHODS}
            comparison = replace(comparison, merge=runs)
        scene, moment = hardest_moment(comparison)
        (folder / "index.html").write_text(report_page(_report(comparison, config, scene, moment)), encoding="utf-8")
    return comparison


def _report(comparison: Comparison, config: TrackConfig, first: int, start: int) -> Report:
    """All scenes, that of row `first` first, at its moment `start`."""
    count = len(comparison.runs[METHODS[0]])
    order = [first, *(k for k in range(count) if k != first)]
    rules, merge = config.tracker.edges, comparison.merge
    scenes = [scene_of_run({m: comparison.runs[m][k] for m in METHODS}, rules, config.sensors) for k in order]
    return Report(
        "saga-fg demo",
        [f"{count} simulated scene" + "s" * (count != 1), *TITLES.values()],
        [*scenes, *([scene_of_run(merge, load_config("traffic").tracker.edges, {})] if merge else [])],
        [comparison_table(comparison, TABLE_TITLE)],
        configuration=write_settings(config, comments=False),
        notes=[NOTE, *([" ".join([MERGE_NOTE, *merge_lines(merge["saga"])])] if merge else [])],
        start=start,
        ghosts=True,  # of these it tells
        beside="kf",
    )


def merge_lines(run: TrackedScene) -> list[str]:
    """Who took whose right of way, a sentence each, by when it was told first."""
    told, start = dict[tuple[int, int], str](), float(run.scene.timestamps[0])
    for tracks in run.tracks:
        for source, target, name, p in tracks.relations.rows():
            if name == RELATIONS[1]:
                text = f"{tracks.timestamp - start:.1f} s: track {source} {name} track {target} (probability {p:.2f})."
                told.setdefault((source, target), text)
    return list(told.values()) or ["Here nobody did."]


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


_TABLES = tuple(f"scene-[0-9]*/{name}" for name in ("detections.csv", "truth.csv", "settings.yaml"))


def write_simulated_tables(directory: str | Path, dataset: SimulatedTraffic) -> None:
    """`SCENE/detections.csv`, `truth.csv` and `settings.yaml` for every scene; all appear when the last one is done.

    Raises `InputError` for a directory that is not writable.
    """
    shipped = load_config("heterogeneous")
    with atomic_directory(directory, known=_TABLES) as folder:
        for name in dataset.scenes:
            scene = dataset.scene(name)
            (folder / name).mkdir()
            write_tables(folder / name, scene)
            road_map = scene.frames[0].road_map if scene.frames else None
            labels = {DEFAULT, *(label for frame in scene.frames for label in frame.detections.boxes.label.tolist())}
            classes = {label: each for label, each in shipped.tracker.classes.items() if label in labels}
            settings = replace(shipped, tracker=replace(shipped.tracker, road_map=road_map, classes=classes))
            write_text(folder / name / "settings.yaml", write_settings(settings))
