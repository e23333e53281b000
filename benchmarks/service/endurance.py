"""Endurance of the service: one process serves, another sends frames, some broken, some late, and reconnects.

Halfway the client goes away without a word, with frames on the way and answers unread; it comes back, asks what was
taken in, and sends the rest again. At the end every valid frame must have been taken in once and every broken line
refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from benchmarks.service.served import Served
from pipelines.serving import Address, StreamClient
from pipelines.serving.messages import encode
from pipelines.tracking import Progress
from saga_fg.settings import PositiveInt, Range, Settings, setting

BROKEN = (
    b"{",
    b"[1, 2]\n",
    b'{"timestamp": "noon", "detections": []}\n',
    b'{"timestamp": 1, "detections": [{"x": 1}]}\n',
)
INTERVAL = 0.1  # s between frames
NOISE = 0.2  # of detections, m
IN_FLIGHT = 4  # frames sent ahead of their answers
ANSWERS = ("tracks", "held", "repeat")


@dataclass(frozen=True)
class ServiceBenchSettings(Settings):
    """Length of the run and shares of bad messages."""

    frames: PositiveInt = setting(100_000, "frames to send")
    objects: PositiveInt = setting(50, "objects in each")
    malformed: Annotated[float, Range(0.0, 0.5)] = setting(0.01, "share of messages that are broken")
    late: Annotated[float, Range(0.0, 0.5)] = setting(0.05, "share of frames that come after younger ones")
    seed: int = setting(0, "seed of objects and faults")


@dataclass(frozen=True)
class ServiceBench:
    """Counts of messages; memory in MB after a tenth and at the end, latencies in ms."""

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
        """True if every valid frame was taken in once, and every broken line refused."""
        return self.valid == self.taken_in and self.broken == self.refused


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


def bench_service(settings: ServiceBenchSettings, progress: Progress | None = None) -> ServiceBench:
    """Run it on this machine. Raises `SagaError` when the service does not come up."""
    server = Served("--listen", "127.0.0.1:0")
    try:
        return _drive(server.address, settings, progress)
    finally:
        server.end()


def _drive(address: Address, settings: ServiceBenchSettings, progress: Progress | None) -> ServiceBench:
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
            progress("frames sent", k + 1, settings.frames)
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
