"""Labels of recordings: configuration, smoothing, and the folder that is written.

Several trackers of one recording mostly saw the same detections: their errors are one error. So each has the variance
of n sensors, and together they tell as much as one.

Scores of which all lie in [0, 1] are probabilities, whatever the detector's scores are: trackers turn them into such.

Labels of a recording at hand are kept in memory; those of one that streams by wait on disk, chunk by chunk
(`saga_fg.smoothing.recording`).

A folder of labels has

labels.csv       a row per box (or .ndjson, .parquet)
review.csv       a row per object worth a look, those first that are most worth it
corrections.csv  what became of corrections, where there are some
run.json         record of the run, for reviews
summary.json     how many boxes of each scene were observed, filled, extended and dropped
tracking.json    nuScenes: the official tracking result
VERSION/         nuScenes: tables whose annotations are the labels
label_02/        KITTI: text as of ground truth
results/         KITTI: the same with scores, as evaluators take it
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from data_tools.datasets import (
    GivenTracks,
    Outcomes,
    TrackRows,
    sensor_names,
    table_results,
    write_label_table,
    write_outcomes,
    write_review,
)
from data_tools.evaluation import Evaluation, evaluate_tracks
from data_tools.figures import write_figures
from data_tools.files import atomic_directory
from data_tools.metrics import SceneBoxes
from pipelines.config import Method, TrackConfig, load_config, shipped_settings
from pipelines.configuration import load_settings, read_settings
from pipelines.report.page import RunRecord, write_run_record
from pipelines.tracking import Progress, one_thread, scene_with_frames, track_scene
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model import ScoreCalibration, Sensor, sensor_model
from saga_fg.settings import settings_group
from saga_fg.smoothing import (
    ChunkSettings,
    Correction,
    LabelBuilder,
    LabelCounts,
    LabelModel,
    Labels,
    RecordingLabels,
    Review,
    SmoothingSettings,
    corrections_in,
)
from saga_fg.types import DEFAULT, Dataset, Scene, Tracks


@dataclass(frozen=True)
class SmoothConfig:
    """Configuration of labels: the online pass in `tracking`, the rest in `smoothing`."""

    tracking: TrackConfig = settings_group(TrackConfig, "online pass: trackers and sensors")
    sensors: Mapping[str, Sensor] = settings_group(
        lambda: {DEFAULT: Sensor()},
        "models of the sensors offline, with noise as measured, without margin for association",
    )
    smoothing: SmoothingSettings = settings_group(SmoothingSettings, "smoothing of its tracks to labels")


def load_smooth_config(family: str | Path, path: Path | None = None) -> SmoothConfig:
    """The defaults shipped for a kind of data, with what a YAML file overrides; kinds are those of `load_config`.

    Raises `InputError` for a kind that has none, and naming the file and the dotted key of what is wrong in it.
    """
    shipped = shipped_settings("file" if isinstance(family, Path) else family, "smoothing")
    tracking = load_config(family)
    config = SmoothConfig(tracking=tracking, sensors=tracking.sensors)
    config = read_settings(SmoothConfig, shipped.read_text(encoding="utf-8"), shipped.name, config)
    return config if path is None else load_settings(SmoothConfig, path, config)


def for_given_tracks(config: SmoothConfig, results: GivenTracks) -> SmoothConfig:
    """The configuration with a model of each tracker, from the sensor's that it names for all others."""
    scores = [np.concatenate([each.found.score for each in result.values()]) for result in results]
    together = max((sum(name in result for result in results) for one in results for name in one), default=1)
    probable = [bool(((score >= 0) & (score <= 1)).all()) for score in scores]

    def models(sensors: Mapping[str, Sensor]) -> dict[str, Sensor]:
        named = zip(sensor_names(len(results)), probable, strict=True)
        usual = {name: _tracker(sensor_model(sensors, name), sure, together) for name, sure in named}
        return {**usual, **sensors}

    tracking = replace(config.tracking, sensors=models(config.tracking.sensors))
    return replace(config, tracking=tracking, sensors=models(config.sensors))


