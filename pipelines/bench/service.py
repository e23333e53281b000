"""Endurance of the service: one process serves, another sends frames, some broken, some late, and reconnects.

Halfway the client goes away without a word, with frames on the way and answers unread; it comes back, asks what was
taken in, and sends the rest again. At the end every valid frame must have been taken in once and every broken line
refused.
"""

from __future__ import annotations

import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.serving import Address, StreamClient, parse_address
from pipelines.serving.messages import encode
from saga_fg.errors import SagaError
from saga_fg.settings import require_between, require_positive, setting

INTERVAL = 0.1  # s between frames
BROKEN = (
    b"{",
    b"[1, 2]\n",
    b'{"timestamp": "noon", "detections": []}\n',
    b'{"timestamp": 1, "detections": [{"x": 1}]}\n',
)
IN_FLIGHT = 4  # frames sent ahead of their answers
ANSWERS = ("tracks", "held", "repeat")


@dataclass(frozen=True)
class ServiceBenchSettings:
    """How long, and how rough."""

    frames: int = setting(100_000, "frames to send")
    objects: int = setting(50, "objects in each")
    malformed: float = setting(0.01, "share of messages that are broken")
    late: float = setting(0.05, "share of frames that come after younger ones")
    seed: int = setting(0, "of objects and mishaps")

    def __post_init__(self) -> None:
        require_positive(self, "frames", "objects")
        require_between(self, 0.0, 0.5, "malformed", "late")


@dataclass(frozen=True)
class ServiceBench:
    """What came of it; memory in MB after a tenth and at the end, latencies in ms."""

    valid: int
    taken_in: int
    broken: int
    refused: int
    late: int
    sent_again: int
    memory: tuple[float, float]
    latency: dict[str, float]

    @property
    def nothing_lost(self) -> bool:
        """Whether every valid frame was taken in once, and every broken line refused."""
        return self.valid == self.taken_in and self.broken == self.refused


def bench_service(settings: ServiceBenchSettings, progress: Callable[[int, int], None] | None = None) -> ServiceBench:
    """Run it on this machine. Raises `SagaError` when the service does not come up."""
    with subprocess.Popen(
        [sys.executable, "-c", "from pipelines.cli.main import main; main()", "serve", "--listen", "127.0.0.1:0"],
        stderr=subprocess.PIPE,
        text=True,
    ) as server:
        try:
            return _drive(_address(server), settings, progress)
        finally:
            server.terminate()
            server.communicate(timeout=60)


def _address(server: subprocess.Popen[str]) -> Address:
    assert server.stderr is not None
    line = server.stderr.readline().strip()
    if not line.startswith("listening at "):
        raise SagaError(f"the service did not come up: {line}")
    return parse_address(line.removeprefix("listening at "))


def _drive(
    address: Address, settings: ServiceBenchSettings, progress: Callable[[int, int], None] | None
) -> ServiceBench:
    rng = np.random.default_rng([settings.seed, 1])
    unanswered: deque[bytes] = deque()
    early: dict[str, Any] = {}
    broken = again = 0
    half = settings.frames // 2
    client = StreamClient(address)
    for k, line in enumerate(_frames(settings)):
        if rng.random() < settings.malformed and not half - IN_FLIGHT <= k <= half:  # such a line is never sent again
            client.send(BROKEN[broken % len(BROKEN)].rstrip() + b"\n")
            broken += 1
        client.send(line)
        unanswered.append(line)
        while len(unanswered) >= IN_FLIGHT:
            _answer(client, unanswered)
        if k == half:
            client.close()  # frames are on the way, and nobody reads their answers
            client = StreamClient(address)
            again += _send_again(client, unanswered)
        if k == settings.frames // 10:
            early = _settled(client, unanswered)
        if progress is not None:
            progress(k + 1, settings.frames)
    final = _settled(client, unanswered)
    client.close()
    return ServiceBench(
        valid=settings.frames,
        taken_in=final["frames"],
        broken=broken,
        refused=final["refused"],
        late=final["late"],
        sent_again=again,
        memory=(early["memory_mb"], final["memory_mb"]),
        latency=final["latency_ms"],
    )


def _answer(client: StreamClient, unanswered: deque[bytes]) -> None:
    if client.receive()["type"] in ANSWERS:
        unanswered.popleft()


def _settled(client: StreamClient, unanswered: deque[bytes]) -> dict[str, Any]:
    """The status once all frames sent are answered."""
    while unanswered:
        _answer(client, unanswered)
    client.send({"type": "status"})
    while (answer := client.receive())["type"] != "status":
        pass
    return answer


def _send_again(client: StreamClient, unanswered: deque[bytes]) -> int:
    """Frames without an answer, once more; the service knows by their numbers which it has."""
    for line in unanswered:
        client.send(line)
    return len(unanswered)


def _frames(settings: ServiceBenchSettings) -> Iterator[bytes]:
    """Lines of frames: objects on circles of their own, seen with noise; a late frame changes places with the next."""
    rng = np.random.default_rng([settings.seed, 2])
    centre = rng.uniform(-200, 200, (settings.objects, 2))
    phase = rng.uniform(0, 2 * np.pi, settings.objects)
    times = np.arange(settings.frames) * INTERVAL
    late = np.flatnonzero(rng.random(settings.frames) < settings.late)
    for k in late[late < settings.frames - 1]:
        times[[k, k + 1]] = times[[k + 1, k]]
    for seq, time in enumerate(times.tolist()):
        angle = phase + 0.3 * time
        position = centre + 20 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + rng.normal(0, 0.2, centre.shape)
        detections = [{"label": "car", "x": x, "y": y, "score": 0.9} for x, y in position.round(3).tolist()]
        yield encode({"seq": seq, "timestamp": round(time, 6), "sensor": "lidar", "detections": detections})
