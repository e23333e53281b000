"""Jobs on this machine: worker processes, each doing one job at a time.

Every worker has a pipe of its own, so that one which is killed (the system is out of memory, say) takes down the job
it was doing and nothing else; `concurrent.futures` gives up all jobs then. That job is tried once more in a new
worker, and failed if it ends that one, too. Workers end with the driver, however it ends: their pipe closes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

from pipelines.scale_out.job import Job, Outcome, perform
from saga_fg.errors import InputError
from saga_fg.kernels.compilation import load_kernels

ATTEMPTS = 2


@dataclass(frozen=True)
class LocalPool:
    """workers: number of processes (0: one a core); scratch: folder for their temporary files, None: the system's."""

    workers: int = 0
    scratch: Path | None = None

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise InputError(f"workers: expected a number >= 0, got {self.workers}")

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
