"""`saga-fg track` and `saga-fg smooth`: detections in, tracks or labels out, in parallel if wanted."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, Literal

import numpy as np
import typer

from data_tools.datasets import (
    DatasetSource,
    GivenTracks,
    TrackedRecordings,
    check_classes,
    input_files,
    read_corrections,
    read_given_tracks,
    read_outcomes,
    tracked_parts,
)
from pipelines import smoothing
from pipelines.checks import CheckedDataset, Checks, options_of
from pipelines.cli import options
from pipelines.cli.console import counted, progress_bar
from pipelines.cli.options import ScaleOptions, Source, TrackerOptions, dataset_commands
from pipelines.config import TrackConfig, load_config
from pipelines.configuration import write_settings
from pipelines.explaining import journal_of, trackers
from pipelines.report.page import RunRecord, write_run_record
from pipelines.review import LabelRun
from pipelines.scale_out import RunSummary, SceneTask, SmoothTask, TrackTask, file_name, new_pool, run_scenes
from pipelines.tracking import TrackedScene, keep_predictions, track_dataset
from saga_fg import InputError
from saga_fg.smoothing import Correction, LabelCounts, unfit
from saga_fg.tracking import NO_TRACKS, SensorTime

FAILED_SCENES = 1  # exit code


def run_at_scale(
    source: DatasetSource,
    task: SceneTask,
    output: Path,
    scale: ScaleOptions,
    labels: bool = False,
    given: GivenTracks = (),
) -> RunSummary:
    """Do the task, which makes tracks or labels, with all parts of a dataset; print and return what became of them.

    What the parts left becomes the file `ResultFormat.merged`, if all have done it. given: tracks of other trackers,
    to be labelled
    """
    if output.suffix:
        raise InputError(f"--output {output}: expected the name of a folder, since scenes are done in parallel")

    def finish(report: RunSummary) -> None:
        if merged and not report.failed:
            source.written.merge(output, [file_name(name) for name in there.names], there.dataset, labels)

    merged = source.written.merged[labels]
    with source.parts() as parts, progress_bar(unit="scenes") as bar:
        there = tracked_parts(parts, given) if given else parts
        if merged:
            (output / merged).unlink(missing_ok=True)
        report = run_scenes(
            there.parts,
            len(there.names),
            task,
            output,
            lambda scratch: new_pool(scale.workers or 0, scale.ray, scratch),
            lambda _, done, of: bar("scenes", done, of),
            finish,
        )
    counts = "".join(f", {number} {noun}" for noun, number in report.counts.items())
    states = f"{len(report.done)} done, {len(report.unchanged)} unchanged, {len(report.failed)} failed"
    typer.echo(f"{output}: {counted(report.scenes, 'scene')}: {states}{counts}")
    return report


@dataclass
class Summary:
    """Counts the scenes that pass through it."""

    output: Path
    scenes: int = 0
    frames: int = 0
    boxes: int = 0
    detections: int = 0
    best_score: dict[tuple[str, int], float] = field(default_factory=dict)  # of each track, by scene and id
    milliseconds: dict[str, tuple[float, ...]] = field(default_factory=dict)
    classes: set[str] = field(default_factory=set)
    clocks: dict[str, Mapping[str, SensorTime]] = field(default_factory=dict)  # of the sensors, by scene
    noise: list[Mapping[str, float]] = field(default_factory=list)  # of the sensors, in each scene

    def counting(self, runs: Iterable[TrackedScene]) -> Iterator[TrackedScene]:
        """Pass runs on and count them."""
        for run in runs:
            self.scenes += 1
            self.frames += run.frames
            self.milliseconds[run.scene.name] = run.milliseconds
            if run.clocks:
                self.clocks[run.scene.name] = run.clocks
            self.noise.append(run.noise)
            self.boxes += sum(len(tracks) for tracks in run.tracks)
            self.detections += sum(len(frame.detections) for frame in run.scene.frames)
            for tracks in run.tracks:
                self.classes.update(tracks.boxes.label.tolist())
                for id_, score in zip(tracks.id.tolist(), tracks.score.tolist(), strict=True):
                    track = (run.scene.name, id_)
                    self.best_score[track] = max(score, self.best_score.get(track, score))
            yield run

    def write_record(self, method: str, settings: TrackConfig, recordings: Mapping[str, Any]) -> None:
        """Write the record of the run beside its result, for reports; recordings: `DatasetSource.kept`."""
        rounded = {name: [round(ms, 3) for ms in times] for name, times in self.milliseconds.items()}
        configuration = write_settings(settings, comments=False)
        write_run_record(
            self.output, RunRecord(method, configuration, rounded, recordings=recordings, clocks=self.clocks)
        )

    def show(self) -> None:
        """Print the line on stdout; a frame takes the median, which compilation does not move."""
        milliseconds = [ms for of_scene in self.milliseconds.values() for ms in of_scene]
        rate = f", {1e3 / np.median(milliseconds):.0f} frames/s" if milliseconds else ""
        sure = sum(score > 0.5 for score in self.best_score.values())
        tracks = f"{counted(len(self.best_score), 'track')} ({sure} with a score above 0.5)"
        counts = (counted(self.scenes, "scene"), counted(self.frames, "frame"), tracks, counted(self.boxes, "box"))
        typer.echo(f"{self.output}: {', '.join(counts)}{rate}")
        if self.detections and not self.boxes:
            typer.echo(NO_TRACKS.format(self.detections, "--settings dense, for own tables,"), err=True)
        _show_noise(self.noise)


def _show_noise(found: Sequence[Mapping[str, float]]) -> None:
    """A line for each sensor whose noise was found."""
    for name in dict.fromkeys(name for scene in found for name in scene):
        scale = np.median([scene[name] for scene in found if name in scene])
        typer.echo(
            f"noise of {name}: {scale:.2g} of what its model says, by its successive detections; ellipses are scaled, "
            "by class and range (sensors.*.calibrate_noise: false leaves them); saga-fg learn noise finds all of it"
        )


def exit_on_failures(report: RunSummary) -> None:
    """Name the scenes that failed, with their reasons, and end the command with an exit code if there are any."""
    for name, reason in report.failed.items():
        typer.echo(f"failed: {name}: {reason}", err=True)
    if report.failed:
        raise typer.Exit(FAILED_SCENES)


@dataclass(frozen=True)
class BesideOptions:
    """Predictions and a journal, kept beside the tracks."""

    predict: Annotated[
        str | None,
        typer.Option(
            "--predict",
            help="Predict the tracks of every moment to these s after it, and keep that beside the output: "
            "OUTPUT.predictions.csv, for `saga-fg report`.",
            metavar="S,S,...",
        ),
    ] = None
    explain: Annotated[
        bool,
        typer.Option(
            "--explain", help="Keep a journal beside the output, for `saga-fg explain`: OUTPUT.journal.jsonl."
        ),
    ] = False
    learn_offsets: options.LearnOffsetsOption = None


def _track(
    source: DatasetSource,
    output: Annotated[Path, typer.Option("--output", "-o")],
    tracker: TrackerOptions,
    beside: BesideOptions,
    scale: ScaleOptions,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Track the detections of recordings."""
    method = tracker.method
    family = options.family_of(source, config, method)
    settings = tracker.configured(family, config)
    options.apart(output, *input_files(source))
    options.check_learn_offsets(beside.learn_offsets, method, scale.wanted)
    if beside.explain and scale.wanted:
        raise InputError("--explain: goes without --workers and --ray")
    kept, horizons = journal_of(output) if beside.explain else None, options.horizons(beside.predict, method)
    checks = Checks(settings.of_method(method), load_config(family), options_of(source))
    if scale.wanted:
        checks.see_first(source)
        task = TrackTask(settings, method, source, horizons)
        report = run_at_scale(source, task, output, scale)
        checks.add(task.classes(report.counts))
        checks.finish()
        exit_on_failures(report)
        return
    summary = Summary(output)
    with source.open() as dataset:
        scenes = dataset.scenes
        with progress_bar(len(scenes)) as progress, trackers(settings, method, scenes, kept) as new_tracker:
            looked_at = CheckedDataset(dataset, checks)
            runs = summary.counting(track_dataset(looked_at, new_tracker, progress=progress, horizons=horizons))
            with keep_predictions(runs, output, horizons is not None) as kept_runs:
                source.written.write_tracks(output, dataset, ((run.scene, run.tracks) for run in kept_runs))
    summary.write_record(method, settings, source.kept())
    checks.add(summary.classes)
    checks.finish()
    summary.show()
    if beside.learn_offsets is not None:
        origin = f"{counted(summary.scenes, 'scene')}, {source.name}"
        options.write_offsets(beside.learn_offsets, summary.clocks.values(), settings, origin)


