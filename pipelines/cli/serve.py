"""`saga-fg serve` and `saga-fg status`: live tracking as a service."""

import json
import logging
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from data_tools.datasets.detection_file_source import SETTINGS_TEXT
from data_tools.datasets.mcap import DEFAULT_EGO, WORLD, RecordingOptions, sensor_topics
from pipelines.checks import Checks
from pipelines.cli import options as how
from pipelines.cli.options import Config, Verbose
from pipelines.cli.termination import TERMINATED
from pipelines.config import Method, TrackConfig, load_config
from pipelines.configuration import load_settings, write_settings
from pipelines.explaining import clock_text
from pipelines.serving import (
    LogLimitFilter,
    SocketServer,
    StateKeeper,
    StopRequest,
    StreamClient,
    StreamSettings,
    StreamTracker,
    parse_address,
    serve_pipe,
)
from pipelines.tracking import one_thread, return_large_blocks
from saga_fg.errors import InputError
from saga_fg.kernels.compilation import load_kernels
from saga_fg.tables import option_text, pairs
from saga_fg.types import Mend

DEFAULT_ADDRESS = "127.0.0.1:7447"


@dataclass(frozen=True)
class ListenOptions:
    """Where a service listens."""

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


@dataclass(frozen=True)
class ServiceOptions:
    """What a service keeps, within which limits, and what it learns."""

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
    learn_offsets: how.LearnOffsetsOption = None
    settings: Annotated[
        Literal["plain", "dense"] | None,
        typer.Option(
            "--settings",
            help=f"{SETTINGS_TEXT}; --config lies over them.  [default: plain, and the log says if the first frames "
            "look dense]",
        ),
    ] = None


