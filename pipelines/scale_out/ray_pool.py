"""Jobs on a Ray cluster (https://docs.ray.io): one task a job, placed, moved and retried by Ray.

Nodes need this package in the same version. Inputs that are read by the driver travel with their job; those that are
read by the worker (files) must be reachable from every node under the same name. Results travel back to the driver.
Kernels are compiled once a node.
"""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pipelines.scale_out.job import Job, Outcome, perform
from pipelines.scale_out.local_pool import ATTEMPTS
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.kernels.compilation import load_kernels

log = logging.getLogger(__name__)

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
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError('--ray: Ray is not installed; pip install "saga-fg[ray]"') from error
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
