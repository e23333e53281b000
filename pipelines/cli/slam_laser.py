"""`saga-fg slam laser`: path and map from a planar laser and wheel odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.summary import counted


def laser(
    file: Annotated[Path, typer.Argument(help="Log in CARMEN's format (FLASER or ROBOTLASER1); .bz2 and .gz too.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """SLAM with a planar laser: scan matching, loops by place, and one graph of keyframes.

    Writes the path at every scan (trajectory.tum; by scan matching alone, matched.tum; by the wheels, odometry.tum),
    the graph (poses.g2o), the map as a picture (map.png) and figures.json.

    \b
    Example:
      saga-fg slam laser intel.clf.bz2 --output intel
    """
    import time

    from data_tools.files.atomic_files import check_writable_folder
    from data_tools.laser import read_carmen
    from pipelines.slam.configuration import load_laser_settings
    from pipelines.slam.laser_results import write_laser_slam
    from pipelines.slam.laser_slam import laser_slam

    check_writable_folder(output)
    settings = load_laser_settings(config)
    log = read_carmen(file)
    if scans is not None:
        log = log.first(scans)
    began = time.process_time()
    with progress_bar(unit="scans") as progress:
        path = laser_slam(log, settings, progress)
    seconds = time.process_time() - began
    figures = write_laser_slam(output, log, path, settings.largest_range, seconds)
    loops = f"{counted(path.loops, 'loop')}, {path.rejected} left out as false"
    typer.echo(f"{output}: {counted(len(log), 'scan')}, {counted(len(path.keyframes), 'keyframe')}, {loops}")
    entropy, alone = figures["entropy"], figures["entropy_scan_matching"]
    typer.echo(f"entropy of the map: {entropy:.0f} bits, by scan matching alone {alone:.0f}")
    used = f"{seconds:.1f} s" if seconds >= 1 else f"{1e3 * seconds:.0f} ms"
    typer.echo(f"{used} of CPU, {figures['times_real_time']:.0f} times real time")