def _serve_stream(
    listening: ListenOptions,
    service: ServiceOptions,
    tracker: how.TrackerOptions,
    predict: Annotated[
        str | None,
        typer.Option("--predict", help="Answer every frame with its tracks these s later, as well.", metavar="S,S,..."),
    ] = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track live: detections in, tracks out, as newline-delimited JSON.

    One line is one frame of one sensor; every frame is answered with the tracks at its time. A line that cannot be
    used is answered with what is wrong, counted and skipped. `saga-fg docs guides/stream` has the messages. `saga-fg
    serve ros2` does the same over DDS.

    SIGTERM and Ctrl-C finish what has come in, with a bound on the time; the exit code is then 143 or 0.

    \b
    Examples:
      saga-fg serve < frames.ndjson > tracks.ndjson
      saga-fg serve --listen 127.0.0.1:7447 --reorder 0.1
      saga-fg serve --predict 1,2,3 < frames.ndjson > tracks.ndjson
      saga-fg serve --listen ./saga.sock --snapshot state.saga --every 2
      saga-fg status
    """

    def run(stream: StreamTracker[Any], ready: Ready, stop: StopRequest) -> None:
        if listening.listen is None:
            try:
                ready()
                serve_pipe(stream, sys.stdin.buffer, sys.stdout.buffer, stop)
            except BrokenPipeError:
                typer.echo("the reader of the tracks has gone away", err=True)
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is buffered has nowhere to go
            return
        address = parse_address(listening.listen)
        if not address.is_local and not listening.allow_remote:
            raise InputError(
                f"--listen {listening.listen}: other machines could connect there; --allow-remote if that is meant"
            )
        SocketServer(stream, address, lambda at: ready(f"listening at {at}")).run(stop)

    _run(service, tracker, config, verbose, run, horizons=how.horizons(predict, tracker.method))


serve = how.as_command(_serve_stream)


@dataclass(frozen=True)
class NodeOptions:
    """Names of a node's messages, and what carries these."""

    classes: Annotated[
        str | None,
        typer.Option(
            "--classes", help="Names of classes: CAR=car. `SIGN=` leaves a class out.", metavar="THEIRS=OURS,..."
        ),
    ] = None
    world: Annotated[str, typer.Option("--world", help="Frame to track in.", metavar="FRAME")] = WORLD
    ego: Annotated[str, typer.Option("--ego", help="Frame of the vehicle.", metavar="FRAME")] = DEFAULT_EGO
    odometry: Annotated[
        str | None,
        typer.Option(
            "--odometry", help="Topic of nav_msgs/Odometry for the pose, beside /tf and /tf_static.", metavar="TOPIC"
        ),
    ] = None
    middleware: Annotated[
        Literal["rclpy", "cyclonedds"] | None,
        typer.Option(
            "--middleware",
            help="rclpy: a node of the ROS 2 that is installed; cyclonedds: DDS without ROS.  [default: rclpy if it is "
            "installed]",
        ),
    ] = None


def _serve_ros2(
    detections: Annotated[
        list[str],
        typer.Option(
            "--detections",
            help="Topic of vision_msgs/Detection3DArray or Autoware's DetectedObjects or TrackedObjects, a sensor of "
            "its own; repeatable.",
            metavar="[SENSOR=]TOPIC",
        ),
    ],
    tracks: Annotated[
        list[str],
        typer.Option(
            "--tracks",
            help="Topic to publish; TYPE: TrackedObjects, Detection3DArray or MarkerArray, by the detections if left "
            "out; repeatable.",
            metavar="[TYPE=]TOPIC",
        ),
    ],
    service: ServiceOptions,
    tracker: how.TrackerOptions,
    node: NodeOptions,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Track live as a node of ROS 2: topics of detections in, tracks out. Needs [ros2], no ROS.

    The domain is that of ROS_DOMAIN_ID; without ROS, network interfaces are those of CYCLONEDDS_URI. Types and quality
    of service of the detections are those of their publishers. `saga-fg docs guides/ros2` has an example.

    SIGTERM and Ctrl-C finish what has come in; the exit code is then 143 or 0.

    \b
    Examples:
      saga-fg serve ros2 --detections /perception/objects --tracks /tracks
      saga-fg serve ros2 --detections lidar=/lidar/objects --detections radar=/radar/objects --tracks /tracks
      saga-fg serve ros2 --detections /objects --tracks TrackedObjects=/tracks --tracks MarkerArray=/markers
      saga-fg serve ros2 --detections /roadside --world mast --tracks /tracks --snapshot state.saga
    """
    from pipelines.serving.ros2 import Ros2Node, result_topics, shown_tracks

    topics = sensor_topics("--detections", detections)
    options = RecordingOptions(topics, pairs("--classes", node.classes), node.world, node.ego, node.odometry)
    results = result_topics(tracks)

    def run(stream: StreamTracker[Any], ready: Ready, stop: StopRequest) -> None:
        served = Ros2Node(stream, options, results, node.middleware)
        ready(served.about)
        served.run(stop)

    def option_for(mend: Mend) -> str:
        return option_text({"classes": mend.classes})

    _run(service, tracker, config, verbose, run, option_for, shown=shown_tracks)


serve_ros2 = how.as_command(_serve_ros2)
Ready = Callable[..., None]


def _run(
    service: ServiceOptions,
    tracker: how.TrackerOptions,
    config: Path | None,
    verbose: bool,
    run: Callable[[StreamTracker[Any], Ready, StopRequest], None],
    option_for: Callable[[Mend], str] = lambda mend: "",
    **answers: Any,
) -> None:
    """Run a service until its source ends or it is told to stop.

    option_for  the options of the command that mend a suspicion; answers: how the stream answers
    """
    if not verbose:
        for handler in logging.getLogger().handlers:
            handler.addFilter(LogLimitFilter())
    method = tracker.method
    how.check_learn_offsets(service.learn_offsets, method)
    family = "dense" if service.settings == "dense" else "file"
    settings = tracker.configured(family, config)
    if service.settings is not None and config is not None:
        typer.echo(f"{config}: over --settings {service.settings}", err=True)
    bounds = StreamSettings() if service.limits is None else load_settings(StreamSettings, service.limits)
    if service.reorder is not None:
        bounds = replace(bounds, reorder=service.reorder)
    undecided = service.settings is None and config is None and method != "centerpoint"
    checks = Checks(settings.of_method(method), load_config(family), option_for, undecided)
    stream: StreamTracker[Any] = StreamTracker(lambda: settings.new_tracker(method), bounds, checks, **answers)
    return_large_blocks()
    kept = service.snapshot
    keeper = None if kept is None else _restored(stream, kept, service.every, settings, method)

    def ready(line: str = "") -> None:
        load_kernels()
        if keeper is not None:
            keeper.start()
        if line:
            typer.echo(line, err=True)

    last_acts = () if keeper is None else (keeper.save, keeper.clear_leftovers)
    with one_thread(), StopRequest(bounds.stop_timeout, *last_acts) as stop:
        run(stream, ready, stop)
        if keeper is not None:
            keeper.stop()
        typer.echo(_summary(stream.status()), err=True)
        if service.learn_offsets is not None:
            how.write_offsets(service.learn_offsets, [stream.clocks()], settings, "a stream")
    if stop.number == signal.SIGTERM:
        raise typer.Exit(TERMINATED)


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
