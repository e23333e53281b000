"""`saga-fg smooth`: recordings in, labels out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipelines.cli import options
from pipelines.cli import tracking_options as how
from pipelines.cli.console import progress_bar
from pipelines.cli.datasets import dataset_commands
from pipelines.cli.scaling import RayAddress, Workers, at_scale, exit_on_failures, run_at_scale
from pipelines.cli.summary import counted

if TYPE_CHECKING:
    from data_tools.datasets.source import DatasetSource
    from pipelines.smoothing import SmoothedScene, StreamedScene


def _smooth(
    source: DatasetSource,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    method: how.MethodOption = "saga",
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    table: Annotated[
        Literal["csv", "ndjson", "parquet"],
        typer.Option("--table", help="Format of the table of boxes; parquet needs the extra [parquet]."),
    ] = "csv",
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Label recordings: a table of boxes, a summary, and the labels in the dataset's own format if it has one.

    Tables of detections are smoothed as they are read: memory does not grow with their length.
    """
    from pipelines.doubts import Doubted, Doubts
    from pipelines.scale_out import SmoothTask
    from pipelines.smoothing import (
        load_smooth_config,
        smooth_dataset,
        smooth_stream,
        write_labels,
        write_streamed_labels,
    )

    how.association_fits(method, association)
    settings = load_smooth_config(source.family, config)
    tracking = how.with_interactions(settings.tracking, method, interactions)
    settings = replace(settings, tracking=tracking.with_association(association))
    usual = load_smooth_config(source.family).tracking
    doubts = Doubts(settings.tracking.of_method(method), usual, source.option_for)
    if at_scale(workers, ray):
        doubts.see_first(source)
        task = SmoothTask(settings, method, source, f".{table}")
        report = run_at_scale(source, task, output, workers, ray, source.merged[1], source.merge_labels)
        exit_on_failures(report)
        return
    stream = source.stream()
    if stream is not None:
        with stream as parts, progress_bar() as progress:
            streamed = write_streamed_labels(
                output,
                lambda folder: smooth_stream(doubts.over(parts), settings, folder, method, progress=progress),
                f".{table}",
            )
        _show(output, streamed)
        return
    with source.open() as dataset, progress_bar(len(dataset.scenes)) as progress:
        runs = smooth_dataset(Doubted(dataset, doubts), settings, method, progress=progress)
        done = write_labels(
            output, runs, f".{table}", lambda folder, labels: source.write_labels(folder, dataset, labels)
        )
    _show(output, done)


_EXAMPLES = (
    "smooth {recordings} --output labels",
    "smooth {recordings} --output labels --workers 0   # all cores",
)
_commands = dataset_commands("smooth", _smooth, _EXAMPLES)
smooth_app = typer.Typer(cls=_commands, no_args_is_help=True, rich_markup_mode=None)


@smooth_app.callback()
def smooth() -> None:
    """Make labels of recorded detections: past and future of every object, gaps filled, uncertainty stated."""


def _show(output: Path, runs: tuple[SmoothedScene, ...] | tuple[StreamedScene, ...]) -> None:
    """The line that says what was done."""
    from saga_fg.smoothing import LabelCounts

    total = LabelCounts.sum(run.counts for run in runs)
    typer.echo(
        f"{output}: {counted(len(runs), 'scene')}, {counted(total.objects, 'object')}, {counted(total.boxes, 'box')}: "
        f"{total.observed} observed, {total.filled} filled, {total.extended} extended; "
        f"{total.dropped} dropped with {counted(total.dropped_objects, 'object')}; "
        f"{counted(total.joined, 'tracklet')} joined to others"
    )
