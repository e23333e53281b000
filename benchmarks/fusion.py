"""`python -m benchmarks fusion`: a LiDAR alone, a camera alone, and both, on simulated traffic.

The LiDAR has few points on far and small objects, a range of 70 m, and outages; the camera looks ahead, sees twice as
far, and its ranges drift (scenario `two-sensors`). The same tracker takes the frames of one sensor, or of both.

AMOTA is the nuScenes metric over all objects that some sensor can see, up to 100 m. A share of tracked objects is that
of the objects with a track of their class within 2 m, among those

    in outages      of the LiDAR, in its range
    beyond range    of the LiDAR
    small           few enough points of the LiDAR on them to halve its probability of detection, or less, in its range
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import typer

from benchmarks.tracking import sampled_differences
from data_tools.figures import FigureTable, cell
from data_tools.metrics import (
    Interval,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    SceneBoxes,
    nuscenes_tracking_metrics,
)
from data_tools.metrics.matching import match_scene
from data_tools.simulator import SimulatorSettings, simulate_scene
from data_tools.simulator.scenarios import scenario_settings
from data_tools.simulator.sensors import points_on, sensor_position
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.config import TrackConfig, load_config
from pipelines.tracking import Progress, track_scene
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks

LIDAR, CAMERA = "sparse_lidar", "far_camera"
CONTENDERS: Mapping[str, tuple[str, ...]] = {"LiDAR": (LIDAR,), "camera": (CAMERA,), "both": (LIDAR, CAMERA)}
GROUPS = ("in outages", "beyond range", "small")
CLASSES = ("car", "truck", "bus", "pedestrian")
GATE = 2.0  # m
SILENT = 0.3  # s without a frame of the LiDAR: an outage


@dataclass(frozen=True, eq=False)
class FusedScene:
    """The result of a tracker on one scene.

    scored  for AMOTA
    tracked (groups and all, 2): objects with a track, and objects
    square_sums  of position errors, m^2, and their number
    false   boxes without an object
    """

    scored: NuScenesTrackingScene
    tracked: FloatArray
    square_sums: FloatArray
    false: int


def judge(scene: Scene, tracks: Sequence[Tracks], settings: SimulatorSettings) -> FusedScene:
    """Compare the tracks of a scene with its truth."""
    truth = scene.ground_truth
    assert truth is not None
    groups = [_groups(scene, k, settings) for k in range(len(scene))]
    tracked, square_sums, matched = np.zeros((len(GROUPS) + 1, 2)), np.zeros(2), 0
    for moment, members, pairs in zip(truth, groups, match_scene(truth, tracks, GATE), strict=True):
        found = np.zeros(len(moment), dtype=np.bool_)
        found[pairs.object_row] = True
        members = members & moment.visible
        tracked += np.stack([(members & found).sum(axis=1), members.sum(axis=1)], axis=1)
        errors = pairs.distance[moment.visible[pairs.object_row]]
        square_sums += np.array([errors @ errors, len(errors)])
        matched += len(pairs.object_row)
    scored = NuScenesTrackingScene(
        scene.timestamps - scene.timestamps[0],
        scene.world_T_ego[:, :2, 3],
        SceneBoxes.of_annotations(truth, hidden=False),
        SceneBoxes.of_tracks(tracks),
    )
    return FusedScene(scored, tracked, square_sums, sum(map(len, tracks)) - matched)


def _groups(scene: Scene, row: int, settings: SimulatorSettings) -> BoolArray:
    """(groups and all, N) which objects belong to each of GROUPS at a moment, and to all."""
    assert scene.ground_truth is not None
    boxes, pose, sensor = scene.ground_truth[row].boxes, scene.world_T_ego[row], settings.sensors[LIDAR]
    origin = sensor_position(sensor, pose)
    near = np.linalg.norm((boxes.position - origin)[:, :2], axis=1) <= sensor.max_range
    assert sensor.resolution is not None
    few = points_on(sensor.resolution, origin, boxes, np.ones(len(boxes))) < sensor.enough_points
    now = scene.timestamps[row]
    times = np.array([frame.timestamp for frame in scene.frames if frame.sensor == LIDAR])
    silent = not ((times <= now) & (times > now - SILENT)).any()
    return np.stack([near & silent, ~near, near & few & (not silent), np.ones(len(boxes), dtype=np.bool_)])


def fusion_figures(scenes: Sequence[FusedScene], reach: float) -> dict[str, float]:
    """Figures of several scenes together; AMOTA up to a distance, m."""
    metrics = nuscenes_tracking_metrics(
        [scene.scored for scene in scenes], NuScenesTrackingSettings(class_range=dict.fromkeys(CLASSES, reach))
    )
    figures = {"AMOTA": metrics.overall.amota}
    tracked = np.sum([scene.tracked for scene in scenes], axis=0)
    for name, (found, all_of_them) in zip((*GROUPS, "all"), tracked.tolist(), strict=True):
        figures[name] = found / all_of_them if all_of_them else float("nan")
    squares, number = np.sum([scene.square_sums for scene in scenes], axis=0)
    frames = sum(len(scene.scored.timestamps) for scene in scenes)
    figures["position RMSE"] = float(np.sqrt(squares / max(number, 1)))
    figures["false boxes"] = sum(scene.false for scene in scenes) / max(frames, 1)
    return figures


def bench_fusion(
    config: TrackConfig,
    settings: SimulatorSettings,
    seeds: Sequence[int],
    draws: int = 100,
    progress: Progress | None = None,
) -> tuple[dict[str, dict[str, float]], dict[str, Interval]]:
    """Figures by contender, and what both sensors change against the LiDAR alone."""
    judged: dict[str, list[FusedScene]] = {name: [] for name in CONTENDERS}
    for done, seed in enumerate(seeds):
        scene = simulate_scene(settings, seed)
        for name, sensors in CONTENDERS.items():
            heard = replace(scene, frames=tuple(frame for frame in scene.frames if frame.sensor in sensors))
            judged[name].append(judge(scene, track_scene(heard, config.new_tracker("saga")).tracks, settings))
        if progress is not None:
            progress("tracking", done + 1, len(seeds))

    def of_rows(name: str, rows: Sequence[int]) -> dict[str, float]:
        return fusion_figures([judged[name][row] for row in rows], settings.annotation_range)

    units = [[row] for row in range(len(seeds))]
    changes = sampled_differences(lambda rows: of_rows("both", rows), lambda rows: of_rows("LiDAR", rows), units, draws)
    return {name: of_rows(name, range(len(seeds))) for name in CONTENDERS}, changes


def _change(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval.estimate:+.3f} ({interval.low:+.3f} to {interval.high:+.3f})"


def fusion(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes.")] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    duration: Annotated[float, typer.Option("--duration", min=2.0, help="Length of a scene, s.")] = 20.0,
    draws: Annotated[int, typer.Option("--draws", min=0, help="Drawn sets of scenes for the intervals.")] = 100,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track by a LiDAR, by a camera, and by both, where each sees what the other does not.

    \b
    Examples:
      python -m benchmarks fusion
      python -m benchmarks fusion --scenes 20 --seed 10 --json figures.json
    """
    settings = replace(scenario_settings("two-sensors"), duration=duration)
    seeds = range(seed, seed + scenes)
    with progress_bar() as progress:
        figures, changes = bench_fusion(load_config("simulated", config), settings, seeds, draws, progress)
    columns = tuple(figures["both"])
    rows = [(name, *(cell(values[column]) for column in columns)) for name, values in figures.items()]
    rows.append(("both less LiDAR, 95 % interval", *(_change(changes.get(column)) for column in columns)))
    title = f"{scenes} simulated scenes; shares of objects tracked, position RMSE in m, false boxes a frame"
    report(
        [FigureTable(title, ("sensors", *columns), tuple(rows))],
        {"seeds": list(seeds), "figures": figures, "both less LiDAR": changes},
        json_file,
    )
