"""`python -m benchmarks metrics`: our nuScenes tracking metrics beside the official ones."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import working
from pipelines.cli.tables import JsonFile
from saga_fg.errors import InputError

TOLERANCE = 1e-6


def metrics(
    result: Annotated[
        Path | None, typer.Option("--result", help="Tracking-result JSON; without it, simulated scenes are tracked.")
    ] = None,
    dataroot: Annotated[Path | None, typer.Option("--dataroot", help="Folder that holds the folder of tables.")] = None,
    version: Annotated[str, typer.Option("--version", help="Name of the folder of tables.")] = "v1.0-mini",
    split: Annotated[str, typer.Option("--split", help="The split to score.")] = "all",
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes, if there is no result.")] = 2,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Our nuScenes tracking metrics beside the official development kit's: the same figures? how much faster?

    The kit needs NumPy 1: the variable SAGA_FG_DEVKIT_PYTHON names a python that has it (.ci/devkit-requirements.txt).
    Exit code 1 if a figure differs by more than 1e-6.

    \b
    Examples:
      export SAGA_FG_DEVKIT_PYTHON=devkit/bin/python
      python -m benchmarks metrics
      python -m benchmarks metrics --result tracks.json --dataroot data/nuscenes --split mini_train
    """
    from benchmarks.devkit import PYTHON_VARIABLE, parity, tracked_simulation
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable

    python = os.environ.get(PYTHON_VARIABLE)
    if not python:
        raise InputError(f"{PYTHON_VARIABLE}: expected the name of a python that has nuscenes-devkit, it is not set")
    if (result is None) != (dataroot is None):
        raise InputError("expected both --result and --dataroot, or neither")
    if json_file is not None:
        check_writable(json_file)
    with tempfile.TemporaryDirectory() as folder, working("scoring twice"):
        if result is None or dataroot is None:
            dataroot = Path(folder) / "simulated"
            result = tracked_simulation(dataroot, scenes)
        outcome = parity(python, result, dataroot, version, split)
    ours, theirs = outcome.seconds
    typer.echo(f"AMOTA {outcome.amota:.4f}; largest difference of any figure: {outcome.difference:.1e}")
    typer.echo(f"CPU time: {ours:.2f} s, official {theirs:.2f} s, {outcome.ratio:.0f} times faster")
    if json_file is not None:
        write_figures(json_file, {"parity": outcome, "ratio": outcome.ratio})
    if outcome.difference > TOLERANCE:
        typer.echo(f"the figures differ: {outcome.where}", err=True)
        raise typer.Exit(1)