_TRACK_EXAMPLES = (
    "track {recordings} --output {tracks}",
    "track {recordings} --output {tracks} --method kf --config mine.yaml",
    "track {recordings} --output {tracks} --estimator fixed-lag --lag 3",
    "track {recordings} --output {tracks} --predict 1,2,3",
    "track {recordings} --output run --workers 0   # all cores; writes run/tracks/",
)


def _texts(source: Source) -> dict[str, str]:
    """Help of --output, which names a file unless scenes are processed in parallel."""
    is_file = bool(Path(source.written.tracks_example).suffix)
    return {"output": source.written.tracks + " With --workers or --ray: a folder." * is_file}


track_app = dataset_commands("track", "Track recorded detections of a dataset.", _track, _TRACK_EXAMPLES, _texts)


@dataclass(frozen=True)
class LabelOptions(options.MethodOptions):
    """How labels are made, and written."""

    tracks: Annotated[
        list[Path] | None,
        typer.Option(
            "--tracks",
            help="Result of a tracker, as `saga-fg evaluate` reads it, whose tracks are refined to labels, in place of "
            "detections or beside them; repeatable: several trackers become one result.",
            metavar="FILE",
        ),
    ] = None
    corrections: Annotated[
        Path | None,
        typer.Option("--corrections", help="A person's corrections, JSON lines, as factors.", metavar="FILE"),
    ] = None
    table: Annotated[
        Literal["csv", "ndjson", "parquet"],
        typer.Option("--table", help="Format of the table of boxes; parquet needs the extra [parquet]."),
    ] = "csv"


