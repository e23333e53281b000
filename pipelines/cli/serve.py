"""`saga-fg serve` and `saga-fg status`: live tracking as a service."""

from __future__ import annotations

import json
import os
import signal
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli.options import Config, Verbose
from pipelines.cli.tracking_options import (
    AssociationOption,
    EstimatorOption,
    InteractionsOption,
    LagOption,
    MethodOption,
    configured,
)
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from pipelines.serving import Address, StreamTracker

DEFAULT_ADDRESS = "127.0.0.1:7447"


def serve(
    listen: Annotated[
        str | None,
        typer.Option(
            "--listen",
            help="HOST:PORT, or the path of a Unix socket; standard input and output if left out.",
            metavar="ADDRESS",
        ),
    ] = None,
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Listen where other machines can connect. There is no password.")
    ] = False,
    reorder: Annotated[
        float, typer.Option("--reorder", min=0.0, help="Hold frames back by up to this many s, to sort them by time.")
    ] = 0.0,
    method: MethodOption = "saga",
    estimator: EstimatorOption = None,
    lag: LagOption = None,
    association: AssociationOption = None,
    interactions: InteractionsOption = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track live: detections in, tracks out, as newline-delimited JSON.

    One line is one frame of one sensor; every frame is answered with the tracks at its time. A line that cannot be
    used is answered with what is wrong, counted and skipped. docs/guides/stream.md describes the messages.

    \b
    Examples:
      saga-fg serve < frames.ndjson > tracks.ndjson
      saga-fg serve --listen 127.0.0.1:7447 --reorder 0.1
      saga-fg status
    """
    from pipelines.process import one_thread
    from pipelines.serving import StreamSettings, StreamTracker

    settings = configured("file", config, method, estimator, lag, association, interactions)
    stream: StreamTracker[Any] = StreamTracker(lambda: settings.new_tracker(method), StreamSettings(reorder=reorder))
    with one_thread():
        _serve(stream, listen, allow_remote)
    typer.echo(_summary(stream.status()), err=True)


def _serve(stream: StreamTracker[Any], listen: str | None, allow_remote: bool) -> None:
    """Until the source ends or the service is told to stop."""
    from pipelines.serving import SocketServer, parse_address, serve_pipe

    if listen is None:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # as an interrupt: finish what has come in
        try:
            serve_pipe(stream, sys.stdin.buffer, sys.stdout.buffer)
        except BrokenPipeError:
            typer.echo("the reader of the tracks has gone away", err=True)
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is buffered has nowhere to go
    else:
        address = parse_address(listen)
        if not address.is_local and not allow_remote:
            raise InputError(f"--listen {listen}: other machines could connect there; --allow-remote if that is meant")
        SocketServer(stream, address, _say_ready).run()


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
    from pipelines.serving import StreamClient, parse_address

    where = parse_address(address)
    with StreamClient(where, timeout=10.0) as client:
        try:
            answer = client.ask({"type": "status"})
        except OSError as error:
            raise InputError(f"{where}: expected the status of `saga-fg serve`: {error}") from error
    if answer.get("type") != "status":
        raise InputError(f"{where}: expected the status of `saga-fg serve`, got {str(answer)[:80]}")
    typer.echo(json.dumps(answer) if as_json else _summary(answer))


def _say_ready(address: Address) -> None:
    typer.echo(f"listening at {address}", err=True)


def _summary(answer: dict[str, Any]) -> str:
    counts = ", ".join(
        f"{answer[name]} {text}"
        for name, text in (
            ("messages", "messages"),
            ("frames", "frames tracked"),
            ("held", "held back"),
            ("late", "late"),
            ("repeats", "repeated"),
            ("refused", "refused"),
            ("jumps", "jumps of the clock"),
        )
    )
    latency = ", ".join(f"{name} {ms:g}" for name, ms in answer["latency_ms"].items()) or "none yet"
    return f"{counts}\nlatency, ms: {latency}\nmemory: {answer['memory_mb']:g} MB, up for {answer['seconds']:.0f} s"
