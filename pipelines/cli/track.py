"""`saga-fg track`: detections in, tracks out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli import options
from pipelines.cli import tracking_options as how
from pipelines.cli.console import progress_bar
from pipelines.cli.datasets import Source, dataset_commands
from pipelines.cli.scaling import RayAddress, Workers, at_scale, exit_on_failures, run_at_scale
from pipelines.cli.summary import Summary, counted

if TYPE_CHECKING:
    from data_tools.datasets.source import DatasetSource


def _track(
    source: DatasetSource,
    output: Annotated[Path, typer.Option("--output", "-o")],
    method: how.MethodOption = "saga",
    estimator: how.EstimatorOption = None,
    lag: how.LagOption = None,
    association: how.AssociationOption = None,
    interactions: how.InteractionsOption = None,
    predict: how.PredictOption = None,
    explain: how.ExplainOption = False,
    learn_offsets: how.LearnOffsetsOption = None,
    workers: Workers = None,
    ray: RayAddress = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Track the detections of recordings."""
    from pipelines.config import load_config
    from pipelines.doubts import Doubted, Doubts
    from pipelines.explaining import trackers
    from pipelines.scale_out import TrackTask
    from pipelines.tracking import keep_predictions, track_dataset

    settings = how.configured(source.family, config, method, estimator, lag, association, interactions)
    options.apart(output, *source.input_files())
    how.check_learn_offsets(learn_offsets, method, at_scale(workers, ray))
    kept, horizons = how.journal(explain, output, at_scale(workers, ray)), how.horizons(predict, method)
    doubts = Doubts(settings.of_method(method), load_config(source.family), source.option_for)
    if at_scale(workers, ray):
        doubts.see_first(source)
        task = TrackTask(settings, method, source, horizons)
        report = run_at_scale(source, task, output, workers, ray, source.merged[0], source.merge_tracks)
        doubts.add(task.classes(report.counts))
        doubts.finish()
        exit_on_failures(report)
        return
    summary = Summary(output)
    with source.open() as dataset:
        scenes = dataset.scenes
        with progress_bar(len(scenes)) as progress, trackers(settings, method, scenes, kept) as new_tracker:
            looked_at = Doubted(dataset, doubts)
            runs = summary.of(track_dataset(looked_at, new_tracker, progress=progress, horizons=horizons))
            with keep_predictions(runs, output, horizons is not None) as kept_runs:
                source.write_tracks(output, dataset, ((run.scene, run.tracks) for run in kept_runs))
    summary.write_record(method, settings, source.kept())
    doubts.add(summary.classes)
    doubts.finish()
    summary.show()
    if learn_offsets is not None:
        how.write_offsets(
            learn_offsets, summary.clocks.values(), settings, f"{counted(summary.scenes, 'scene')}, {source.name}"
        )


_EXAMPLES = (
    "track {recordings} --output {tracks}",
    "track {recordings} --output {tracks} --method kf --config mine.yaml",
    "track {recordings} --output {tracks} --estimator fixed-lag --lag 3",
    "track {recordings} --output {tracks} --predict 1,2,3",
    "track {recordings} --output run --workers 0   # all cores; writes run/tracks/",
)


def _texts(source: Source) -> dict[str, str]:
    """Help of --output, which names a file unless scenes are processed in parallel."""
    is_file = bool(Path(source.tracks_example).suffix)
    return {"output": source.tracks + " With --workers or --ray: a folder." * is_file}


_commands = dataset_commands("track", _track, _EXAMPLES, _texts)
track_app = typer.Typer(cls=_commands, no_args_is_help=True, rich_markup_mode=None)


@track_app.callback()
def track() -> None:
    """Track recorded detections of a dataset."""
