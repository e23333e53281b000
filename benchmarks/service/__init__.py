"""The live service among hostile clients, and sensors with wrong clocks.

Round trips are part of `benchmarks.speed`.
"""

from __future__ import annotations

from typing import Annotated

import typer

from benchmarks.runner import Rows, Seed, only_errors
from benchmarks.service.clocks import fault_rows, offset_rows
from benchmarks.service.hostile_service import bench_hostile_service, shortcomings
from benchmarks.service.ros2_round_trip import over_dds
from pipelines.cli.console import progress_bar
from saga_fg.errors import SagaError

ROS2_OBJECTS = 200


def service(
    clocks: Annotated[bool, typer.Option("--clocks", help="Wrong clocks of one sensor instead, see below.")] = False,
    messages: Annotated[
        int, typer.Option("--messages", min=200, help="In all, a fifth of them frames of good clients.")
    ] = 20_000,
    objects: Annotated[int, typer.Option("--objects", min=1, help="Objects in each of these frames.")] = 50,
    pace: Annotated[float, typer.Option("--pace", min=1, help="Frames a good client sends in a second.")] = 50.0,
    ros2: Annotated[bool, typer.Option("--ros2", help="Over DDS instead, as a node of ROS 2, see below.")] = False,
    seconds: Annotated[float, typer.Option("--seconds", min=1, help="With --ros2: length of the run, s.")] = 600.0,
    seed: Seed = 0,
) -> Rows:
    """Two good clients of a service among hostile ones.

    Two hundred of them: poisonous, broken and random messages, clocks that are wrong, drift or jump. A listener does
    not read, a good client is killed, the disk is full for a while, another service wants the same snapshot, and the
    service is killed half-way and goes on from it. Fails if less than 99 % of the valid frames are tracked, one is lost
    or judged twice, a good client waits outside the restart for 0.3 s more than a thread that sleeps, memory grows by
    more than 5 %, the full disk is not told, or the other service is not refused.

    With --clocks, three sensors in one process, one with a wrong clock: which share of the frames of the others is
    tracked; and how well steady offsets are estimated. Fails below 99 %, above 10 ms, and where positions are more than
    5 % worse than without an offset.

    With --ros2, `saga-fg serve ros2` in one process, and in this one what publishes detections of 200 objects and the
    vehicle's pose at 10 Hz, true rate, and reads the tracks: frames without tracks, and the time from publishing to
    reading. Fails if a frame is lost.

    \b
    Examples:
      python -m benchmarks service
      python -m benchmarks service --messages 2000 --objects 10 --json figures.json
      python -m benchmarks service --clocks
      python -m benchmarks service --ros2 --seconds 60
    """
    if ros2:
        found = over_dds(ROS2_OBJECTS, seconds, seed)
        yield "ROS 2 over DDS at 10 Hz, ms on the wall's clock", found
        if found["lost"]:
            raise SagaError(f"{found['lost']:g} of {found['frames']:g} frames have no tracks")
        return
    if clocks:
        with only_errors("saga_fg.tracking"):  # each frame that is left out is warned of
            yield from fault_rows(seed)
            yield from offset_rows(seed)
        return
    with progress_bar() as progress:
        figures = bench_hostile_service(messages, objects, pace, seed, progress)
    yield from (("service", {"figure": name, "value": value}) for name, value in figures.items())
    if short := shortcomings(figures):
        raise SagaError("; ".join(short))
