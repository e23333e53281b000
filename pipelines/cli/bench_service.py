"""`saga-fg bench service`: the endurance of `saga-fg serve`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import progress_bar
from saga_fg.errors import SagaError


def service(
    frames: Annotated[int, typer.Option("--frames", min=20, help="Frames to send.")] = 100_000,
    objects: Annotated[int, typer.Option("--objects", min=1, help="Objects in each.")] = 50,
    malformed: Annotated[float, typer.Option("--malformed", min=0, max=0.5, help="Share of broken messages.")] = 0.01,
    late: Annotated[float, typer.Option("--late", min=0, max=0.5, help="Share of late frames.")] = 0.05,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of objects and mishaps.")] = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the figures to this file too.", metavar="FILE")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """A service and a client in two processes, with broken messages, late frames and a client that comes back.

    Fails if a valid frame is lost or taken in twice, or a broken line is not refused.

    \b
    Examples:
      saga-fg bench service
      saga-fg bench service --frames 2000 --objects 10 --json figures.json
    """
    from data_tools.atomic_files import check_writable
    from pipelines.bench.service import ServiceBenchSettings, bench_service
    from pipelines.figures import write_figures

    settings = ServiceBenchSettings(frames=frames, objects=objects, malformed=malformed, late=late, seed=seed)
    if json_file is not None:
        check_writable(json_file)
    with progress_bar() as progress:
        result = bench_service(settings, lambda done, total: progress("frames sent", done, total))
    latency = result.latency
    typer.echo(f"{result.taken_in} of {result.valid} valid frames taken in, {result.late} of them late")
    typer.echo(f"{result.refused} of {result.broken} broken lines refused")
    typer.echo(f"the client came back once and sent {result.sent_again} frames again")
    typer.echo(
        f"memory: {result.memory[0]:.1f} MB after a tenth, {result.memory[1] / result.memory[0]:.3f} of it at the end"
    )
    typer.echo(
        f"latency, ms: median {latency['p50']:.3g}; p99 / median {latency['p99'] / latency['p50']:.2f}, "
        f"p99.9 / median {latency['p99.9'] / latency['p50']:.2f}"
    )
    if json_file is not None:
        write_figures(json_file, {**asdict(result), "nothing_lost": result.nothing_lost})
    if not result.nothing_lost:
        raise SagaError("frames were lost, doubled or wrongly refused")