def _tracker(sensor: Sensor, probable: bool, count: int) -> Sensor:
    """A tracker of `count`; probable: its scores are probabilities."""
    scale = float(np.sqrt(count))
    noise = {
        label: replace(
            model,
            position=scale * model.position,
            range_noise=scale * model.range_noise,
            bearing_noise=scale * model.bearing_noise,
        )
        for label, model in sensor.noise.items()
    }
    sensor = replace(sensor, noise=noise)
    if probable and sensor.score == "logit":
        sensor = replace(sensor, score="probability", calibration={DEFAULT: ScoreCalibration()})
    return sensor


LabelledParts = Iterable[tuple[Scene, tuple[Labels, ...]]]
"""Parts of a recording, with the labels of each of their timestamps."""


@dataclass(frozen=True, eq=False)
class SmoothedScene:
    """A recording that was smoothed.

    parts    its parts, and their labels; they may be read again and again
    review   its objects, those first that are most worth a look
    counts   where its boxes come from
    frames   frames taken in
    seconds  time spent
    noise    scale of each sensor's noise, by name, estimated from its detections; 1 is its noise model
    outcomes what became of the corrections that may be about it
    """

    name: str
    parts: LabelledParts
    review: Review
    counts: LabelCounts
    frames: int
    seconds: float
    noise: Mapping[str, float]
    outcomes: Outcomes = ()

    @property
    def labels(self) -> tuple[Labels, ...]:
        """The labels of all timestamps, in memory."""
        return tuple(moment for _, part in self.parts for moment in part)

    @property
    def tracks(self) -> tuple[Tracks, ...]:
        """The labels as tracks."""
        return tuple(moment.tracks for moment in self.labels)


def smooth_scene(
    scene: Scene,
    config: SmoothConfig,
    method: Method = "saga",
    progress: Progress | None = None,
    providers: Sequence[FactorProvider] = (),
    corrections: Sequence[Correction] = (),
) -> SmoothedScene:
    """Smooth one recording at once, with the edges of the tracker's settings unless `method` is another than `saga`.

    providers: of factors of your own, in place of those that the configuration names; corrections: those of other
    scenes are left out
    """
    model = label_model(config, method, corrections_in(scene.name, corrections), providers)
    builder = LabelBuilder(config.tracking.new_tracker(method), model)
    run = _labelled(scene.name, [scene], builder, progress)
    return replace(run, parts=((scene, run.labels),))


def smooth_dataset(
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    scenes: Iterable[str] | None = None,
    progress: Progress | None = None,
    corrections: Sequence[Correction] = (),
) -> Iterator[SmoothedScene]:
    """Smooth some recordings (default: all), one at a time as they are asked for."""
    for name in dataset.scenes if scenes is None else scenes:
        yield smooth_scene(scene_with_frames(dataset, name), config, method, progress, corrections=corrections)


def smooth_stream(
    parts: Iterable[Scene],
    config: SmoothConfig,
    folder: Path,
    method: Method = "saga",
    chunks: ChunkSettings | None = None,
    progress: Progress | None = None,
    corrections: Sequence[Correction] = (),
) -> Iterator[SmoothedScene]:
    """Smooth recordings that come in parts: successive scenes of the same name, each beginning after the one before.

    folder: where labels wait on disk; it must outlive the scenes. The frames of a part are of its timestamps. Raises
    `InputError` for what the parts are refused for.
    """
    for number, (name, scene) in enumerate(groupby(parts, key=lambda part: part.name)):
        model = label_model(config, method, corrections_in(name, corrections))
        waiting = StoredParts(folder / f"{number:06d}")
        builder = LabelBuilder(config.tracking.new_tracker(method), model, chunks or ChunkSettings(), waiting)
        yield _labelled(name, scene, builder, progress)


