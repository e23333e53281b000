"""`python -m benchmarks speed`: what a frame costs, by method, stage and number of objects."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose, counts
from pipelines.cli.tables import JsonFile, MarkdownFile, report, writable

if TYPE_CHECKING:
    from benchmarks.speed import SpeedBench
    from data_tools.figures import FigureTable


def speed(
    data: Annotated[
        Path | None,
        typer.Option("--data", help="Folder with nuscenes/ and kitti/.  [default: simulated objects alone]"),
    ] = None,
    sizes: Annotated[
        str, typer.Option("--sizes", help="Numbers of simulated objects, with commas between.")
    ] = "10,100,200,500,1000,5000",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of each case that are counted.")] = 60,
    seconds: Annotated[
        float,
        typer.Option("--seconds", min=0.1, help="No more frames of a case after that; no larger case after a quarter."),
    ] = 60.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the simulated objects.")] = 0,
    round_trips: Annotated[
        int, typer.Option("--round-trips", min=0, help="Frames to the live service, at 10 Hz; 0: none.")
    ] = 200,
    profile: Annotated[
        Path | None,
        typer.Option(
            "--profile",
            help="Write where the time of saga goes, in the first case, for speedscope.app.",
            metavar="FILE",
            callback=writable,
        ),
    ] = None,
    json_file: JsonFile = None,
    markdown: MarkdownFile = None,
    verbose: Verbose = False,
) -> None:
    """Measure what a frame costs: milliseconds by method and stage, memory, growth with the number of objects.

    All methods take the frames in turn on one thread; times are CPU times, beside those of clocks that never change.

    \b
    Examples:
      python -m benchmarks speed --sizes 10,100 --frames 20
      python -m benchmarks speed --data data --json figures.json --markdown tables.md
      python -m benchmarks speed --data data --sizes 10 --profile profile.speedscope.json
    """
    from benchmarks.speed import SpeedBenchSettings, bench_speed, speed_cases, write_profile

    settings = SpeedBenchSettings(counts("--sizes", sizes), frames, seconds, seed, round_trips)
    with progress_bar(unit="frames") as progress:
        result = bench_speed(settings, data, progress)
    report(_tables(result), result, json_file, markdown)
    for name, exponent in result.growth.items():
        typer.echo(f"cost of {name}: grows as objects^{exponent:.2f}")
    typer.echo(", ".join(f"{name} {value}" for name, value in result.environment.items()))
    if profile is not None:
        write_profile(profile, next(speed_cases(settings, data)), "saga")


def _tables(result: SpeedBench) -> list[FigureTable]:
    """Cost and ratios, shares of the stages, and the live service."""
    from data_tools.figures import FigureTable, cell

    costs, shares = [], []
    names = tuple(dict.fromkeys(stage for row in result.rows for stage in row.stages))
    for row in result.rows:
        ratios = (row.to_centerpoint, row.to_frozen, row.to_filters, row.to_svd)
        figures = (cell(row.objects, 0), cell(row.median, 2), cell(row.p99, 2), cell(row.memory, 2))
        costs.append((row.case, row.method, *figures, *(cell(ratio, 2) for ratio in ratios)))
        total = math.fsum(row.stages.values())
        if total > 0:
            parts = (cell(100 * row.stages.get(name, 0.0) / total, 0) for name in names)
            shares.append((row.case, row.method, *parts))
    columns = ("case", "method", "tracks", "ms", "p99", "MB", "/ centerpoint", "/ frozen", "/ 100 filters", "/ SVD")
    tables = [
        FigureTable("CPU time a frame", columns, tuple(costs)),
        FigureTable("shares of the stages, %", ("case", "method", *names), tuple(shares)),
    ]
    if (live := result.service) is not None:
        times = (cell(live.p50, 1), cell(live.p90, 1), cell(live.p99, 1), cell(live.cpu, 1), cell(live.memory, 0))
        named = ("objects", "frames", "p50, ms", "p90", "p99", "CPU ms a frame", "MB")
        title = "live service at 10 Hz: round trip on the wall's clock"
        tables.append(FigureTable(title, named, ((str(live.objects), str(live.frames), *times),)))
    return tables
