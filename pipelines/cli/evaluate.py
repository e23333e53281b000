"""`saga-fg evaluate` and `saga-fg benchmark`: how good are tracks and labels?"""

from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer

from data_tools.datasets import DatasetSource, DetectionFileSource, Innovations, Results, input_files, read_tracks
from data_tools.evaluation import LEGEND, Evaluation
from data_tools.figures import write_figures
from data_tools.files import write_text, write_zip
from pipelines.checks import CheckedDataset, Checks, options_of
from pipelines.cli import options
from pipelines.cli.console import JsonFile, MarkdownFile, progress_bar, report, show_summary, show_tables, working
from pipelines.cli.options import ScaleOptions, TrackerOptions, dataset_commands
from pipelines.cli.track import exit_on_failures, run_at_scale
from pipelines.config import Method, TrackConfig
from pipelines.report.page import RunRecord, report_page, result_report, write_run_record
from pipelines.scale_out import TrackTask
from pipelines.smoothing import evaluate_labels, load_smooth_config
from pipelines.tracking import InnovationRecorder, track_dataset
from saga_fg.errors import InputError


@dataclass(frozen=True)
class EvaluationOptions:
    """Which figures are made, and what they are written to."""

    hota: Annotated[bool, typer.Option("--hota", help="HOTA, CLEAR and Identity too (needs the extra [eval]).")] = False
    metric: Annotated[
        list[str] | None,
        typer.Option("--metric", help="Metric of your own: MODULE:NAME, or an installed entry point.", metavar="NAME"),
    ] = None
    full: Annotated[bool, typer.Option("--full", help="Print all tables, not the summary alone.")] = False
    json_file: JsonFile = None
    markdown: MarkdownFile = None


def _evaluate(
    source: DatasetSource,
    result: Annotated[
        Path | None,
        typer.Argument(help="Result of any tracker, as `saga-fg track` writes it; left out, one is made and scored."),
    ] = None,
    *,
    tracker: TrackerOptions,
    config: options.Config = None,
    shown: EvaluationOptions,
    verbose: options.Verbose = False,
) -> None:
    """Score tracks against the ground truth: by the dataset's official metrics or CLEAR, and by errors at the labels.

    The scenes scored are those of the result, or those that are named.
    Where detections are given and the metrics are official, errors are those at the labels that detections match.
    """
    _require_truth(source)
    if result is None:
        settings = tracker.configured(options.family_of(source, config, tracker.method), config)
        found, innovations = _tracked(source, settings, tracker.method)
    else:
        given = {name: value for name, value in vars(tracker).items() if value != getattr(TrackerOptions, name)}
        others = {"config": config, "settings": source.settings if isinstance(source, DetectionFileSource) else None}
        for name, value in (given | {name: value for name, value in others.items() if value is not None}).items():
            raise InputError(f"--{name} {value}: goes without a result, which is made by it")
        with working("reading"):
            found, innovations = source.read_results(result), {}
    with working("scoring"):
        evaluation = found.evaluate(shown.hota, innovations, shown.metric or ())
    summary = evaluation.summary()
    if summary is not None:
        show_summary(summary, LEGEND)
    tables = evaluation.tables()
    named = [table for table in tables if table.title in evaluation.own]
    report(tables if shown.full or summary is None else named, evaluation.figures(), shown.json_file)
    if shown.markdown is not None:
        write_text(shown.markdown, "\n".join(table.markdown() for table in (*([summary] if summary else ()), *tables)))


def _require_truth(source: DatasetSource) -> None:
    if not source.has_truth:
        own = f"name it: {source.truth_option} TABLE"
        mend = own if source.truth_option else "score a table: saga-fg evaluate file tracks.csv --truth TABLE"
        raise InputError(f"evaluate {source.name}: expected ground truth, there is none; {mend}")


def _tracked(source: DatasetSource, settings: TrackConfig, method: Method) -> tuple[Results, Innovations]:
    """Track all scenes, write the result and read it back; and the innovations of the tracker."""
    checks = Checks(settings.of_method(method), option_for=options_of(source))
    recorder = InnovationRecorder()
    with TemporaryDirectory() as folder, source.open() as dataset, progress_bar(len(dataset.scenes)) as progress:
        runs = track_dataset(
            CheckedDataset(dataset, checks), lambda: settings.new_tracker(method, recorder), progress=progress
        )
        result = Path(folder) / source.written.tracks_example
        source.written.write_tracks(result, dataset, ((run.scene, run.tracks) for run in runs))
        return source.restricted(dataset.scenes).read_results(result), recorder.by_class


def _evaluate_labels(
    source: DatasetSource,
    result: Annotated[Path, typer.Argument(help="Folder that `saga-fg smooth` wrote, or its table of boxes.")],
    method: options.MethodOption = "saga",
    config: options.Config = None,
    json_file: JsonFile = None,
    verbose: options.Verbose = False,
) -> None:
    """Judge labels beside the online tracks: MOTA, AMOTA, errors where something is detected, calibration.

    The scenes are those in the table. Where nobody has labelled, the columns p_exists, p_class, p_identity and
    p_heading of the labels, and review.csv, say how sure they are.
    """
    _require_truth(source)
    table = _table(result)
    rows = read_tracks(table, labels=True)
    scenes = np.unique(rows.scene).tolist()
    settings = load_smooth_config(options.family_of(source, config, method), config)
    chosen = source.restricted(scenes) if scenes else source
    with chosen.open(truth=True) as dataset, progress_bar(len(scenes)) as progress:
        found = evaluate_labels(rows, table, dataset, settings, method, progress)
    tables = [replace(table, title=f"{name}: {table.title}") for name, each in found.items() for table in each.tables()]
    report(tables, {name: each.figures() for name, each in found.items()}, json_file)


