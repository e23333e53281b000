"""`saga-fg slam plaza`: range-only SLAM."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import working
from pipelines.cli.options import Verbose
from pipelines.cli.summary import counted


def plaza(
    file: Annotated[Path, typer.Argument(help="NAME_DR.txt; NAME_TD.txt beside it, the truth in NAME_GT, NAME_TL.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    verbose: Verbose = False,
) -> None:
    """Locate a drive and radio beacons from odometry and ranges, the radio's scale and offset among them.

    Writes the trajectory (TUM, KITTI), the beacons with their covariances (JSON, PLY), figures.json and a picture.

    \b
    Example:
      saga-fg slam plaza Plaza2_DR.txt --output plaza2
    """
    from data_tools.datasets.plaza import read_plaza
    from data_tools.files.atomic_files import check_writable_folder
    from pipelines.slam.plaza import compared, map_beacons
    from pipelines.slam.results import landmark_row, planar_trajectory, write_landmark_map

    check_writable_folder(output)
    drive = read_plaza(file)
    with working("solving"):
        beacons = map_beacons(drive)
    estimate = planar_trajectory(drive.time, beacons.world_T_pose)
    figures, paths = compared(drive, beacons)
    found = [
        landmark_row(
            number, "beacon", dict(zip("xy", place.tolist(), strict=True)), beacons.covariances[number],
            int((drive.beacon == number).sum()),
        )
        for number, place in beacons.beacons.items()
    ]  # fmt: skip
    write_landmark_map(output, estimate, found, figures, paths)
    typer.echo(
        f"{output}: {counted(len(estimate), 'pose')}, {counted(len(drive.range), 'range')}, "
        f"{counted(len(found), 'beacon')}; ranges: scale {1 + beacons.scale:.4f}, offset {beacons.offset:+.2f} m"
    )
    for name in ("ATE", "beacons"):
        if f"{name}, m" in figures:
            reckoned = f" (dead reckoning {figures['ATE of dead reckoning, m']:.3f} m)" if name == "ATE" else ""
            typer.echo(f"error against the truth, {name}: {figures[f'{name}, m']:.3f} m RMS{reckoned}")
