"""`python -m benchmarks joint`: the vehicle and the objects around it in one graph, against one after the other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report


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
    online: Annotated[bool, typer.Option("--online", help="In a running graph, frame by frame.")] = False,
    lag: Annotated[float, typer.Option("--lag", min=0.0, help="Of the running graph, s.")] = 3.0,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Joint against decoupled estimation with degraded odometry: errors of the path and of the objects.

    Decoupled: the odometry's path and the tracker along it; held: objects from the whole recording along that path.
    The odometry has noise, a scale error and a bias of the yaw rate, all wandering, sampled anew for every seed. The
    figures so far are written to the file of --json after every run.

    \b
    Examples:
      python -m benchmarks joint --scenes 10 --poles
      python -m benchmarks joint --scenes 10 --lanes --no-parked
      python -m benchmarks joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --seeds 10
      python -m benchmarks joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --online
    """
    from benchmarks.joint import bench_joint, joint_tables
    from benchmarks.joint_online import bench_online, online_tables
    from data_tools.datasets.kitti import KittiTracking
    from data_tools.figures import write_figures
    from data_tools.simulator import simulate_scene
    from pipelines.config import load_config
    from pipelines.slam.joint import street
    from saga_fg.errors import InputError

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
        kitti = KittiTracking(dataroot, detections, None if sequences is None else sequences.split(","), True)
        many = [kitti.scene(name) for name in kitti.scenes]
        settings = load_config("kitti", config)

    def so_far(result: object) -> None:
        if json_file is not None:
            write_figures(json_file, result)

    with progress_bar(unit="runs") as progress:
        if online:
            on = bench_online(many, settings, range(seeds), lag, progress=progress, so_far=so_far)
            report(online_tables(on), on, json_file)
        else:
            found = bench_joint(
                many, settings, range(seeds), poles=poles, lanes=lanes, progress=progress, so_far=so_far
            )
            report(joint_tables(found), found, json_file)
