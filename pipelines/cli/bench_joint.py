"""`saga-fg bench joint`: the vehicle and the objects around it together, against one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import error_console, progress_bar
from pipelines.cli.tables import JsonFile

if TYPE_CHECKING:
    from data_tools.metrics import Interval
    from pipelines.bench.joint import JointBench
    from pipelines.config import TrackConfig
    from saga_fg.types.dataset import Scene


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
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Draws of the odometry's errors per recording.")] = 1,
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

    The odometry has noise, a scale error and a bias of the yaw rate, all wandering, drawn anew for every seed.

    \b
    Examples:
      saga-fg bench joint --scenes 10 --poles
      saga-fg bench joint --scenes 10 --lanes --no-parked
      saga-fg bench joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --seeds 10
      saga-fg bench joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --online
    """
    from data_tools.datasets.kitti import KittiTracking
    from data_tools.files.atomic_files import check_writable
    from data_tools.simulator import simulate_scene
    from pipelines.bench.joint import bench_joint
    from pipelines.config import load_config
    from pipelines.figures import write_figures
    from pipelines.slam.joint import street
    from saga_fg.errors import InputError

    if (dataroot is None) != (detections is None):
        raise InputError("expected both --dataroot and --detections, or neither")
    if dataroot is not None and (poles or lanes or not parked):
        raise InputError("--poles, --lanes and --no-parked: expected with simulated streets only")
    if online and (poles or lanes):
        raise InputError("--online: expected neither --poles nor --lanes")
    if json_file is not None:
        check_writable(json_file)
    if dataroot is None:
        many = [simulate_scene(street(parked, mapped=lanes), seed) for seed in range(first, first + scenes)]
        settings = load_config("simulated", config)
    else:
        kitti = KittiTracking(dataroot, detections, None if sequences is None else sequences.split(","), online)
        many = [kitti.scene(name) for name in kitti.scenes]
        settings = load_config("kitti", config)
    if online:
        _online(many, settings, seeds, lag, json_file)
        return

    def so_far(result: JointBench) -> None:
        row = result.rows[-1]
        errors = f"ATE {row.decoupled_ate:.3f} m decoupled, {row.joint_ate:.3f} m joint"
        change = _percent("ATE, joint against decoupled", result.change)
        line = f"{len(result.rows)}/{len(many) * seeds} {row.scene}, seed {row.seed}: {errors}; so far {change}"
        error_console().print(line, markup=False, highlight=False, soft_wrap=True)
        if json_file is not None:
            write_figures(json_file, result)

    with progress_bar(unit="runs") as progress:
        result = bench_joint(many, settings, range(seeds), poles=poles, lanes=lanes, progress=progress, so_far=so_far)
    columns = ("recording", "draws", "path, m", "ATE, m: decoupled", "joint", "m per 10 m: decoupled", "joint")
    table = Table(*columns, title="error of the vehicle's path, medians over draws", title_justify="left")
    for name in dict.fromkeys(row.scene for row in result.rows):
        mine = [row for row in result.rows if row.scene == name]
        figures = [
            sorted(values)[len(mine) // 2]
            for values in zip(
                *((r.decoupled_ate, r.joint_ate, r.decoupled_relative, r.joint_relative) for r in mine), strict=True
            )
        ]
        table.add_row(name, str(len(mine)), f"{mine[0].path_length:.0f}", *(f"{x:.3f}" for x in figures))
    Console(width=max(Console().width, 100)).print(table)
    better = sum(row.joint_ate < row.decoupled_ate for row in result.rows)
    typer.echo(
        f"{_percent('ATE, joint against decoupled', result.change)}, lower in {better} of {len(result.rows)} runs"
    )
    if result.landmarks is not None:
        better = sum(row.landmarks_ate < row.joint_ate for row in result.rows)
        typer.echo(f"{_percent('ATE, with poles against without', result.landmarks)}, lower in {better} runs")
    if result.lanes is not None:
        better = sum(row.lanes_in_map < row.joint_in_map for row in result.rows)
        change = _percent("error in the map, with lanes against without", result.lanes)
        typer.echo(f"{change}, lower in {better} runs")


def _online(scenes: Sequence[Scene], config: TrackConfig, seeds: int, lag: float, json_file: Path | None) -> None:
    """Run and print the online comparison."""
    from pipelines.bench.joint_online import OnlineBench, bench_online
    from pipelines.figures import write_figures

    def so_far(result: OnlineBench) -> None:
        row = result.rows[-1]
        line = f"{len(result.rows)}/{len(scenes) * seeds} {row.scene}, seed {row.seed}: {_pair(row.ate)} m ATE"
        error_console().print(line, markup=False, highlight=False, soft_wrap=True)
        if json_file is not None:
            write_figures(json_file, result)

    with progress_bar(unit="runs") as progress:
        result = bench_online(scenes, config, range(seeds), lag, progress=progress, so_far=so_far)
    columns = ("recording", "seed", "ATE, m", "settled", "pairs", "position, m", "velocity, m/s", "median")
    table = Table(*columns, title="decoupled -> joint, RMSE of objects in the world", title_justify="left")
    for row in result.rows:
        errors = [_pair(row.position), _pair(row.velocity), _pair(row.median_velocity)]
        table.add_row(row.scene, str(row.seed), _pair(row.ate), f"{row.settled_ate:.3f}", str(row.pairs), *errors)
    Console(width=max(Console().width, 120)).print(table)
    for name in ("ate", "position", "velocity"):
        better = sum(getattr(row, name)[1] < getattr(row, name)[0] for row in result.rows)
        change: Interval = getattr(result, name)
        typer.echo(
            f"{_percent(f'{name}, joint against decoupled', change)}, lower in {better} of {len(result.rows)} runs"
        )


def _pair(errors: tuple[float, float]) -> str:
    return f"{errors[0]:.3f} -> {errors[1]:.3f}"


def _percent(what: str, change: Interval) -> str:
    figures = f"{100 * change.estimate:+.1f} % ({100 * change.confidence:.0f} % interval"
    return f"{what}: {figures} {100 * change.low:+.1f} to {100 * change.high:+.1f} %)"
