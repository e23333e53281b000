"""Parallel runs of a command: the options, the run, and its report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.summary import counted
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from data_tools.datasets.source import DatasetSource
    from pipelines.scale_out import Pool, RunSummary, SceneTask
    from saga_fg.types.dataset import Dataset

FAILED_SCENES = 1  # exit code

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        help="Process scenes in parallel, in this many processes (0: one per core); a second run continues where the "
        "first stopped.",
        metavar="N",
    ),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray",
        help='Process scenes on a Ray cluster: "auto", HOST:PORT, ray://HOST:PORT, or "local" for one of --workers '
        "CPUs on this machine.",
        metavar="ADDRESS",
    ),
]


def at_scale(workers: int | None, ray: str | None) -> bool:
    """True if scenes are to be done in parallel."""
    return workers is not None or ray is not None


def run_at_scale(
    source: DatasetSource,
    task: SceneTask,
    output: Path,
    workers: int | None,
    ray: str | None,
    merged: str,
    merge: Callable[[Path, Sequence[str], Dataset | None], None],
) -> RunSummary:
    """Do the task with all parts of a dataset; print and return what became of them.

    merge  makes the file `merged` of what they left, if all have done it; "" for none
    """
    from pipelines.scale_out import LocalPool, RayPool, file_name, run_scenes

    if output.suffix:
        raise InputError(f"--output {output}: expected the name of a folder, since scenes are done in parallel")

    def new_pool(scratch: Path) -> Pool:
        return LocalPool(workers or 0, scratch) if ray is None else RayPool(ray, workers or 0)

    def finish(report: RunSummary) -> None:
        if merged and not report.failed:
            merge(output, [file_name(name) for name in there.names], there.dataset)

    with source.parts() as there, progress_bar(unit="scenes") as bar:
        if merged:
            (output / merged).unlink(missing_ok=True)
        report = run_scenes(
            there.parts,
            len(there.names),
            task,
            output,
            new_pool,
            lambda _, done, of: bar("scenes", done, of),
            finish,
        )
    counts = "".join(f", {number} {noun}" for noun, number in report.counts.items())
    states = f"{len(report.done)} done, {len(report.unchanged)} unchanged, {len(report.failed)} failed"
    typer.echo(f"{output}: {counted(report.scenes, 'scene')}: {states}{counts}")
    return report


def exit_on_failures(report: RunSummary) -> None:
    """Name the scenes that failed, with their reasons, and end the command with an exit code if there are any."""
    for name, reason in report.failed.items():
        typer.echo(f"failed: {name}: {reason}", err=True)
    if report.failed:
        raise typer.Exit(FAILED_SCENES)
