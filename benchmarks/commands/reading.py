"""`python -m benchmarks reading`: what it takes to read nuScenes at its full size."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import working
from pipelines.cli.summary import counted
from pipelines.cli.tables import JsonFile


def reading(
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Scenes of the tables; the original has 850.")] = 850,
    detections: Annotated[int, typer.Option("--detections", min=0, help="Detections of a sample.")] = 30,
    folder: Annotated[
        Path | None, typer.Option("--folder", help="Where to write the tables.  [default: for the run alone]")
    ] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Generate tables of the size of nuScenes v1.0-trainval, and read them: peak memory and time.

    850 scenes take 3 GB of disk.

    \b
    Examples:
      python -m benchmarks reading --scenes 20
      python -m benchmarks reading
    """
    from benchmarks.large_tables import TableSize, write_large_tables
    from benchmarks.reading import bench_reading
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable

    size = TableSize(scenes=scenes, detections=detections)
    if json_file is not None:
        check_writable(json_file)
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary) / "tables" if folder is None else folder
        with working(f"writing tables of {counted(scenes, 'scene')}"):
            write_large_tables(place, size)
        typer.echo(", ".join(f"{number} {name}" for name, number in size.rows.items()))
        with working("reading"):
            figures = bench_reading(place)
    read = f"{figures.samples} samples, {figures.annotations} annotations, {figures.detections} detections"
    typer.echo(f"read {counted(figures.scenes, 'scene')}, {read} in {figures.seconds:.0f} s of CPU time")
    typer.echo(f"peak memory {figures.peak:.0f} MB, of which {figures.start:.0f} MB before anything was read")
    if json_file is not None:
        write_figures(json_file, {"rows": size.rows, **asdict(figures)})
