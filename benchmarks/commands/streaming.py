"""`python -m benchmarks streaming`: memory and time of smoothing a recording as it goes by."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile

if TYPE_CHECKING:
    from benchmarks.streaming import StreamingBenchSettings

LIMIT = 4000.0  # MB, that an hour of 200 objects at 10 Hz is to stay under


def streaming(
    objects: Annotated[int, typer.Option("--objects", min=5, help="Objects at any time.")] = 200,
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="Length of the recording.")] = 300.0,
    rate: Annotated[float, typer.Option("--rate", min=0.1, help="Frames a second.")] = 10.0,
    compared: Annotated[
        float, typer.Option("--compared", min=1.0, help="Seconds of it that are compared with the batch smoother.")
    ] = 20.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the traffic.")] = 0,
    file: Annotated[
        bool, typer.Option("--file", help="From a file of detections to labels on disk, not the smoother alone.")
    ] = False,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """What smoothing a recording without an end takes: memory, time, and what is lost against the whole at once.

    Platoons of cars that come, go and are hidden at times, drawn from the model; sliding windows give out moments as
    they become final.

    \b
    Examples:
      python -m benchmarks streaming
      python -m benchmarks streaming --seconds 3600      # an hour
      python -m benchmarks streaming --file --seconds 120 --compared 60
    """
    from benchmarks.streaming import StreamingBenchSettings, bench_streaming
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable

    settings = StreamingBenchSettings(objects, seconds, rate, compared=compared, seed=seed)
    if json_file is not None:
        check_writable(json_file)
    if file:
        _file(settings, json_file)
        return
    with progress_bar() as progress:
        result = bench_streaming(settings, progress=progress)
    table = Table("recorded, s", "memory, MB", "moments held", "CPU, s", title=f"{objects} objects at {rate:g} Hz")
    for row in result.rows:
        table.add_row(f"{row.recorded:.0f}", f"{row.memory:.0f}", str(row.held), f"{row.cpu:.1f}")
    Console().print(table)
    memory = f"peak memory {result.peak:.0f} MB, growth over the second half {result.growth:+.0f} MB"
    typer.echo(f"{result.moments} moments; {memory}; {result.ratio:.3f} s of CPU time a second")
    typer.echo(f"RMSE {result.rmse:.3f} m, ANEES {result.anees:.3f}")
    typer.echo(
        f"largest difference from the batch smoother in {compared:g} s: {result.largest_difference:.1e} m or m/s"
    )
    if json_file is not None:
        write_figures(json_file, {"settings": asdict(settings), **asdict(result)})


def _file(settings: StreamingBenchSettings, json_file: Path | None) -> None:
    from benchmarks.streamed_files import bench_files
    from data_tools.figures import write_figures

    with progress_bar() as progress:
        result = bench_files(settings, progress)
    table = Table(
        "read, s",
        "memory, MB",
        "most so far, MB",
        "CPU, s",
        title=f"{settings.objects} objects at {settings.rate:g} Hz",
    )
    for row in result.rows:
        table.add_row(f"{row.recorded:.0f}", f"{row.memory:.0f}", f"{row.peak:.0f}", f"{row.cpu:.1f}")
    Console().print(table)
    typer.echo(
        f"peak memory {result.peak:.0f} MB, {result.peak / LIMIT:.0%} of {LIMIT / 1000:g} GB and {result.growth:.2f} "
        f"times that of the first quarter; {result.boxes} boxes; {result.ratio:.3f} s of CPU time a second"
    )
    typer.echo(
        f"largest difference from the whole at once in {settings.compared:g} s: {result.largest_difference:.1e} m; "
        f"{result.differing} of {result.compared} boxes in one of the two alone"
    )
    if json_file is not None:
        write_figures(json_file, {"settings": asdict(settings), **asdict(result)})
