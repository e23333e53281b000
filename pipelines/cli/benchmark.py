"""`saga-fg benchmark`: the figures of a whole dataset by one command that can be stopped and started again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli import options
from pipelines.cli import tracking_options as how
from pipelines.cli.console import working
from pipelines.cli.datasets import dataset_commands
from pipelines.cli.scaling import RayAddress, Workers, exit_on_failures, run_at_scale
from pipelines.cli.tables import show_tables
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from data_tools.datasets.source import DatasetSource


def _benchmark(
    source: DatasetSource,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the run; the same one again continues the run.")
    ],
    method: how.MethodOption = "saga",
    estimator: how.EstimatorOption = None,
    lag: how.LagOption = None,
    association: how.AssociationOption = None,
    hota: Annotated[bool, typer.Option("--hota", help="HOTA too (needs the extra [eval]).")] = False,
    without_truth: Annotated[
        bool, typer.Option("--without-truth", help="The submission alone, as for a test split without ground truth.")
    ] = False,
    workers: Workers = 0,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Track all scenes in parallel, score them, and write figures and a page; for nuScenes and KITTI a submission.

    The figures are the official ones of nuScenes and KITTI, and CLEAR of other datasets. The folder gets tracks/ with a
    result for each scene, all of them in one, figures.json, report.html, and for nuScenes and KITTI submission.zip for
    the official server. A scene that is done is not done again, unless its input, the settings or
    saga-fg have changed.
    """
    from pipelines.benchmark import judge_run
    from pipelines.scale_out import TrackTask

    if not source.all_tracks:
        raise InputError(f"benchmark {source.name}: expected a dataset with official results: saga-fg benchmark --help")
    settings = how.configured(source.family, config, method, estimator, lag, association)
    options.apart(output, *source.input_files())
    task = TrackTask(settings, method, source)
    run = run_at_scale(source, task, output, workers, ray, source.merged[0], source.merge_tracks)
    exit_on_failures(run)
    with working("writing the submission"):
        submission = source.write_submission(output)
    if not without_truth:
        with working("scoring"):
            evaluation = judge_run(source, output, method, task.configuration, hota)
        show_tables(list(evaluation.tables())[:1])
        typer.echo(f"{output / 'figures.json'}: all figures; {output / 'report.html'}: a page of them")
    if submission is not None:
        typer.echo(f"{submission}: for the official server")


_commands = dataset_commands(
    "benchmark",
    _benchmark,
    (
        "benchmark {recordings} --output run   # stopped? the same again",
        "benchmark {recordings} --output baseline --method kf --workers 4",
        "benchmark {recordings} --output test --without-truth",
    ),
    listed=lambda source: bool(source.all_tracks),
)
benchmark_app = typer.Typer(cls=_commands, no_args_is_help=True, rich_markup_mode=None)


@benchmark_app.callback()
def benchmark() -> None:
    """Get the figures of a whole dataset, with tracks, a page and, where there is one, the official submission."""
