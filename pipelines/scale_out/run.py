"""Tracking and smoothing of many scenes in a pool of workers; results and manifest go to a folder.

A scene is skipped if the manifest has it as done with the same inputs, configuration and version, and its results are
unchanged. One run at a time may write to a folder.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Protocol

from data_tools.datasets.corrections import write_outcomes
from data_tools.datasets.detection_files import write_label_table, write_review
from data_tools.datasets.given_tracks import TrackedRecordings
from data_tools.datasets.source import DatasetSource, Part, part_suffix
from pipelines.config import Method, TrackConfig
from pipelines.configuration import write_settings
from pipelines.scale_out.pools import Job, Outcome, SceneTask
from pipelines.scale_out.results import Manifest, OutputFolder, Record, file_name, sha256
from pipelines.smoothing import SmoothConfig, smooth_dataset
from pipelines.tracking import TrackedScene, keep_predictions, track_dataset
from saga_fg import Dataset, InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.smoothing import LabelCounts
from saga_fg.smoothing.corrections import Correction

log = logging.getLogger(__name__)


class Pool(Protocol):
    """Workers that perform jobs: processes of this machine, or a cluster."""

    def outcomes(self, jobs: Iterator[Job], total: int) -> Iterator[Outcome]:
        """Yield the outcomes of all jobs as they come."""
        ...


@dataclass
class RunSummary:
    """Names of the scenes by status; reasons of the failed ones; counts over all results."""

    done: list[str] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.done) + len(self.unchanged) + len(self.failed)


def run_scenes(
    inputs: Iterable[Part],
    total: int,
    task: SceneTask,
    output: Path,
    new_pool: Callable[[Path], Pool],
    progress: Callable[[str, int, int], None] | None = None,
    finish: Callable[[RunSummary], None] | None = None,
) -> RunSummary:
    """Perform a task on every input, in any order; results in `output`, records in `output`/manifest.

    new_pool  makes the workers, given a folder for their temporary files
    progress  is called with the name of a scene that is finished, how many are, and `total`
    finish    is called at the end, while no other run may write to the folder

    Failed scenes are in the report and in the manifest; the others go on. Raises `InputError` for two inputs of one
    name, and if another run writes to the folder.
    """
    folder, report = OutputFolder(output), RunSummary()
    manifest = Manifest(folder)
    configuration, here = sha256(task.configuration.encode()), version("saga-fg")
    with folder.held():
        folder.remove_leftovers()
        scratch = folder.new_folder(".scratch")
        try:
            folder.write("configuration.yaml", task.configuration.encode())
            jobs = _jobs(inputs, task, manifest, configuration, here)
            for outcome in new_pool(scratch).outcomes(jobs, total):
                if outcome.status != "failed" and outcome.version != here:
                    reason = f"the worker has saga-fg {outcome.version}, expected {here}"
                    outcome = Outcome(outcome.name, "failed", outcome.digests, reason=reason)
                _count(report, outcome, manifest, configuration)
                if progress is not None:
                    progress(outcome.name, report.scenes, total)
        finally:
            folder.remove(".scratch")
        if finish is not None:
            finish(report)
    return report


def _jobs(inputs: Iterable[Part], task: SceneTask, manifest: Manifest, configuration: str, here: str) -> Iterator[Job]:
    names: set[str] = set()
    for scene in inputs:
        if scene.name in names:
            raise InputError(f"scene {scene.name}: expected a name of its own for every scene, it occurs again")
        names.add(scene.name)
        yield Job(scene, task, manifest.valid(scene.name, configuration, here))


def _count(report: RunSummary, outcome: Outcome, manifest: Manifest, configuration: str) -> None:
    """Write the results and the record of an outcome, and count it."""
    record: Record | None
    if outcome.status == "unchanged":
        report.unchanged.append(outcome.name)
        record = manifest.record(outcome.name)
    else:
        record = manifest.take(outcome, configuration)
        if outcome.status == "done":
            report.done.append(outcome.name)
        else:
            report.failed[outcome.name] = outcome.reason
            log.info("%s failed: %s", outcome.name, outcome.reason)
    for name, number in record.counts.items() if record is not None else ():
        report.counts[name] = report.counts.get(name, 0) + number


_OF_CLASS = "tracks of "


@dataclass(frozen=True)
class TrackTask:
    """Track the scenes of a part; results in tracks/, as the dataset writes them.

    horizons  (H,) s, to which the tracks of every moment are predicted; None for no predictions
    """

    settings: TrackConfig
    method: Method
    source: DatasetSource
    horizons: FloatArray | None = None

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        ahead = "" if self.horizons is None else f", predicted by {self.horizons.tolist()} s"
        head = f"# track, method {self.method}, results of {self.source.name} as {part_suffix(self.source)}{ahead}\n"
        head += _reading(self.source)
        return head + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the tracks; counts frames, boxes and tracks, these also by class."""
        counts = dict.fromkeys(("frames", "tracks", "boxes"), 0)
        tracked = track_dataset(dataset, lambda: self.settings.new_tracker(self.method), horizons=self.horizons)
        runs, part = _counted(tracked, counts), folder / "tracks" / f"{file_name(name)}{part_suffix(self.source)}"
        part.parent.mkdir()
        with keep_predictions(runs, part, self.horizons is not None) as kept:
            self.source.written.write_track_part(part, dataset, ((run.scene, run.tracks) for run in kept))
        return counts

    @staticmethod
    def classes(counts: Mapping[str, int]) -> tuple[str, ...]:
        """The classes of the tracks that were counted."""
        return tuple(name.removeprefix(_OF_CLASS) for name in counts if name.startswith(_OF_CLASS))


