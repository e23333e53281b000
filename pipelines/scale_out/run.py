"""Tracking and smoothing of many scenes in a pool of workers; the folder of results and its manifest.

The manifest has a JSON file a scene, `manifest/NAME.json`, with the origin of its results.

    {"scene": "scene-0001", "status": "done", "reason": "", "inputs": {"lidar": SHA256, ...}, "configuration": SHA256,
     "version": "0.1.0", "results": {"tracks/scene-0001.json": SHA256, ...}, "counts": {"tracks": 31, ...},
     "seconds": 1.25}

A record is written, whole or not at all, after the results it names; results without a valid record are those of a
killed run, and are made anew. Letters that file names cannot have are written as in URLs (%2F).

Results that a record no longer names are removed when its scene is done again. So that a forged record removes nothing
else, it may only name files of its own scene: `NAME.SUFFIX` in any folder, or what is below `FOLDER/NAME/`. For the
same reason nothing is read, written or removed through a link that somebody has planted in the folder, which may be one
itself: the user names it.

A scene is skipped if the manifest has it as done with the same inputs, configuration and version, and its results are
unchanged. One run at a time may write to a folder.
"""

import errno
import fcntl
import hashlib
import json
import logging
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Protocol
from urllib.parse import quote

from data_tools.datasets import DatasetSource, Part, TrackedRecordings, write_label_table, write_outcomes, write_review
from data_tools.files import parsed_json, remove_leftovers, write_bytes
from pipelines.config import Method, TrackConfig
from pipelines.configuration import write_settings
from pipelines.scale_out.pools import Job, Outcome, SceneTask
from pipelines.smoothing import SmoothConfig, smooth_dataset
from pipelines.tracking import TrackedScene, keep_predictions, track_dataset
from saga_fg import Dataset
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray
from saga_fg.smoothing import Correction, LabelCounts