class StoredParts:
    """Named arrays in files of a new folder, in the order they were added."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder, self._count = folder, 0

    def append(self, part: Mapping[str, Any], /) -> None:
        """Write a file."""
        np.savez(self._folder / f"{self._count:06d}.npz", **part)
        self._count += 1

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        for number in range(self._count):
            with np.load(self._folder / f"{number:06d}.npz", allow_pickle=False) as file:
                yield dict(file)


def label_model(
    config: SmoothConfig,
    method: Method,
    corrections: Sequence[Correction] = (),
    providers: Sequence[FactorProvider] = (),
) -> LabelModel:
    """Return everything that determines the labels of a recording."""
    tracker = config.tracking.of_method(method).tracker
    return LabelModel(tracker, config.sensors, config.smoothing, providers, corrections)


def _labelled(name: str, parts: Iterable[Scene], builder: LabelBuilder, progress: Progress | None) -> SmoothedScene:
    """Take in everything."""
    frames, seconds = 0, 0.0

    def advance(done: int) -> None:
        if progress is not None:
            progress(name, done, frames)

    for part in parts:
        frames += len(part.frames)
        begin = time.perf_counter()
        with one_thread():
            builder.add(part.frames, part.timestamps, advance)
        seconds += time.perf_counter() - begin
    begin = time.perf_counter()
    with one_thread():
        labels, counts = builder.finish(advance)
    seconds += time.perf_counter() - begin
    outcomes = tuple((name, one, why) for one, why in builder.outcomes)
    return SmoothedScene(
        name, _Spooled(name, labels), labels.review(), counts, frames, seconds, builder.noise, outcomes
    )


@dataclass(frozen=True, eq=False)
class _Spooled:
    """The labels of a recording, each chunk with a part of the scene without frames or poses."""

    name: str
    labels: RecordingLabels

    def __iter__(self) -> Iterator[tuple[Scene, tuple[Labels, ...]]]:
        for part in self.labels:
            times = np.array([moment.tracks.timestamp for moment in part])
            yield Scene(self.name, times), part


_TABLES = ("labels.csv", "labels.ndjson", "labels.parquet", "review.csv", "corrections.csv", "summary.json", "run.json")


def write_labels(
    directory: str | Path,
    smooth: Callable[[Path], Iterable[SmoothedScene]],
    suffix: str = ".csv",
    write_others: Callable[[Path, Sequence[tuple[Scene, Sequence[Labels]]]], None] | None = None,
    record: RunRecord | None = None,
) -> tuple[SmoothedScene, ...]:
    """Write the table of boxes and the summary; the folder is checked before the first recording is smoothed.

    smooth        makes the labels; it is called with a folder where they may wait (`smooth_stream`)
    write_others  adds the labels of all scenes in another format to the folder
    record        of the run
    """
    with atomic_directory(directory, known=_TABLES) as folder, TemporaryDirectory(dir=folder) as spools:
        done = tuple(smooth(Path(spools)))
        write_label_table(folder / f"labels{suffix}", chain.from_iterable(run.parts for run in done))
        if record is not None:
            write_run_record(folder, record)
        write_review(folder / "review.csv", {run.name: run.review for run in done})
        if outcomes := [outcome for run in done for outcome in run.outcomes]:
            write_outcomes(folder / "corrections.csv", outcomes)
        total = LabelCounts.sum(run.counts for run in done)
        scenes = {run.name: {**asdict(run.counts), "seconds": round(run.seconds, 3)} for run in done}
        write_figures(folder / "summary.json", {"total": asdict(total), "scenes": scenes})
        if write_others is not None:
            write_others(folder, [part for run in done for part in run.parts])
    return done


def evaluate_labels(
    rows: TrackRows,
    table: Path,
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    progress: Progress | None = None,
) -> dict[str, Evaluation]:
    """Judge labels, and online tracks that are made anew as `config` says, by the dataset they were made of.

    rows   of the table of labels, whose scenes are judged; table: its file, for errors

    Errors are those at the true objects that a detection matches. Of the table, the moments nearest to the ground truth
    count. Raises `InputError` for an empty table, and for scenes and moments that the dataset does not have, or without
    ground truth.
    """
    if not len(rows.source):
        raise InputError(f"{table}: expected labels, there are none")
    online, labels = [], []
    for name, found in table_results(rows, table, dataset, judged=True).items():
        scene = found.scene
        if scene.ground_truth is None:
            raise InputError(f"scene {name}: expected ground truth, there is none")
        tracked = track_scene(scene, config.tracking.new_tracker(method), progress)
        online.append((scene, SceneBoxes.of_tracks(tracked.tracks)))
        labels.append((scene, found.found))
    systems = {"online": online, "labels": labels}
    return {name: evaluate_tracks(each, sweep=True, detected=True) for name, each in systems.items()}
