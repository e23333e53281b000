"""One scene as a job: the message to a worker, the work there, and the outcome.

A job is a pure function of its input and its task's configuration: its results are the same bytes on any machine. Only
the driver writes to the output. An input that fails costs its own results alone.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Literal, Protocol

from data_tools.datasets.parts import Part
from pipelines.process import one_thread
from saga_fg.errors import SagaError
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