evaluate_app = dataset_commands(
    "evaluate",
    "Compare results with the ground truth.",
    _evaluate,
    (
        "evaluate {result}",
        "evaluate {result} --hota --json figures.json",
        "evaluate {recordings} --method kf",
    ),
    lambda source: {} if source.summarised else {"full": None},
    listed=lambda source: source.has_truth or bool(source.truth_option),
)
labels_app = dataset_commands(
    "evaluate labels",
    "Judge labels that `saga-fg smooth` made, beside the online tracks.",
    _evaluate_labels,
    ("evaluate labels {result}",),
    listed=lambda source: source.has_truth or bool(source.truth_option),
)
evaluate_app.add_typer(labels_app, name="labels")


def _table(result: Path) -> Path:
    """The table of labels in a folder, or the table itself."""
    if not result.exists():
        raise InputError(f"{result}: expected a folder that `saga-fg smooth` wrote, or its table, there is nothing")
    if not result.is_dir():
        return result
    found = [result / f"labels{suffix}" for suffix in (".csv", ".ndjson") if (result / f"labels{suffix}").is_file()]
    if not found:
        raise InputError(f"{result}: expected labels.csv or labels.ndjson in this folder")
    return found[0]


def _benchmark(
    source: DatasetSource,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the run; the same one again continues the run.")
    ],
    tracker: TrackerOptions,
    scale: ScaleOptions,
    hota: Annotated[bool, typer.Option("--hota", help="HOTA too (needs the extra [eval]).")] = False,
    without_truth: Annotated[
        bool, typer.Option("--without-truth", help="The submission alone, as for a test split without ground truth.")
    ] = False,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Track all scenes in parallel, score them, and write figures and a page; for nuScenes and KITTI a submission.

    The figures are the official ones of nuScenes and KITTI, and CLEAR of other datasets. The folder gets tracks/ with a
    result for each scene, all of them in one, figures.json, report.html, and for nuScenes and KITTI submission.zip for
    the official server. A scene that is done is not done again, unless its input, the settings or
    saga-fg have changed.
    """
    if not source.written.all_tracks:
        raise InputError(f"benchmark {source.name}: expected a dataset with official results: saga-fg benchmark --help")
    options.apart(output, *input_files(source))
    task = TrackTask(tracker.configured(source.family, config), tracker.method, source)
    run = run_at_scale(source, task, output, scale)
    exit_on_failures(run)
    with working("writing the submission"):
        files = sorted(output.glob(source.written.submission)) if source.written.submission else ()
        submission = write_zip(output / "submission.zip", files) if files else None
    if not without_truth:
        with working("scoring"):
            evaluation = _judged(source, output, tracker.method, task.configuration, hota)
        show_tables(list(evaluation.tables())[:1])
        typer.echo(f"{output / 'figures.json'}: all figures; {output / 'report.html'}: a page of them")
    if submission is not None:
        typer.echo(f"{submission}: for the official server")


SHOWN = 3  # scenes in the player: a page of them all would be too large


def _judged(source: DatasetSource, output: Path, method: str, configuration: str, hota: bool) -> Evaluation:
    """Score the tracks of all scenes of a run in a folder; figures.json and report.html appear in it.

    configuration: YAML of the run. Raises `InputError` for results that do not fit the ground truth.
    """
    result = output / source.written.all_tracks
    write_run_record(result, RunRecord(method, configuration, {}))
    found = source.read_results(result)
    evaluation, names = found.evaluate(hota), list(found.scenes)
    figures = {"method": method, "version": version("saga-fg"), "figures": evaluation.figures()}
    write_figures(output / "figures.json", figures)
    some = result_report(source.restricted(names[:SHOWN]), result)
    boxes = sum(len(each.found) for each in found.scenes.values())
    facts = [f"{len(names)} scenes, {boxes} boxes", f"saga-fg {version('saga-fg')}"]
    notes = [f"The player shows {SHOWN} of {len(names)} scenes."] if len(names) > SHOWN else []
    tables, charts = evaluation.tables(), evaluation.charts()
    page = replace(some, facts=facts, notes=[*notes, *some.notes], tables=tables, charts=charts)
    write_text(output / "report.html", report_page(page))
    return evaluation


benchmark_app = dataset_commands(
    "benchmark",
    "Get the figures of a whole dataset, with tracks, a page and, where there is one, the official submission.",
    _benchmark,
    (
        "benchmark {recordings} --output run   # stopped? the same again",
        "benchmark {recordings} --output baseline --method kf --workers 4",
        "benchmark {recordings} --output test --without-truth",
    ),
    lambda source: {"workers": "Process scenes in this many processes.  [default: one per core]"},
    listed=lambda source: bool(source.written.all_tracks),
)
