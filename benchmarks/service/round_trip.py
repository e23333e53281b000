"""Round trip of the live service: a client sends a frame every `INTERVAL` s and waits for its tracks.

The service runs in a process of its own and keeps its state in a file. Round trips are on the wall's clock, so that all
other work of the machine counts; the CPU time of the service a frame does not depend on it.
"""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.runner import each
from benchmarks.service.served import CirclingObjects, Served
from pipelines.serving import StreamClient
from pipelines.serving.messages import encode

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