@dataclass(frozen=True)
class SmoothTask:
    """Label the scenes of a part: labels/NAME with a suffix .csv, .ndjson or .parquet, review/NAME.csv, and what
    the dataset writes."""

    settings: SmoothConfig
    method: Method
    source: DatasetSource
    suffix: str = ".csv"
    corrections: Sequence[Correction] = ()

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        head = f"# smooth, method {self.method}, results of {self.source.name}, table as {self.suffix}\n"
        head += "".join(f"# corrected: {one!r}\n" for one in self.corrections)
        head += _reading(self.source)
        return head + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the labels; counts objects, and boxes by where they come from."""
        runs = tuple(smooth_dataset(dataset, self.settings, self.method, corrections=self.corrections))
        labels = [part for run in runs for part in run.parts]
        (folder / "labels").mkdir()
        write_label_table(folder / "labels" / f"{file_name(name)}{self.suffix}", labels)
        (folder / "review").mkdir()
        write_review(folder / "review" / f"{file_name(name)}.csv", {run.name: run.review for run in runs})
        if outcomes := [outcome for run in runs for outcome in run.outcomes]:
            (folder / "corrections").mkdir()
            write_outcomes(folder / "corrections" / f"{file_name(name)}.csv", outcomes)
        recordings = dataset.recordings if isinstance(dataset, TrackedRecordings) else dataset
        self.source.written.write_labels(folder, recordings, labels, file_name(name))
        return asdict(LabelCounts.sum(run.counts for run in runs))


def _reading(source: DatasetSource) -> str:
    """Options of reading recordings, as a comment; empty where recordings need none."""
    kept = source.kept()
    return f"# recordings read with {json.dumps(kept, sort_keys=True)}\n" if kept else ""


def _counted(runs: Iterable[TrackedScene], counts: dict[str, int]) -> Iterator[TrackedScene]:
    for run in runs:
        counts["frames"] += run.frames
        label_of = {
            id_: c
            for tracks in run.tracks
            for id_, c in zip(tracks.id.tolist(), tracks.boxes.label.tolist(), strict=True)
        }
        counts["tracks"] += len(label_of)
        for label, number in sorted(Counter(label_of.values()).items()):
            counts[_OF_CLASS + label] = counts.get(_OF_CLASS + label, 0) + number
        counts["boxes"] += sum(len(tracks) for tracks in run.tracks)
        yield run
