"""Running a command over many scenes at once: the options, the run, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.reporting import progress_bar
from pipelines.cli.summary import counted
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from pipelines.scale_out import Pool, Report, SceneInput, SceneTask

FAILED_SCENES = 1  # exit code

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        help="Do the scenes in parallel, in so many processes (0: one a core); --output is a folder then, and a second "
        "run does only what is not done.",
        metavar="N",
    ),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray",
        help='Do the scenes on a Ray cluster: "auto", HOST:PORT, ray://HOST:PORT, or "local" for one of --workers '
        "CPUs on this machine.",
        metavar="ADDRESS",
    ),
]

Detections = Annotated[
    list[str],
    typer.Argument(
        help="Table of detections: .csv, .ndjson, .jsonl or .npz. In parallel: several of them, patterns, URLs, or "
        "lists of such in a .txt file.",
    ),
]


def at_scale(workers: int | None, ray: str | None) -> bool:
    """Whether the scenes are to be done in parallel."""
    return workers is not None or ray is not None


def several(detections: Sequence[str], scenes: str | None) -> list[str]:
    """The files of detections to do in parallel; raises `InputError` where --scenes would choose among their scenes."""
    from data_tools.files.remote_files import expanded

    if scenes is not None:
        raise InputError("--scenes: all scenes of a file are done with --workers or --ray")
    return expanded(detections)


def only(detections: Sequence[str]) -> str:
    """The one file of detections; raises `InputError` if there are several."""
    if len(detections) > 1:
        raise InputError(
            "expected one table of detections; several need --workers N or --ray, and a folder as --output"
        )
    return detections[0]


def run_at_scale(
    inputs: Iterable[SceneInput],
    total: int,
    task: SceneTask,
    output: Path,
    workers: int | None,
    ray: str | None,
    merge: Callable[[], None] | None = None,
) -> None:
    """Do the task with all inputs, and print what became of them; `merge` what they left, if all have done it.

    Scenes that failed are named with their reasons, and end the command with an exit code.
    """
    from pipelines.scale_out import LocalPool, RayPool, run_scenes

    if output.suffix:
        raise InputError(f"--output {output}: expected the name of a folder, since scenes are done in parallel")

    def new_pool(scratch: Path) -> Pool:
        return LocalPool(workers or 0, scratch) if ray is None else RayPool(ray, workers or 0)

    def finish(report: Report) -> None:
        if merge is not None and not report.failed:
            merge()

    with progress_bar(unit="scenes") as bar:
        report = run_scenes(inputs, total, task, output, new_pool, lambda _, done, of: bar("scenes", done, of), finish)
    counts = "".join(f", {number} {noun}" for noun, number in report.counts.items())
    states = f"{len(report.done)} done, {len(report.unchanged)} unchanged, {len(report.failed)} failed"
    typer.echo(f"{output}: {counted(report.scenes, 'scene')}: {states}{counts}")
    for name, reason in report.failed.items():
        typer.echo(f"failed: {name}: {reason}", err=True)
    if report.failed:
        raise typer.Exit(FAILED_SCENES)
