"""Scenes as jobs, done by pools of workers: processes of this machine, or tasks on a Ray cluster.

A job is a pure function of its input and its task's configuration: its results are the same bytes on any machine. Only
the driver writes to the output. An input that fails costs its own results alone.

On this machine every worker has a pipe of its own and does one job at a time, so that one which is killed (the system
is out of memory, say) takes down the job it was doing and nothing else; `concurrent.futures` gives up all jobs then.
That job is tried once more in a new worker, and failed if it ends that one, too. Workers end with the driver, however
it ends: their pipe closes.

On a Ray cluster (https://docs.ray.io) a job is a task, placed, moved and retried by Ray. Nodes need this package in the
same version. Inputs that are read by the driver travel with their job; those that are read by the worker (files) must
be reachable from every node under the same name. Results travel back to the driver. Kernels are compiled once a node.
"""

from __future__ import annotations

import fcntl
import logging
import multiprocessing
import os
import signal
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, Protocol

from data_tools.datasets.source import Part
from pipelines.tracking import one_thread
from saga_fg import Dataset, InputError, SagaError
from saga_fg.errors import require_extra
from saga_fg.kernels.compilation import load_kernels

Status = Literal["done", "unchanged", "failed"]


class SceneTask(Protocol):
    """The work on every scene. Picklable."""

    @property
    def configuration(self) -> str:
        """YAML text of everything, besides the input, that the results depend on."""

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the results of input `name` to files in an empty folder; returns counts for people to read."""


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
    except Exception as error:
        reason = str(error)
        if not isinstance(error, SagaError):
            reason = f"{_last_frame(error)}{type(error).__name__}: {error}".strip()
        return Outcome(name, "failed", digests, seconds=time.perf_counter() - start, reason=reason, version=here)
    return Outcome(name, "done", digests, files, counts, time.perf_counter() - start, version=here)


def _last_frame(error: Exception) -> str:
    """Return the place where an unexpected exception was raised: `file.py:12: `."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}: " if frames else ""


ATTEMPTS = 2


@dataclass(frozen=True)
class LocalPool:
    """workers: number of processes (0: one a core); scratch: folder for their temporary files, None: the system's."""

    workers: int = 0
    scratch: Path | None = None

    def outcomes(self, jobs: Iterator[Job], total: int) -> Iterator[Outcome]:
        """Yield the outcomes of `total` jobs as they come; no more jobs are taken than there are idle workers."""
        count = min(self.workers or os.cpu_count() or 1, total)
        load_kernels()  # compiled once, not by each worker
        idle = [_Worker(self.scratch) for _ in range(count)]
        busy: dict[Connection, _Worker] = {}
        try:
            while True:
                while idle and (job := next(jobs, None)) is not None:
                    worker = idle.pop(0)
                    worker.begin(job)
                    busy[worker.pipe] = worker
                if not busy:
                    return
                for pipe in wait(list(busy)):
                    assert isinstance(pipe, Connection)
                    worker = busy.pop(pipe)
                    outcome = worker.outcome()
                    if outcome is not None:
                        yield outcome
                        idle.append(worker)
                        continue
                    job, attempts = worker.job, worker.attempts
                    fresh = _Worker(self.scratch)
                    if attempts < ATTEMPTS:
                        fresh.begin(job, attempts + 1)
                        busy[fresh.pipe] = fresh
                    else:
                        idle.append(fresh)
                        reason = f"the worker process ended {attempts} times ({worker.ending})"
                        yield Outcome(job.input.name, "failed", reason=reason)
        finally:
            for worker in (*idle, *busy.values()):
                worker.end()


def new_pool(workers: int, address: str | None, scratch: Path) -> LocalPool | RayPool:
    """Workers on a Ray cluster at an address, on this machine without one; `scratch`: for their temporary files."""
    return LocalPool(workers, scratch) if address is None else RayPool(address, workers)


