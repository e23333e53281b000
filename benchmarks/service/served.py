"""A service in a process of its own, and the objects that its clients see.

Round trip of the live service: a client sends a frame every `INTERVAL` s and waits for its tracks.

The service runs in a process of its own and keeps its state in a file. Round trips are on the wall's clock, so that all
other work of the machine counts; the CPU time of the service a frame does not depend on it.
"""

from __future__ import annotations

import resource
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.runner import PROGRAM, each
from pipelines.serving import Address, StreamClient, parse_address
from pipelines.serving.messages import encode
from saga_fg.errors import SagaError

INTERVAL = 0.1  # s between frames
SAVED_EVERY = 1.0  # s between two snapshots of the state
WARM_UP = 10  # frames that are not counted: tracks are new


def round_trips(objects: int, frames: int, seed: int) -> dict[str, float]:
    """Percentiles of `frames` round trips, and CPU time of the service a frame, ms; size of its memory at the end, MB.

    Raises `SagaError` when the service does not come up."""
    scene, rng, times = CirclingObjects(objects, seed), np.random.default_rng([seed, 4]), []
    lines = []
    for k in range(frames + WARM_UP):
        detections = scene.detections(k * INTERVAL, rng)
        frame = {"seq": k, "timestamp": round(k * INTERVAL, 6), "sensor": "lidar", "detections": detections}
        lines.append(encode(frame))
    with TemporaryDirectory() as folder:
        state = str(Path(folder) / "state.saga")
        server = Served("--listen", "127.0.0.1:0", "--snapshot", state, "--every", str(SAVED_EVERY))
        try:
            with StreamClient(server.address) as client:
                before, begin = 0.0, time.monotonic()
                for k, line in enumerate(each(lines, "service")):
                    if k == WARM_UP:
                        before = client.ask({"type": "status"})["cpu_seconds"]
                    time.sleep(max(0.0, begin + k * INTERVAL - time.monotonic()))
                    sent = time.monotonic()
                    client.send(line)
                    client.receive()
                    times.append(1e3 * (time.monotonic() - sent))
                status = client.ask({"type": "status"})
        finally:
            server.end()
    p50, p90, p99 = np.percentile(times[WARM_UP:], (50, 90, 99)).tolist()
    cpu = 1e3 * (status["cpu_seconds"] - before) / frames
    about: dict[str, float] = {"objects": objects, "frames": frames, "p50": p50, "p90": p90, "p99": p99}
    return {**about, "CPU a frame": cpu, "MB": status["memory_mb"]}


NOISE = 0.2  # of detections, m


class CirclingObjects:
    """`number` cars within 200 m, each on a circle of 20 m."""

    def __init__(self, number: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        self._centre = rng.uniform(-200, 200, (number, 2))
        self._phase = rng.uniform(0, 2 * np.pi, number)

    def detections(self, time: float, rng: np.random.Generator) -> list[dict[str, Any]]:
        """Detections of all objects at a time, s, with noise, in the form of a message."""
        angle = self._phase + 0.3 * time
        position = self._centre + 20 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        position = position + rng.normal(0, NOISE, position.shape)
        return [{"label": "car", "x": x, "y": y, "score": 0.9} for x, y in position.round(3).tolist()]


class Served:
    """Starts `saga-fg serve` with some options; `address` is where it listens. Raises `SagaError` if it does not."""

    def __init__(self, *options: str) -> None:
        self.process = subprocess.Popen([*PROGRAM, "serve", *options], stderr=subprocess.PIPE, text=True)
        self._said: deque[str] = deque(maxlen=20)
        self.address = self._address()
        self._listening = threading.Thread(target=self._listen, daemon=True)  # or it would wait with its warnings
        self._listening.start()

    @contextmanager
    def full_disk(self) -> Iterator[None]:
        """Let it write no files, as on a full disk; Linux only."""
        whole = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (0, whole[1]))
        try:
            yield
        finally:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, whole)

    def kill(self) -> None:
        """SIGKILL."""
        self.process.kill()
        self._gone()

    def end(self) -> int:
        """SIGTERM; the exit code."""
        self.process.terminate()
        return self._gone()

    def _gone(self) -> int:
        code = self.process.wait(60)
        self._listening.join()
        assert self.process.stderr is not None
        self.process.stderr.close()
        return code

    def _address(self) -> Address:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._said.append(line.strip())
            if line.startswith("listening at "):
                return parse_address(line.strip().removeprefix("listening at "))
        self.process.stderr.close()
        self.process.wait()
        raise SagaError(f"the service did not come up: {' '.join(self._said)}")

    def _listen(self) -> None:
        assert self.process.stderr is not None
        self._said.extend(self.process.stderr)
