"""`saga-fg evaluate`: how good are tracks?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose, chosen_scenes
from pipelines.cli.reporting import ReportingGroup, working
from pipelines.cli.tables import JsonFile, show_tables

evaluate_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)


@evaluate_app.callback()
def evaluate() -> None:
    """Compare results with the ground truth."""


@evaluate_app.command()
def nuscenes(
    result: Annotated[Path, typer.Argument(help="Tracking-result JSON, of any tracker.")],
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds the folder of tables.")],
    version: Annotated[str, typer.Option("--version", help="Name of the folder of tables.")] = "v1.0-mini",
    split: Annotated[
        str | None, typer.Option("--split", help="An official split, or one of splits.json beside the tables.")
    ] = None,
    scenes: Annotated[str | None, typer.Option("--scenes", help="Scene names with commas between them.")] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Score a nuScenes tracking result, by the official metrics.

    The figures equal those of the official development kit, which need not be installed.

    \b
    Example:
      saga-fg evaluate nuscenes tracks.json --dataroot data/nuscenes --split mini_train
    """
    from data_tools.atomic_files import check_writable
    from pipelines.evaluation import evaluate_nuscenes
    from pipelines.figures import write_figures

    chosen = chosen_scenes(dataroot, version, split, scenes)
    if json_file is not None:
        check_writable(json_file)
    with working("scoring"):
        evaluation = evaluate_nuscenes(result, dataroot, version, chosen)
    show_tables(evaluation.tables())
    if json_file is not None:
        write_figures(json_file, evaluation.figures())