class _Worker:
    """A process and the pipe to it."""

    job: Job
    attempts = 0

    def __init__(self, scratch: Path | None) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy locks that other threads hold
        self.pipe, far = context.Pipe()
        self._process = context.Process(target=_serve, args=(far, scratch), daemon=True)
        self._process.start()
        far.close()

    def begin(self, job: Job, attempt: int = 1) -> None:
        self.job, self.attempts = job, attempt
        try:
            self.pipe.send(job)
        except ConnectionError:  # it has ended already, as `outcome` will find
            return

    def outcome(self) -> Outcome | None:
        """Return the outcome of the job begun; None if the process has ended without one."""
        try:
            outcome = self.pipe.recv()
        except (EOFError, ConnectionError):
            self.end()
            return None
        assert isinstance(outcome, Outcome)
        return outcome

    @property
    def ending(self) -> str:
        """Signal or exit code by which the process ended."""
        code = self._process.exitcode or 0
        return f"signal {-code}, {signal.strsignal(-code)}" if code < 0 else f"exit code {code}"

    def end(self) -> None:
        self.pipe.close()
        self._process.join(0.2)  # an idle one goes by itself
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection, scratch: Path | None) -> None:
    """Perform jobs until the pipe closes: the main function of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the driver as well, which ends us
    if scratch is not None:
        tempfile.tempdir = str(scratch)
    while True:
        try:
            job = pipe.recv()
            pipe.send(perform(job))
        except (EOFError, ConnectionError):
            return


_AHEAD = 2  # jobs in flight for each CPU, so that none waits for the driver


@dataclass(frozen=True)
class RayPool:
    """address: as `ray.init` takes it ("auto", "host:6379", "ray://host:10001"), or "local" for a cluster on this
    machine that ends with the run; workers: CPUs of that one, jobs in flight on others (0: as many as there are).
    """

    address: str
    workers: int = 0

    def outcomes(self, jobs: Iterator[Job], total: int) -> Iterator[Outcome]:
        """The outcomes as they come. Raises `MissingExtraError` without Ray, `InputError` where there is no cluster."""
        ray = _connected(self.address, self.workers)
        try:
            limit = self.workers if self.workers and self.address != "local" else self._in_flight(ray)
            task = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(perform_on_node)
            names: dict[Any, str] = {}
            while True:
                while len(names) < limit and (job := next(jobs, None)) is not None:
                    names[task.remote(job)] = job.input.name
                if not names:
                    return
                for reference in ray.wait(list(names))[0]:
                    yield _outcome(ray, reference, names.pop(reference))
        finally:
            ray.shutdown()

    def _in_flight(self, ray: ModuleType) -> int:
        return _AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))


def perform_on_node(job: Job) -> Outcome:
    """Perform a job. Of the processes of a node one compiles kernels, the others wait and load them."""
    with _lock_of_node():
        load_kernels()
    return perform(job)


@contextmanager
def _lock_of_node() -> Iterator[None]:
    """Hold a lock that the user's processes on this machine share; none where the folder for them cannot be written."""
    name = Path(tempfile.gettempdir()) / f"saga-fg-kernels-{os.getuid()}.lock"
    try:
        lock = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError:
        yield
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _outcome(ray: ModuleType, reference: Any, name: str) -> Outcome:
    try:
        outcome = ray.get(reference)
    except ray.exceptions.RayError as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else ""
        return Outcome(name, "failed", reason=f"{type(error).__name__}: {reason}")
    assert isinstance(outcome, Outcome)
    return outcome


def _connected(address: str, workers: int) -> ModuleType:
    """Ray, connected to a cluster."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # what Ray is about to do, and warns of
    require_extra("ray", "--ray", "ray")
    import ray

    local: dict[str, Any] = {}
    if address == "local":
        local = {"num_cpus": workers or None, "include_dashboard": False}
        os.environ.setdefault("RAY_worker_niceness", "0")  # there is no raylet of others to be nice to
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING, configure_logging=False, **local)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise InputError(f"--ray {address}: no cluster there: {str(error).strip().splitlines()[0]}") from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_sigterm)  # Ray has put a handler of its own in its place
    module: ModuleType = ray
    return module
