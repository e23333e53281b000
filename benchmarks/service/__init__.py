"""The live service at work: endurance, alone and among hostile clients, and sensors with wrong clocks.

Round trips are part of `benchmarks.speed`.
"""

from __future__ import annotations

import logging
from dataclasses import asdict
from typing import Annotated

import typer

from benchmarks.runner import Rows, Seed
from benchmarks.service.clocks import bench_steady_offsets, bench_wrong_clocks, clock_rows, clock_shortcomings
from benchmarks.service.endurance import ServiceBenchSettings, bench_service
from benchmarks.service.hostile_service import HostileBenchSettings, bench_hostile_service
from pipelines.cli.console import progress_bar
from saga_fg.errors import SagaError


def service(
    hostile: Annotated[bool, typer.Option("--hostile", help="Among hostile clients instead, see below.")] = False,
    clocks: Annotated[bool, typer.Option("--clocks", help="Wrong clocks of one sensor instead, see below.")] = False,
    frames: Annotated[int, typer.Option("--frames", min=20, help="Frames to send.")] = 100_000,
    objects: Annotated[int, typer.Option("--objects", min=1, help="Objects in each.")] = 50,
    malformed: Annotated[float, typer.Option("--malformed", min=0, max=0.5, help="Share of broken messages.")] = 0.01,
    late: Annotated[float, typer.Option("--late", min=0, max=0.5, help="Share of late frames.")] = 0.05,
    messages: Annotated[
        int, typer.Option("--messages", min=200, help="With --hostile: messages in all, a fifth of them valid frames.")
    ] = 20_000,
    pace: Annotated[
        float,
        typer.Option("--pace", min=1, help="With --hostile: frames a good client sends in a second."),
    ] = 50.0,
    seed: Seed = 0,
) -> Rows:
    """A service and a client in two processes, with broken messages, late frames and a client that comes back.

    Fails if a valid frame is lost or taken in twice, or a broken line is not refused.

    With --hostile, two good clients among hostile ones: poisonous, broken and random messages, clocks that are wrong,
    drift or jump in both directions, a listener that does not read, a good client that is killed, and a service that
    is killed half-way and goes on from its snapshot. Fails if less than 99 % of the valid frames are tracked, one is
    lost or judged twice, a good client waits for more than 0.5 s outside the restart, or memory grows by more than 5 %.

    With --clocks, three sensors in one process, one with a wrong clock: which share of the frames of the others is
    tracked; and how well steady offsets are estimated. Fails below 99 %, above 10 ms, and where positions are more than
    5 % worse than without an offset.

    \b
    Examples:
      python -m benchmarks service
      python -m benchmarks service --frames 2000 --objects 10 --json figures.json
      python -m benchmarks service --hostile
      python -m benchmarks service --clocks
    """
    if clocks:
        yield from _clocks(seed)
        return
    with progress_bar() as progress:
        if hostile:
            attacked = bench_hostile_service(HostileBenchSettings(messages, objects, pace, seed), progress)
            figures, shortcomings = asdict(attacked), attacked.shortcomings
        else:
            endured = bench_service(ServiceBenchSettings(frames, objects, malformed, late, seed), progress)
            figures = asdict(endured)
            shortcomings = [] if endured.nothing_lost else ["frames were lost, doubled or wrongly refused"]
    start, end = figures["memory"]
    figures |= {"memory": f"{end:.1f} MB", "memory, end / a tenth": end / start}
    yield from (("service", {"figure": name, "value": value}) for name, value in figures.items())
    if shortcomings:
        raise SagaError("; ".join(shortcomings))


def _clocks(seed: int) -> Rows:
    logging.getLogger("saga_fg.tracking").setLevel(logging.ERROR)  # each frame that is left out is warned of
    wrong = bench_wrong_clocks(seed)
    yield from clock_rows(wrong, [])
    steady = bench_steady_offsets(seed)
    yield from clock_rows([], steady)
    if shortcomings := clock_shortcomings(wrong, steady):
        raise SagaError("; ".join(shortcomings))
