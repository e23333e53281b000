"""`python -m benchmarks slam`: LiDAR odometry beside KISS-ICP, and what SLAM costs."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report

if TYPE_CHECKING:
    from benchmarks.slam_all_in import AllIn
    from data_tools.figures import FigureTable


def slam(
    dataroot: Annotated[
        Path | None, typer.Option("--dataroot", help="KITTI tracking: training/, or oxts/ and velodyne/.")
    ] = None,
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    kiss: Annotated[
        bool, typer.Option("--kiss/--no-kiss", help="With KISS-ICP, of the extra bench, or ours alone.")
    ] = True,
    open3d: Annotated[
        bool, typer.Option("--open3d", help="Our odometry with Open3D's registration in place of ours, too.")
    ] = False,
    drive: Annotated[
        int | None,
        typer.Option("--drive", min=100, help="Instead: cost of so many keyframes in a simulated town, without scans."),
    ] = None,
    landmarks: Annotated[
        int | None,
        typer.Option("--landmarks", min=20, help="Instead: cost of `LandmarkMapper` up to so many landmarks."),
    ] = None,
    dense: Annotated[
        int | None,
        typer.Option("--dense", min=2, help="Instead: SLAM all in on so many simulated scans of full density."),
    ] = None,
    firings: Annotated[
        int, typer.Option("--columns", min=100, help="With --dense: points of a beam; 2000 are full density.")
    ] = 2000,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of --drive, --landmarks and --dense.")] = 0,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """LiDAR odometry against KISS-ICP, on the same scans in turn.

    RPE is the error over 10 m against GPS/IMU, which is itself not exact; the residual of scans in the map of their
    neighbours needs no reference. Both are printed for the scans as recorded and for de-skewed ones. Then follows the
    CPU time of SLAM all in: odometry, landmarks, graph and loops.

    \b
    Examples:
      python -m benchmarks slam --dataroot data/kitti --sequence 0000
      python -m benchmarks slam --dense 40
      python -m benchmarks slam --drive 10000
      python -m benchmarks slam --landmarks 3000
    """
    from benchmarks.slam import OURS, bench_slam
    from benchmarks.slam_all_in import bench_all_in
    from data_tools.datasets.kitti import KittiScans
    from data_tools.figures import FigureTable, cell
    from saga_fg.errors import InputError

    if sum(one is not None for one in (dataroot, drive, landmarks, dense)) != 1:
        raise InputError("expected one of --dataroot, --drive, --landmarks and --dense")
    if drive is not None:
        _drive(drive, seed, json_file)
    elif landmarks is not None:
        _landmarks(landmarks, seed, json_file)
    elif dense is not None:
        _dense(dense, firings, seed, json_file)
    if dataroot is None:
        return
    with progress_bar() as progress:
        recorded = KittiScans(dataroot, sequence, most=scans)
        rows = bench_slam(recorded, kiss, progress=progress, open3d=open3d)
        cost = bench_all_in(f"sequence {sequence}", recorded, progress)
    shown = []
    for row in rows:
        e = row.errors
        errors = (e.relative_translation, 57.29578 * e.relative_rotation, e.end_error, 1e3 * row.residual)
        shown.append((row.case, row.contender, *(cell(x) for x in errors), cell(row.milliseconds, 1)))
    columns = ("scans", "method", "RPE, m per 10 m", "RPE, deg per 10 m", "end, m", "residual, mm", "ms a scan")
    table = FigureTable(f"sequence {sequence}: odometry against GPS/IMU", columns, tuple(shown))
    report([table, _all_in(cost)], [*rows, cost], json_file)
    for ours, theirs in itertools.product(rows, rows):
        if ours.case == theirs.case and ours.contender == OURS != theirs.contender:
            worse = 100 * (ours.errors.relative_translation - theirs.errors.relative_translation)
            duller = 100 * (ours.residual / theirs.residual - 1)
            share = ours.milliseconds / theirs.milliseconds
            typer.echo(
                f"{ours.case}: RPE {worse:+.1f} cm per 10 m, residual {duller:+.1f} %, "
                f"time {share:.2f} of {theirs.contender}'s"
            )


def _all_in(cost: AllIn) -> FigureTable:
    from data_tools.figures import FigureTable, cell

    columns = (
        "scans",
        "keyframes",
        "submaps",
        "points a scan",
        "ms a scan",
        "ms, no keyframe",
        "ms, keyframe",
        "longest",
        "end / beginning",
        "MB",
    )
    counts = (f"{cost.case}: {cost.scans}", str(cost.keyframes), str(cost.submaps), f"{cost.points:.0f}")
    times = (cost.mean, cost.between, cost.keyframe, cost.longest)
    return FigureTable(
        "SLAM all in, CPU time",
        columns,
        ((*counts, *(cell(x, 1) for x in times), cell(cost.growth), cell(cost.memory, 0)),),
    )


def _dense(scans: int, firings: int, seed: int, json_file: Path | None) -> None:
    """Scans as those of 64 beams."""
    from benchmarks.slam_all_in import bench_all_in
    from data_tools.figures import FigureTable, cell
    from data_tools.simulator.course import SimulatedCourse
    from data_tools.simulator.scanner import ScannerSettings

    course = SimulatedCourse(seed, 0.8 * scans, settings=ScannerSettings(rings=64, columns=firings))
    with progress_bar() as progress:
        cost = bench_all_in(f"simulated, seed {seed}", course, progress, course.lap)
    columns = ("scans", "ms, keyframe", "ms where a submap closes, with loops", "MB so far")
    rows = [
        (f"{one.first} to {one.last}", cell(one.keyframe, 1), cell(one.closing, 1), cell(one.memory, 0))
        for one in cost.parts
    ]
    tenths = FigureTable("tenths of the drive", columns, tuple(rows))
    report([_all_in(cost), tenths], [cost], json_file)
    typer.echo(
        f"end to beginning: {cost.growth:.3f} of the time of a keyframe, {cost.closing:.3f} where a submap closes, "
        f"with loops; {cost.load:.3f} for work that never changes; {cost.loops} loops, {cost.false_loops} left "
        f"out; everything together at the end: {cost.finish:.1f} s"
    )


def _drive(keyframes: int, seed: int, json_file: Path | None) -> None:
    from benchmarks.slam_drive import bench_drive
    from data_tools.figures import FigureTable, cell

    with progress_bar() as progress:
        cost = bench_drive(keyframes, seed, progress)
    columns = ("keyframes", "ms a keyframe", "ms where a submap closes, with loops", "variables at most")
    rows = [
        (f"{part.first} to {part.last}", cell(part.keyframe), cell(part.submap), str(part.variables))
        for part in cost.parts
    ]
    title = f"{cost.keyframes} keyframes, {cost.metres:.0f} m, {cost.submaps} submaps, {cost.loops} loops"
    report([FigureTable(title, columns, tuple(rows))], [cost], json_file)
    typer.echo(
        f"last lap to first one: {cost.ratio:.3f} of the time; memory at most {cost.memory:.0f} MB; error "
        f"{cost.error:.2f} m (odometry {cost.before:.2f} m); everything together at the end: {cost.finish:.1f} s"
    )


def _landmarks(landmarks: int, seed: int, json_file: Path | None) -> None:
    from benchmarks.landmark_drive import bench_landmarks
    from data_tools.figures import FigureTable, cell

    with progress_bar() as progress:
        cost = bench_landmarks(landmarks, seed, progress)
    columns = ("poses", "ms a pose", "landmarks of the map", "in the local Gaussian")
    rows = [
        (f"{part.first} to {part.last}", cell(part.pose), str(part.landmarks), str(part.local)) for part in cost.parts
    ]
    title = f"{cost.poses} poses, {cost.observations} observations, {cost.landmarks} landmarks of {landmarks}"
    report([FigureTable(title, columns, tuple(rows))], [cost], json_file)
    typer.echo(
        f"last tenth to second one: {cost.ratio:.2f} of the time at {cost.growth:.1f} times the landmarks; "
        f"F1 over pairs {cost.f1:.4f}; error {cost.error:.2f} m; memory at most {cost.memory:.0f} MB"
    )