def _smooth(
    source: DatasetSource,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    labels: LabelOptions,
    scale: ScaleOptions,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Label recordings: a table of boxes, a summary, and the labels in the dataset's own format if it has one.

    Tables of detections are smoothed as they are read: memory does not grow with their length. With --tracks, the
    tracks of other trackers are refined: joined, cut, filled and smoothed.
    """
    method = labels.method
    family = options.family_of(source, config, method)
    settings = smoothing.load_smooth_config(family, config)
    settings = replace(settings, tracking=labels.over(settings.tracking))
    options.apart(output, *(labels.tracks or ()), *([labels.corrections] if labels.corrections else ()))
    corrections = read_corrections(labels.corrections) if labels.corrections else ()
    if labels.corrections and not corrections:
        typer.echo(f"{labels.corrections}: no corrections", err=True)
    check_classes(corrections, source.written.classes)
    given = read_given_tracks(source, labels.tracks or ())
    settings = smoothing.for_given_tracks(settings, given)
    record = LabelRun.of_command(source, method, settings, labels.tracks, labels.corrections).record
    usual = smoothing.load_smooth_config(family).tracking
    checks = Checks(settings.tracking.of_method(method), usual, options_of(source))
    if scale.wanted:
        checks.see_first(source)
        task = SmoothTask(settings, method, source, f".{labels.table}", corrections)
        report = run_at_scale(source, task, output, scale, labels=True, given=given)
        write_run_record(output, record)
        _show_unfit(corrections, read_outcomes(output / "corrections"))
        exit_on_failures(report)
        return
    stream, table = None if given else source.stream(), f".{labels.table}"
    if stream is not None:
        with stream as parts, progress_bar() as progress:
            done = smoothing.write_labels(
                output,
                lambda folder: smoothing.smooth_stream(
                    checks.over(parts), settings, folder, method, progress=progress, corrections=corrections
                ),
                table,
                record=record,
            )
    else:
        with source.open() as dataset, progress_bar(len(dataset.scenes)) as progress:
            recordings = TrackedRecordings(dataset, given) if given else dataset
            checked = CheckedDataset(recordings, checks)
            done = smoothing.write_labels(
                output,
                lambda _: smoothing.smooth_dataset(
                    checked, settings, method, progress=progress, corrections=corrections
                ),
                table,
                lambda folder, found: source.written.write_labels(folder, dataset, found),
                record,
            )
    _show_unfit(corrections, [(one.origin, why) for run in done for _, one, why in run.outcomes])
    _show(output, done)


def _show_unfit(corrections: Sequence[Correction], outcomes: Iterable[tuple[str, str]]) -> None:
    """A line for each correction that does not hold."""
    for line in unfit(corrections, outcomes):
        typer.echo(f"not applied: {line}", err=True)


_SMOOTH_EXAMPLES = (
    "smooth {recordings} --output labels",
    "smooth {recordings} --output labels --workers 0   # all cores",
    "smooth {recordings} --tracks theirs --output labels   # refines the tracks of another tracker",
    "smooth {recordings} --corrections mine.jsonl --output labels",
)
smooth_app = dataset_commands(
    "smooth",
    "Make labels of recorded detections: past and future of every object, gaps filled, uncertainty stated.",
    _smooth,
    _SMOOTH_EXAMPLES,
)


def _show(output: Path, runs: Sequence[smoothing.SmoothedScene]) -> None:
    """The lines that say what was done."""
    total = LabelCounts.sum(run.counts for run in runs)
    typer.echo(
        f"{output}: {counted(len(runs), 'scene')}, {counted(total.objects, 'object')}, {counted(total.boxes, 'box')}: "
        f"{total.observed} observed, {total.filled} filled, {total.extended} extended"
        f"{f', {total.corrected} corrected, {total.near} near these' * (total.corrected > 0)}; "
        f"{total.dropped} dropped with {counted(total.dropped_objects, 'object')}; "
        f"{counted(total.joined, 'tracklet')} joined to others"
    )
    worth = sum(len(run.review) for run in runs)
    listed = f"{output / 'review.csv'}: {counted(worth, 'object')} worth a look, the most worth first"
    typer.echo(f"{listed}: saga-fg review {quote(str(output))}")
    _show_noise([run.noise for run in runs])
