"""`python -m benchmarks joint`: the vehicle and the objects around it estimated together, with poor odometry.

Decoupled: the odometry's path. Joint: odometry and objects in one graph. Both know the same odometry, degraded by
errors sampled with a seed. The absolute trajectory error (ATE) of a path is measured after the path is aligned with the
true one. Intervals are paired bootstraps over recordings, the seeds of one recording taken together, of the change of
the pooled ATE.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.joint_online import bench_online, online_table
from benchmarks.simulated_poles import poles_at
from data_tools.datasets.kitti import KittiTracking
from data_tools.figures import FigureTable, cell, percent, write_figures
from data_tools.metrics import Interval, paired_bootstrap
from data_tools.simulator import simulate_scene
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.config import TrackConfig, load_config
from pipelines.slam.joint import JointRun, run_joint, street
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.slam.joint import JointSettings, LaneSettings
from saga_fg.types.dataset import Scene


@dataclass(frozen=True)
class JointRow:
    """One recording and seed: ATE (m) and relative error (m per 10 m) of each path, and poses in them.

    landmarks_ate        with poles as well; NaN where there are none
    joint_in_map         RMS distance from the truth without alignment, m
    lanes_in_map         RMS distance with vehicles drawn to the lanes of a map; NaN without a map
    lanes_ate            ATE with lanes
    """

    scene: str
    seed: int
    poses: int
    path_length: float
    decoupled_ate: float
    joint_ate: float
    decoupled_relative: float
    joint_relative: float
    landmarks_ate: float
    joint_in_map: float
    lanes_in_map: float
    lanes_ate: float


@dataclass(frozen=True)
class JointBench:
    """All rows, and relative changes of the pooled ATE: -0.2 says that it is 20 % lower.

    change     of joint against decoupled
    landmarks  of joint with poles against joint without; None without poles
    lanes      of joint with lanes against joint without, of the error in the map; None without lanes
    """

    rows: tuple[JointRow, ...]
    change: Interval
    landmarks: Interval | None
    lanes: Interval | None


def bench_joint(
    scenes: Sequence[Scene],
    config: TrackConfig,
    seeds: Sequence[int],
    settings: JointSettings | None = None,
    sensor: str = "lidar",
    poles: bool = False,
    lanes: bool = False,
    progress: Progress | None = None,
    so_far: Callable[[JointBench], None] | None = None,
) -> JointBench:
    """Run all scenes with the first seed, then with the next; with `poles` once more, with those beside the road, and
    with `lanes` once more, with vehicles drawn to the lanes of the maps that the scenes bring along.

    so_far: called after every run with the results up to it
    """
    settings = settings or JointSettings()
    rows: list[JointRow] = []
    for seed in seeds:
        for scene in scenes:
            run = run_joint(scene, config, settings, sensor, seed)
            errors = run.errors()
            odometry, joint = errors["odometry"], errors["joint"]
            with_poles = float("nan")
            if poles:
                see = partial(poles_at, seed=seed)
                with_poles = run_joint(scene, config, settings, sensor, seed, see).errors()["joint"].ate
            on_lanes = None
            if lanes:
                on_lanes = run_joint(scene, config, replace(settings, lanes=LaneSettings()), sensor, seed)
            rows.append(
                JointRow(
                    scene.name,
                    seed,
                    odometry.poses,
                    odometry.path_length,
                    odometry.ate,
                    joint.ate,
                    odometry.relative_translation,
                    joint.relative_translation,
                    with_poles,
                    _in_map(run),
                    float("nan") if on_lanes is None else _in_map(on_lanes),
                    float("nan") if on_lanes is None else on_lanes.errors()["joint"].ate,
                )
            )
            if progress is not None:
                progress(scene.name, len(rows), len(scenes) * len(seeds))
            if so_far is not None:
                so_far(_judged(rows, poles, lanes))
    return _judged(rows, poles, lanes)


def _in_map(run: JointRun) -> float:
    off = run.paths["joint"].positions - run.truth.positions
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _judged(rows: Sequence[JointRow], poles: bool, lanes: bool) -> JointBench:
    change = _change(rows, lambda row: row.joint_ate, lambda row: row.decoupled_ate)
    landmarks = _change(rows, lambda row: row.landmarks_ate, lambda row: row.joint_ate) if poles else None
    in_lanes = _change(rows, lambda row: row.lanes_in_map, lambda row: row.joint_in_map) if lanes else None
    return JointBench(tuple(rows), change, landmarks, in_lanes)


def _change(rows: Sequence[JointRow], a: Callable[[JointRow], float], b: Callable[[JointRow], float]) -> Interval:
    names = list(dict.fromkeys(row.scene for row in rows))

    def sums(ate: Callable[[JointRow], float]) -> list[list[float]]:
        """Of each recording: squared errors, poses."""
        mine = ([row for row in rows if row.scene == name] for name in names)
        return [[sum(r.poses * ate(r) ** 2 for r in some), float(sum(r.poses for r in some))] for some in mine]

    return paired_bootstrap(sums(a), sums(b))


def joint(
    dataroot: Annotated[
        Path | None, typer.Option("--dataroot", help="KITTI tracking; without it, simulated streets.")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option("--detections", help="Folder of a detector: Car/, Pedestrian/, Cyclist/.")
    ] = None,
    sequences: Annotated[str | None, typer.Option("--sequences", help="KITTI sequences, by commas; all.")] = None,
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes.")] = 10,
    first: Annotated[int, typer.Option("--first", min=0, help="Seed of the first simulated scene.")] = 0,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Samples of the odometry's errors per recording.")] = 1,
    poles: Annotated[bool, typer.Option("--poles", help="Simulated: once more with poles beside the road.")] = False,
    lanes: Annotated[
        bool, typer.Option("--lanes", help="Simulated: once more with vehicles drawn to the lanes of a map.")
    ] = False,
    parked: Annotated[
        bool, typer.Option("--parked/--no-parked", help="Simulated: cars parked on both sides, or none.")
    ] = True,
    online: Annotated[
        bool, typer.Option("--online", help="In a running graph, frame by frame; objects are scored too.")
    ] = False,
    lag: Annotated[float, typer.Option("--lag", min=0.0, help="Of the running graph, s.")] = 3.0,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Joint against decoupled estimation with degraded odometry: the error of the path, online also of the objects.

    The odometry has noise, a scale error and a bias of the yaw rate, all wandering, sampled anew for every seed. The
    figures so far are written to the file of --json after every run.

    \b
    Examples:
      python -m benchmarks joint --scenes 10 --poles
      python -m benchmarks joint --scenes 10 --lanes --no-parked
      python -m benchmarks joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --seeds 10
      python -m benchmarks joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --online
    """
    if (dataroot is None) != (detections is None):
        raise InputError("expected both --dataroot and --detections, or neither")
    if dataroot is not None and (poles or lanes or not parked):
        raise InputError("--poles, --lanes and --no-parked: expected with simulated streets only")
    if online and (poles or lanes):
        raise InputError("--online: expected neither --poles nor --lanes")
    if dataroot is None:
        many = [simulate_scene(street(parked, mapped=lanes), seed) for seed in range(first, first + scenes)]
        settings = load_config("simulated", config)
    else:
        kitti = KittiTracking(dataroot, detections, None if sequences is None else sequences.split(","), online)
        many = [kitti.scene(name) for name in kitti.scenes]
        settings = load_config("kitti", config)

    def so_far(result: object) -> None:
        if json_file is not None:
            write_figures(json_file, result)

    with progress_bar(unit="runs") as progress:
        if online:
            on = bench_online(many, settings, range(seeds), lag, progress=progress, so_far=so_far)
            report([online_table(on)], on, json_file)
        else:
            found = bench_joint(
                many, settings, range(seeds), poles=poles, lanes=lanes, progress=progress, so_far=so_far
            )
            report(_tables(found), found, json_file)


