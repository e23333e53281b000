"""`python -m benchmarks loops`: false loop closures in pose graphs, and loops by place on simulated drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report


def loops(
    files: Annotated[list[Path] | None, typer.Argument(help="Pose graphs in the g2o format.")] = None,
    shares: Annotated[str, typer.Option("--shares", help="False loops for each true one, with commas.")] = "0.1,0.3,1",
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Graphs made for each share.")] = 5,
    gnc: Annotated[bool, typer.Option("--gnc/--no-gnc", help="Run gtsam.GncLMOptimizer too.")] = True,
    courses: Annotated[
        str | None, typer.Option("--courses", help="In place of files: seeds of simulated LiDAR drives, with commas.")
    ] = None,
    drift: Annotated[
        str, typer.Option("--drift", help="With --courses: m of drift until the first loop, besides 1 %, with commas.")
    ] = "0,10,30",
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Add false loops to pose graphs, and compare with the optimum without them.

    With --courses: find the loops of drives of 2 km that pass three stretches again, and compare the path with that of
    the odometry.

    \b
    Example:
      python -m benchmarks loops data/slam/CSAIL.g2o data/slam/intel.g2o
      python -m benchmarks loops --courses 0,1
    """
    from saga_fg.errors import InputError

    if courses is not None:
        if files:
            raise InputError("--courses: expected no files besides, as courses are simulated")
        _courses(_numbers("--courses", courses), _numbers("--drift", drift), json_file)
        return
    if not files:
        raise InputError("expected files of pose graphs, or --courses")
    _graphs(files, _numbers("--shares", shares), seeds, gnc, json_file)


def _numbers(option: str, text: str) -> list[float]:
    from math import inf

    from saga_fg.errors import InputError

    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError as error:
        raise InputError(f"{option}: expected numbers with commas, got {text!r:.40}") from error
    if not all(0 <= number < inf for number in numbers):
        raise InputError(f"{option}: expected numbers >= 0 with commas, got {text!r:.40}")
    return numbers


def _courses(seeds: list[float], drifts: list[float], json_file: Path | None) -> None:
    from benchmarks.courses import bench_course
    from data_tools.figures import FigureTable, cell

    with progress_bar() as progress:
        rows = [bench_course(int(seed), drift, progress=progress) for seed in seeds for drift in drifts]
    shown = [
        (
            f"{row.seed}, {row.drift:g}",
            cell(row.length, 0),
            cell(100 * row.error, 2),
            cell(row.odometry, 2),
            cell(row.graph, 2),
            cell(row.ratio, 3),
            f"{row.found} of {row.stretches}",
            str(row.loops),
            str(row.false),
            str(row.lost),
        )
        for row in rows
    ]
    columns = (
        "seed, drift",
        "m",
        "odometry, %",
        "ATE, m: odometry",
        "with loops",
        "ratio",
        "stretches found",
        "loops",
        "false",
        "true lost",
    )
    report(
        [FigureTable("simulated courses: odometry that errs by 1 %, and loops", columns, tuple(shown))], rows, json_file
    )


def _graphs(files: list[Path], shares: list[float], seeds: int, gnc: bool, json_file: Path | None) -> None:
    import numpy as np

    from benchmarks.loops import LoopsRow, bench_loops
    from data_tools.figures import FigureTable, cell
    from data_tools.files.error_messages import error_context
    from data_tools.pose_graphs import read_g2o, with_false_loops

    graphs = [read_g2o(file) for file in files]
    for file, graph in zip(files, graphs, strict=True):
        with error_context(str(file)):
            with_false_loops(graph, 0.0, seed=0)  # refuses what cannot have any, before hours of others
    rows: list[LoopsRow] = []
    with progress_bar() as progress:
        for file, graph in zip(files, graphs, strict=True):
            with error_context(str(file)):
                rows += bench_loops(file.stem, graph, shares, seeds, gnc, progress)
    shown = []
    for key in dict.fromkeys((row.graph, row.share, row.contender) for row in rows):
        group = [row for row in rows if (row.graph, row.share, row.contender) == key]
        off = [row.off for row in group]
        counts = (sum(row.lost for row in group), sum(row.taken for row in group))
        seconds = float(np.mean([row.seconds for row in group]))
        shown.append(
            (
                f"{key[0]}, {key[1]:g}",
                key[2],
                cell(float(np.median(off))),
                cell(max(off)),
                *map(str, counts),
                cell(seconds, 1),
            )
        )
    columns = ("graph, share", "method", "RMS off, m: median", "largest", "true lost", "false taken", "s")
    report([FigureTable("false loops: distance from the optimum without them", columns, tuple(shown))], rows, json_file)
