"""`saga-fg bench service`: the endurance of `saga-fg serve`."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report
from saga_fg.errors import SagaError

if TYPE_CHECKING:
    from pipelines.bench.hostile_service import HostileBenchSettings
    from pipelines.bench.service import ServiceBenchSettings


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
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of objects and mishaps.")] = 0,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
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
      saga-fg bench service
      saga-fg bench service --frames 2000 --objects 10 --json figures.json
      saga-fg bench service --hostile
      saga-fg bench service --clocks
    """
    from pipelines.bench.hostile_service import HostileBenchSettings
    from pipelines.bench.service import ServiceBenchSettings

    if clocks:
        _clocks(seed, json_file)
    elif hostile:
        _hostile(HostileBenchSettings(messages, objects, pace, seed), json_file)
    else:
        _endurance(ServiceBenchSettings(frames, objects, malformed, late, seed), json_file)


def _endurance(settings: ServiceBenchSettings, json_file: Path | None) -> None:
    from pipelines.bench.service import bench_service

    with progress_bar() as progress:
        result = bench_service(settings, progress)
    latency = result.latency
    typer.echo(f"{result.taken_in} of {result.valid} valid frames taken in, {result.out_of_order} of them out of order")
    typer.echo(f"{result.refused} of {result.broken} broken lines refused")
    typer.echo(f"the client came back once and sent {result.sent_again} frames again")
    typer.echo(
        f"memory: {result.memory[0]:.1f} MB after a tenth, {result.memory[1] / result.memory[0]:.3f} of it at the end"
    )
    typer.echo(
        f"latency, ms: median {latency['p50']:.3g}; p99 / median {latency['p99'] / latency['p50']:.2f}, "
        f"p99.9 / median {latency['p99.9'] / latency['p50']:.2f}"
    )
    report([], {**asdict(result), "nothing_lost": result.nothing_lost}, json_file)
    if not result.nothing_lost:
        raise SagaError("frames were lost, doubled or wrongly refused")


def _hostile(settings: HostileBenchSettings, json_file: Path | None) -> None:
    from pipelines.bench.hostile_service import bench_hostile_service

    with progress_bar() as progress:
        result = bench_hostile_service(settings, progress)
    start, end = result.memory
    dropped = ", ".join(f"{count} {reason}" for reason, count in sorted(result.dropped.items())) or "none"
    share = 100 * result.tracked / result.valid
    typer.echo(f"valid frames: {result.valid} sent, {result.tracked} tracked ({share:.1f} %)")
    typer.echo(f"{result.late} too late, {result.unconfirmed} of unconfirmed time, by clocks of others")
    typer.echo(f"{result.answered} answered, {result.lost} lost, {result.doubled} doubled")
    typer.echo(f"hostile messages: {result.hostile}, {result.refused} refused; clients closed: {dropped}")
    typer.echo(
        f"longest stall of a good client: {result.longest_stall:.3f} s, of a thread that only sleeps: "
        f"{result.machine_stall:.3f} s"
    )
    typer.echo(f"memory: {start:.1f} MB after a tenth, {end:.1f} MB at the end, {end / start:.3f} of it")
    typer.echo(f"restarts of the tracker: {result.restarts}, internal errors: {result.failures}")
    typer.echo(f"frames sent again: {result.sent_again}")
    typer.echo(f"from the restart of the service to its first answer: {result.first_answer:.3f} s")
    report([], {**asdict(result), "shortcomings": result.shortcomings}, json_file)
    if result.shortcomings:
        raise SagaError("; ".join(result.shortcomings))


def _clocks(seed: int, json_file: Path | None) -> None:
    from pipelines.bench.clocks import (
        ClockBenchSettings,
        bench_steady_offsets,
        bench_wrong_clocks,
        clock_shortcomings,
        clock_tables,
    )

    logging.getLogger("saga_fg.tracking").setLevel(logging.ERROR)  # each frame that is left out is warned of
    settings = ClockBenchSettings(seed=seed)
    with progress_bar() as progress:
        wrong, steady = bench_wrong_clocks(settings, progress), bench_steady_offsets(settings, progress)
    found = clock_shortcomings(wrong, steady)
    report(clock_tables(wrong, steady), {"shortcomings": found}, json_file)
    if found:
        raise SagaError("; ".join(found))