class OutputFolder:
    """Files by their names relative to a folder, with `/` between the parts of a name."""

    def __init__(self, path: Path) -> None:
        """Make the folder where it is missing. Raises `InputError` where that is not possible."""
        self.path = path
        with self._writing(""):
            path.mkdir(parents=True, exist_ok=True)
            self._root = path.resolve()

    def read(self, name: str) -> bytes | None:
        """The content of a regular file; None where there is none, or where a link is on the way."""
        with suppress(OSError):
            path = self._at(name)
            if _is_regular(path):
                return path.read_bytes()
        return None

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all. Raises `InputError` where that is not possible without following links."""
        with self._writing(name):
            path = self._at(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            if not _is_regular(path):  # a link or a pipe is replaced
                path.unlink(missing_ok=True)
            write_bytes(path, content)

    def remove(self, name: str) -> None:
        """Remove a file, a link, or a folder with its content, if there is one."""
        with suppress(OSError):
            path = self._at(name)
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()

    def new_folder(self, name: str) -> Path:
        """Make an empty folder in place of anything of its name. Raises `InputError` where that is not possible."""
        self.remove(name)
        with self._writing(name):
            self._at(name).mkdir()
        return self.path / name

    def remove_leftovers(self) -> None:
        """Remove temporary files of killed runs, here, in folders below, and of this folder itself."""
        remove_leftovers(self._root.parent, self._root.name)
        for folder, _, _ in os.walk(self._root):
            remove_leftovers(folder)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder for the block; the system lets go of it when the process ends, however it does.

        Raises `InputError` if another process holds it.
        """
        with self._writing(".lock"):
            lock = os.open(self._at(".lock"), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InputError(f"{self.path}: another run is writing to this folder") from error
            yield
        finally:
            os.close(lock)

    def _at(self, name: str) -> Path:
        """Path of a file. Raises `OSError` where a link is on the way."""
        path = self._root / name
        if path.parent.resolve() != path.parent:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        return path

    @contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = "expected no link on the way" if name and error.errno == errno.ELOOP else error.strerror
            where = self.path / name
            raise InputError(f"{where}: not writable: {reason}; expected a folder for the results") from error


def _is_regular(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def is_inside(name: object) -> bool:
    """Return True for the name of a file below a folder: relative, and without `..`."""
    if not isinstance(name, str) or "\0" in name:
        return False
    path = PurePosixPath(name)
    return str(path) == name and not path.is_absolute() and ".." not in path.parts and name != "."


def sha256(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


OF_THE_RUN = ("manifest", ".lock", ".scratch", "configuration.yaml")  # and of no scene


@dataclass(frozen=True)
class Record:
    """A line of the manifest; all hashes are SHA-256.

    inputs         of each part of the scene's input
    configuration  of the text of everything else that the results depend on
    results        of every file, by its path relative to the output
    """

    scene: str
    status: str
    reason: str
    inputs: Mapping[str, str]
    configuration: str
    version: str
    results: Mapping[str, str]
    counts: Mapping[str, int]
    seconds: float


def file_name(scene: str) -> str:
    """A scene's name as a file may have it."""
    return quote(scene, safe=" ()+,;=@[]{}!#$&'^~")


class Manifest:
    """The records and results in a folder."""

    def __init__(self, output: OutputFolder) -> None:
        self._output = output

    def record(self, scene: str) -> Record | None:
        """Return the record of a scene; None without one, or for an invalid one."""
        try:
            raw = parsed_json(self._output.read(_path(scene)) or b"", scene)
            record = Record(**{field.name: raw[field.name] for field in fields(Record)})
            texts = {**record.inputs, **record.results}.values()
            sound = (
                record.scene == scene
                and all(_belongs(name, scene) for name in record.results)
                and all(isinstance(text, str) for text in texts)
                and all(type(count) is int for count in record.counts.values())
            )
        except (InputError, KeyError, TypeError, AttributeError):
            return None
        return record if sound else None

    def valid(self, scene: str, configuration: str, version: str) -> Mapping[str, str] | None:
        """Return the hashes of the inputs whose results are complete and unchanged; None without such results."""
        record = self.record(scene)
        if record is None or (record.status, record.configuration, record.version) != ("done", configuration, version):
            return None
        for name, expected in record.results.items():
            content = self._output.read(name)
            if content is None or sha256(content) != expected:
                return None
        return record.inputs

    def take(self, outcome: Outcome, configuration: str) -> Record:
        """Write the results of a job that was done or failed, then its record."""
        before = self.record(outcome.name)
        for name in before.results if before is not None else ():
            if name not in outcome.files:
                self._output.remove(name)
        for name, content in outcome.files.items():
            self._output.write(name, content)
        record = Record(
            scene=outcome.name,
            status=outcome.status,
            reason=outcome.reason,
            inputs=outcome.digests,
            configuration=configuration,
            version=outcome.version,
            results={name: sha256(content) for name, content in outcome.files.items()},
            counts=outcome.counts,
            seconds=round(outcome.seconds, 3),
        )
        text = json.dumps(asdict(record), indent=1, ensure_ascii=False) + "\n"
        self._output.write(_path(outcome.name), text.encode())
        return record


def _belongs(name: object, scene: str) -> bool:
    """Return True for the name of a result of a scene, which contains the scene's name."""
    if not isinstance(name, str) or not is_inside(name):
        return False
    *folders, last = name.split("/")
    own = file_name(scene)
    return (folders or [last])[0] not in OF_THE_RUN and (PurePosixPath(last).stem == own or own in folders[1:])


def _path(scene: str) -> str:
    return f"manifest/{file_name(scene)}.json"


log = logging.getLogger(__name__)


class Pool(Protocol):
    """Workers that perform jobs: processes of this machine, or a cluster."""

    def outcomes(self, jobs: Iterator[Job], total: int) -> Iterator[Outcome]:
        """Yield the outcomes of all jobs as they come."""


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
    def suffix(self) -> str:
        """That of the result of a part."""
        return Path(self.source.written.tracks_example).suffix or ".csv"

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        ahead = "" if self.horizons is None else f", predicted by {self.horizons.tolist()} s"
        head = f"# track, method {self.method}, results of {self.source.name} as {self.suffix}{ahead}\n"
        head += _reading(self.source)
        return head + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the tracks; counts frames, boxes and tracks, these also by class."""
        counts = dict.fromkeys(("frames", "tracks", "boxes"), 0)
        tracked = track_dataset(dataset, lambda: self.settings.new_tracker(self.method), horizons=self.horizons)
        runs, part = _counted(tracked, counts), folder / "tracks" / f"{file_name(name)}{self.suffix}"
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
