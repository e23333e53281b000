"""Endurance of the service: one process serves, another sends frames, some broken, some late, and reconnects.

Halfway the client goes away without a word, with frames on the way and answers unread; it comes back, asks what was
taken in, and sends the rest again. At the end every valid frame must have been taken in once and every broken line
refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from pipelines.bench.circling_objects import INTERVAL, CirclingObjects
from pipelines.bench.served import Served
from pipelines.serving import Address, StreamClient
from pipelines.serving.messages import encode
from saga_fg.settings import PositiveInt, Range, Settings, setting

BROKEN = (
    b"{",
    b"[1, 2]\n",
    b'{"timestamp": "noon", "detections": []}\n',
    b'{"timestamp": 1, "detections": [{"x": 1}]}\n',
)
IN_FLIGHT = 4  # frames sent ahead of their answers
ANSWERS = ("tracks", "held", "repeat")


@dataclass(frozen=True)
class ServiceBenchSettings(Settings):
    """How long, and how rough."""

    frames: PositiveInt = setting(100_000, "frames to send")
    objects: PositiveInt = setting(50, "objects in each")
    malformed: Annotated[float, Range(0.0, 0.5)] = setting(0.01, "share of messages that are broken")
    late: Annotated[float, Range(0.0, 0.5)] = setting(0.05, "share of frames that come after younger ones")
    seed: int = setting(0, "of objects and mishaps")


@dataclass(frozen=True)
class ServiceBench:
    """What came of it; memory in MB after a tenth and at the end, latencies in ms."""

    valid: int
    taken_in: int
    broken: int
    refused: int
    out_of_order: int
    sent_again: int
    memory: tuple[float, float]
    latency: dict[str, float]

    @property
    def nothing_lost(self) -> bool:
        """Whether every valid frame was taken in once, and every broken line refused."""
        return self.valid == self.taken_in and self.broken == self.refused


def bench_service(settings: ServiceBenchSettings, progress: Callable[[int, int], None] | None = None) -> ServiceBench:
    """Run it on this machine. Raises `SagaError` when the service does not come up."""
    server = Served("--listen", "127.0.0.1:0")
    try:
        return _drive(server.address, settings, progress)
    finally:
        server.end()


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
        out_of_order=final["out_of_order"],
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
    """Lines of frames; a late frame changes places with the next."""
    objects = CirclingObjects(settings.objects, settings.seed)
    rng = np.random.default_rng([settings.seed, 3])
    times = np.arange(settings.frames) * INTERVAL
    late = np.flatnonzero(rng.random(settings.frames) < settings.late)
    for k in late[late < settings.frames - 1]:
        times[[k, k + 1]] = times[[k + 1, k]]
    for seq, time in enumerate(times.tolist()):
        detections = objects.detections(time, rng)
        yield encode({"seq": seq, "timestamp": round(time, 6), "sensor": "lidar", "detections": detections})
