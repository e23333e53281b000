"""`saga-fg serve` and `saga-fg status`: live tracking as a service."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.checks import Checks
from pipelines.cli import options as how
from pipelines.cli.options import Config, Verbose
from pipelines.cli.termination import TERMINATED
from pipelines.config import Method, TrackConfig, load_config
from pipelines.configuration import load_settings, write_settings
from pipelines.explaining import clock_text
from pipelines.serving import (
    Address,
    SocketServer,
    StateKeeper,
    StopRequest,
    StreamClient,
    StreamSettings,
    StreamTracker,
    parse_address,
    serve_pipe,
)
from pipelines.serving.settings import LogLimitFilter
from pipelines.tracking import one_thread, return_large_blocks
from saga_fg.errors import InputError
from saga_fg.kernels.compilation import load_kernels

DEFAULT_ADDRESS = "127.0.0.1:7447"


@dataclass(frozen=True)
class ServiceOptions:
    """Where a service listens, what it keeps, and within which limits."""

    listen: Annotated[
        str | None,
        typer.Option(
            "--listen",
            help="HOST:PORT, or the path of a Unix socket; standard input and output if left out.",
            metavar="ADDRESS",
        ),
    ] = None
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Listen where other machines can connect. There is no password.")
    ] = False
    reorder: Annotated[
        float | None,
        typer.Option(
            "--reorder", min=0.0, help="Hold frames back by up to this many s, to sort them by time.  [default: 0]"
        ),
    ] = None
    snapshot: Annotated[
        Path | None,
        typer.Option("--snapshot", help="Keep the state in this file, and go on from it at the start.", metavar="FILE"),
    ] = None
    every: Annotated[float, typer.Option("--every", min=0.05, help="How often to write --snapshot, s.")] = 5.0
    limits: Annotated[
        Path | None,
        typer.Option(
            "--limits", help="YAML file of limits and times to wait; see `saga-fg config --limits`.", metavar="FILE"
        ),
    ] = None


def _serve_stream(
    service: ServiceOptions,
    tracker: how.TrackerOptions,
    predict: Annotated[
        str | None,
        typer.Option("--predict", help="Answer every frame with its tracks these s later, as well.", metavar="S,S,..."),
    ] = None,
    learn_offsets: how.LearnOffsetsOption = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track live: detections in, tracks out, as newline-delimited JSON.

    One line is one frame of one sensor; every frame is answered with the tracks at its time. A line that cannot be
    used is answered with what is wrong, counted and skipped. `saga-fg docs guides/stream` has the messages.

    SIGTERM and Ctrl-C finish what has come in, with a bound on the time; the exit code is then 143 or 0.

    \b
    Examples:
      saga-fg serve < frames.ndjson > tracks.ndjson
      saga-fg serve --listen 127.0.0.1:7447 --reorder 0.1
      saga-fg serve --predict 1,2,3 < frames.ndjson > tracks.ndjson
      saga-fg serve --listen ./saga.sock --snapshot state.saga --every 2
      saga-fg status
    """
    if not verbose:
        for handler in logging.getLogger().handlers:
            handler.addFilter(LogLimitFilter())
    method = tracker.method
    how.check_learn_offsets(learn_offsets, method)
    settings = tracker.configured("file", config)
    bounds = StreamSettings() if service.limits is None else load_settings(StreamSettings, service.limits)
    if service.reorder is not None:
        bounds = replace(bounds, reorder=service.reorder)
    checks = Checks(settings.of_method(method), load_config("file"))
    horizons = how.horizons(predict, method)
    stream: StreamTracker[Any] = StreamTracker(lambda: settings.new_tracker(method), bounds, checks, horizons)
    return_large_blocks()
    kept = service.snapshot
    keeper = None if kept is None else _restored(stream, kept, service.every, settings, method)
    last_acts = () if keeper is None else (keeper.save, keeper.clear_leftovers)
    with one_thread(), StopRequest(bounds.stop_timeout, *last_acts) as stop:
        _serve(stream, keeper, service.listen, service.allow_remote, stop)
        if keeper is not None:
            keeper.stop()
        typer.echo(_summary(stream.status()), err=True)
        if learn_offsets is not None:
            how.write_offsets(learn_offsets, [stream.clocks()], settings, "a stream")
    if stop.number == signal.SIGTERM:
        raise typer.Exit(TERMINATED)