def _tables(result: JointBench) -> list[FigureTable]:
    rows = []
    for name in dict.fromkeys(row.scene for row in result.rows):
        mine = [row for row in result.rows if row.scene == name]
        figures = [
            (r.decoupled_ate, r.joint_ate, r.decoupled_relative, r.joint_relative, r.landmarks_ate, r.lanes_in_map)
            for r in mine
        ]
        rows.append(
            (name, str(len(mine)), cell(mine[0].path_length, 0), *(cell(x) for x in np.median(figures, axis=0)))
        )
    columns = (
        *("recording", "samples", "path, m", "ATE, m: decoupled", "joint"),
        *("m per 10 m: decoupled", "joint", "ATE with poles, m", "in the map with lanes, m"),
    )
    compared = [("ATE, joint against decoupled", result.change, [r.joint_ate < r.decoupled_ate for r in result.rows])]
    if result.landmarks is not None:
        better = [r.landmarks_ate < r.joint_ate for r in result.rows]
        compared.append(("ATE, with poles against without", result.landmarks, better))
    if result.lanes is not None:
        better = [r.lanes_in_map < r.joint_in_map for r in result.rows]
        compared.append(("error in the map, with lanes against without", result.lanes, better))
    changes = tuple((what, percent(by), f"{sum(lower)} of {len(lower)}") for what, by, lower in compared)
    return [
        FigureTable("error of the vehicle's path, medians over samples", columns, tuple(rows)),
        FigureTable("changes of pooled errors", ("error", "change, 95 % interval", "lower in runs"), changes),
    ]
