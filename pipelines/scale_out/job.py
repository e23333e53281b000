"""One scene as a job, and the manifest of what was done.

One scene as a job: the message to a worker, the work there, and the outcome.

A job is a pure function of its input and its task's configuration: its results are the same bytes on any machine. Only
the driver writes to the output. An input that fails costs its own results alone.

The manifest of a run: one JSON file a scene, `manifest/NAME.json`, with the origin of its results.

    {"scene": "scene-0001", "status": "done", "reason": "", "inputs": {"lidar": SHA256, ...}, "configuration": SHA256,
     "version": "0.1.0", "results": {"tracks/scene-0001.json": SHA256, ...}, "counts": {"tracks": 31, ...},
     "seconds": 1.25}

A record is written, whole or not at all, after the results it names; results without a valid record are those of a
killed run, and are made anew. Letters that file names cannot have are written as in URLs (%2F).

Results that a record no longer names are removed when its scene is done again. So that a forged record removes nothing
else, it may only name files of its own scene: `NAME.SUFFIX` in any folder, or what is below `FOLDER/NAME/`.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Literal, Protocol
from urllib.parse import quote

from data_tools.datasets.source import Part
from data_tools.files.readers import parsed_json
from pipelines.scale_out.folder import OutputFolder, is_inside
from pipelines.tracking import one_thread
from saga_fg.errors import InputError, SagaError
from saga_fg.types.dataset import Dataset

Status = Literal["done", "unchanged", "failed"]


class SceneTask(Protocol):
    """The work on every scene. Picklable."""

    @property
    def configuration(self) -> str:
        """YAML text of everything, besides the input, that the results depend on."""
        ...

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the results of input `name` to files in an empty folder; returns counts for people to read."""
        ...


@dataclass(frozen=True, eq=False)
class Job:
    """input; task; known: the digests for which results are there already, None if all is to be done anew."""

    input: Part
    task: SceneTask
    known: Mapping[str, str] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a job.

    digests  of the input's parts, by name
    files    content of every result by its path relative to the output
    seconds  from opening the input to the last result
    reason   one line, for failed jobs
    version  of saga-fg at the worker
    """

    name: str
    status: Status
    digests: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    reason: str = ""
    version: str = ""


def perform(job: Job) -> Outcome:
    """Perform a job; an exception becomes a failed outcome.

    Linear algebra is kept to one thread: scenes run in parallel, and sums stay in one order.
    """
    name, digests, start = job.input.name, dict[str, str](), time.perf_counter()
    here = version("saga-fg")
    try:
        with one_thread(), tempfile.TemporaryDirectory() as folder, job.input.opened() as at:
            digests = dict(at.digests)
            if digests == job.known:
                return Outcome(name, "unchanged", digests, version=here)
            counts = job.task.run(name, at.read(), Path(folder))
            files = {
                path.relative_to(folder).as_posix(): path.read_bytes()
                for path in sorted(Path(folder).rglob("*"))
                if path.is_file()
            }
    except SagaError as error:
        return Outcome(name, "failed", digests, seconds=time.perf_counter() - start, reason=str(error), version=here)
    except Exception as error:
        reason = f"{_last_frame(error)}{type(error).__name__}: {error}".strip()
        return Outcome(name, "failed", digests, seconds=time.perf_counter() - start, reason=reason, version=here)
    return Outcome(name, "done", digests, files, counts, time.perf_counter() - start, version=here)


def sha256(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def _last_frame(error: Exception) -> str:
    """Return the place where an unexpected exception was raised: `file.py:12: `."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}: " if frames else ""


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