serve = how.as_command(_serve_stream)


def _restored(
    stream: StreamTracker[Any], snapshot: Path, every: float, settings: TrackConfig, method: Method
) -> StateKeeper:
    """The keeper of a stream that goes on from its file, if there is one."""
    if settings.tracker.providers:
        raise InputError("--snapshot: expected no tracker.providers, whose factors cannot be kept in a file")
    if not settings.new_tracker(method).plain_snapshots:
        raise InputError(
            "--snapshot: expected an estimator whose snapshots are plain values, as kalman's, where objects move "
            f"nonlinearly, got {settings.tracker.estimator}"
        )
    configuration = write_settings(settings, comments=False)
    header = {"version": version("saga-fg"), "method": method, "configuration": configuration}
    keeper = StateKeeper(stream, snapshot, every, header)
    if keeper.restore():
        typer.echo(f"going on from {snapshot}: {stream.status()['frames']} frames so far", err=True)
    return keeper


def _serve(
    stream: StreamTracker[Any], keeper: StateKeeper | None, listen: str | None, allow_remote: bool, stop: StopRequest
) -> None:
    """Until the source ends or the service is told to stop."""

    def ready(address: Address | None = None) -> None:
        load_kernels()
        if keeper is not None:
            keeper.start()
        if address is not None:
            typer.echo(f"listening at {address}", err=True)

    if listen is None:
        try:
            ready()
            serve_pipe(stream, sys.stdin.buffer, sys.stdout.buffer, stop)
        except BrokenPipeError:
            typer.echo("the reader of the tracks has gone away", err=True)
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is buffered has nowhere to go
    else:
        address = parse_address(listen)
        if not address.is_local and not allow_remote:
            raise InputError(f"--listen {listen}: other machines could connect there; --allow-remote if that is meant")
        SocketServer(stream, address, ready).run(stop)


def status(
    address: Annotated[
        str, typer.Argument(help="Where the service listens: HOST:PORT or the path of a Unix socket.")
    ] = DEFAULT_ADDRESS,
    as_json: Annotated[bool, typer.Option("--json", help="Print the service's answer as it is.")] = False,
    verbose: Verbose = False,
) -> None:
    """Ask a running service for its counts and latencies.

    \b
    Example:
      saga-fg status 127.0.0.1:7447
    """
    where = parse_address(address)
    with StreamClient(where, timeout=10.0) as client:
        try:
            answer = client.ask({"type": "status"})
        except OSError as error:
            raise InputError(f"{where}: expected the status of `saga-fg serve`: {error}") from error
    if answer.get("type") != "status":
        raise InputError(f"{where}: expected the status of `saga-fg serve`, got {str(answer)[:80]}")
    typer.echo(json.dumps(answer) if as_json else _summary(answer))


def _summary(answer: dict[str, Any]) -> str:
    counts = ", ".join(
        f"{answer[name]} {text}"
        for name, text in (
            ("messages", "messages"),
            ("frames", "frames tracked"),
            ("held", "held back"),
            ("out_of_order", "out of order"),
            ("late", "too late"),
            ("unconfirmed", "of unconfirmed time"),
            ("repeats", "repeated"),
            ("refused", "refused"),
            ("jumps", "jumps of the clock"),
            ("failures", "internal errors"),
            ("restarts", "restarts of the tracker"),
        )
    )
    latency = ", ".join(f"{name} {ms:g}" for name, ms in answer["latency_ms"].items()) or "none yet"
    error = (answer.get("state") or {}).get("error")
    kept = "" if error is None else f"\nthe state is not kept: {error}"
    clocks = "".join(f"\n{clock_text(name, each)}" for name, each in answer.get("clocks", {}).items())
    memory = f"memory: {answer['memory_mb']:g} MB, up for {answer['seconds']:.0f} s"
    return f"{counts}{kept}{clocks}\nlatency, ms: {latency}\n{memory}"
