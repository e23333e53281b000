"""`saga-fg slam`: trajectories and maps, from recordings and graph files."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from data_tools import pose_graphs
from data_tools.files.atomic_files import check_writable_folder
from data_tools.files.input_files import error_context
from data_tools.laser import read_carmen
from data_tools.recordings import RecordingOptions, is_bag, read_bag_laser
from data_tools.simulator import simulate_scene
from factors import Robust
from pipelines.cli.console import counted, new_group, progress_bar, working
from pipelines.cli.options import Config, Lag, Online, Verbose, as_command, online_window
from pipelines.cli.slam_scans import scans
from pipelines.slam.configuration import load_laser_settings, load_slam_config
from pipelines.slam.joint import run_joint, street
from pipelines.slam.laser_slam import laser_slam
from pipelines.slam.results import write_joint, write_laser_slam, write_pose_graph
from saga_fg import Frame, InputError
from saga_fg.numerics.arrays import IntArray
from saga_fg.slam.joint import Observations
from saga_fg.slam.pose_graph import consensus, graph_error, optimise_poses

Loss = Literal["consensus", "huber", "cauchy", "geman-mcclure", "tukey"]
Shape = Literal["city", "torus", "sphere", "grid", "cube"]


def g2o(
    file: Annotated[Path, typer.Argument(help="Pose graph in the g2o format, in the plane or in space.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    certify: Annotated[
        bool,
        typer.Option("--certify", help="Find the global minimum of the chordal cost too, start from it, and prove it."),
    ] = False,
    covariances: Annotated[
        str,
        typer.Option(
            "--covariances", metavar="all|last|none|IDS", help="Poses in covariances.csv: IDS with commas between them."
        ),
    ] = "all",
    robust: Annotated[
        Loss | None,
        typer.Option(
            "--robust",
            help="Against false loops, measurements that do not join successive poses: leave out those that contradict "
            "the rest (consensus), or a loss over all of them.",
        ),
    ] = None,
    robust_scale: Annotated[
        float | None, typer.Option("--robust-scale", help="Scale of that loss, standard deviations.  [default: 3]")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Optimise a pose graph, whatever the guess in the file is worth.

    Writes the optimised graph (poses.g2o), covariances.csv, errors.json and a picture from above (above.png).

    \b
    Examples:
      saga-fg slam g2o sphere2500.g2o --output sphere
      saga-fg slam g2o MIT.g2o --output MIT
      saga-fg slam g2o CSAIL.g2o --output CSAIL --certify --covariances last
      saga-fg slam g2o with_false_loops.g2o --robust consensus --output clean
    """
    if robust not in (None, "consensus") and certify:
        raise InputError("--certify: expected without a robust loss, the proof is for squared errors")
    scale = 3.0 if robust_scale is None else robust_scale
    if not 0 < scale < math.inf:
        raise InputError(f"--robust-scale {scale:g}: expected a number > 0")
    if robust in (None, "consensus") and robust_scale is not None:
        raise InputError("--robust-scale: expected with --robust and the name of a loss only")
    check_writable_folder(output)
    rejected: list[str] = []
    loss = None if robust is None or robust == "consensus" else Robust(robust, scale)
    graph = pose_graphs.read_g2o(file)
    rows = _rows(covariances, graph.ids)
    with working("optimising"), error_context(str(file)):  # a graph that is whole may have no optimum, as one in pieces
        guess = graph_error(graph, loss)
        if robust == "consensus":
            agreed = consensus(graph)
            rejected = [
                f"{graph.ids[graph.first[k]]} {graph.ids[graph.second[k]]}" for k in (~agreed.kept).nonzero()[0]
            ]
            graph = agreed.graph
        optimised = optimise_poses(graph, loss, certify)
        blocks = optimised.covariances(rows)
    errors = {"guess itself": guess, **{f"from the {name}": error for name, error in optimised.errors.items()}}
    write_pose_graph(output, graph, optimised, rows, blocks, errors, rejected)
    poses, count = counted(len(graph), "pose"), len(graph.first)
    count += sum(len(one.pose) for one in (graph.priors, graph.places) if one is not None)
    if graph.landmarks is not None:
        poses += f", {counted(len(graph.landmarks.ids), 'landmark')}"
        count += sum(len(seen.pose) for seen in graph.landmarks.observations)
    typer.echo(
        f"{output}: {poses}, {counted(count, 'measurement')}, error {optimised.error:.6g} (at the start {guess:.6g})"
    )
    if robust == "consensus":
        typer.echo(f"left out as false: {counted(len(rejected), 'loop')}")
    if (minimum := optimised.chordal) is not None:
        proven = "the global minimum" if minimum.certified else "not proven to be the global minimum"
        typer.echo(f"chordal cost {minimum.cost:.8g}, {proven}: no poses below {minimum.bound:.8g}")


def _rows(chosen: str, ids: IntArray) -> IntArray:
    """Rows of the poses whose covariances are wanted."""
    if chosen in ("all", "last", "none"):
        return {"all": np.arange(len(ids)), "last": np.array([len(ids) - 1]), "none": np.arange(0)}[chosen]
    known = {str(name): row for row, name in enumerate(ids.tolist())}
    names = list(dict.fromkeys(name.strip() for name in chosen.split(",")))
    for name in names:
        if name in ("all", "last", "none"):
            raise InputError(f"--covariances: expected {name} alone or ids of poses with commas, got {chosen!r:.40}")
        if name not in known:
            raise InputError(f"--covariances: expected all, last, none or ids of poses with commas, got {name!r:.40}")
    return np.array([known[name] for name in names])


def generate(
    shape: Annotated[Shape, typer.Argument(help="city, grid: in the plane; torus, sphere, cube: in space.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="g2o file to write.")],
    poses: Annotated[int, typer.Option("--poses", min=2, help="Number of poses.")] = 10000,
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of a measurement, m.")] = 0.05,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same graph.")] = 0,
    verbose: Verbose = False,
) -> None:
    """Make a pose graph with loop closures, whose guess is dead reckoning.

    \b
    Example:
      saga-fg slam generate city --poses 10000 --output city.g2o
      saga-fg slam g2o city.g2o --output city
    """
    try:
        graph, _ = getattr(pose_graphs, shape)(poses, seed, noise=noise)
    except InputError as error:
        raise InputError(f"--{error}") from None
    pose_graphs.write_g2o(output, graph)
    residuals, free = graph.information.shape[1] * len(graph.first), graph.information.shape[1] * (len(graph) - 1)
    typer.echo(
        f"{output}: {counted(len(graph), 'pose')}, {counted(len(graph.first), 'measurement')}; "
        f"expected error of the optimum {(residuals - free) / 2:g}"
    )


def laser(
    file: Annotated[
        Path,
        typer.Argument(
            help="Log in CARMEN's format (FLASER or ROBOTLASER1), .bz2 and .gz too; MCAP or a bag of ROS 2 with "
            "LaserScan and odometry."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    topic: Annotated[
        str | None, typer.Option("--topic", help="Of a bag with several lasers: the topic of scans.", metavar="TOPIC")
    ] = None,
    ego: Annotated[str, typer.Option("--ego", help="Frame of the robot in a bag.", metavar="FRAME")] = "base_link",
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """SLAM with a planar laser: scan matching, loops by place, and one graph of keyframes.

    Writes the path at every scan (trajectory.tum; by scan matching alone, matched.tum; by the wheels, odometry.tum),
    the graph (poses.g2o), the map as a picture (map.png) and figures.json.

    \b
    Examples:
      saga-fg slam laser intel.clf.bz2 --output intel
      saga-fg slam laser drive.mcap --topic /scan --ego base_footprint --output drive
    """
    check_writable_folder(output)
    settings = load_laser_settings(config)
    if is_bag(file):
        topics = {} if topic is None else {"laser": topic}
        log = read_bag_laser(file, RecordingOptions(topics=topics, ego=ego))
    else:
        log = read_carmen(file)
    if scans is not None:
        log = log.first(scans)
    began = time.process_time()
    with progress_bar(unit="scans") as progress:
        path = laser_slam(log, settings, progress)
    seconds = time.process_time() - began
    figures = write_laser_slam(output, log, path, settings.largest_range, seconds)
    loops = f"{counted(path.loops, 'loop')}, {path.rejected} left out as false"
    typer.echo(f"{output}: {counted(len(log), 'scan')}, {counted(len(path.keyframes), 'keyframe')}, {loops}")
    entropy, alone = figures["entropy"], figures["entropy_scan_matching"]
    typer.echo(f"entropy of the map: {entropy:.0f} bits, by scan matching alone {alone:.0f}")
    used = f"{seconds:.1f} s" if seconds >= 1 else f"{1e3 * seconds:.0f} ms"
    typer.echo(f"{used} of CPU, {figures['times_real_time']:.0f} times real time")


def simulated(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the scene and of the odometry's errors.")] = 0,
    duration: Annotated[float, typer.Option("--duration", min=2.0, help="Length of the drive, s.")] = 20.0,
    online: Online = False,
    lag: Lag = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Drive down a simulated street with poor odometry; the path and all objects are estimated in one graph.

    With --online once more, frame by frame, in a window of the last seconds.

    Writes the paths (TUM, KITTI), the covariances of the poses, the tracks of the objects (tracks.csv), landmarks
    (landmarks.json), errors.json and a picture from above (above.png).

    \b
    Example:
      saga-fg slam simulated --seed 3 --output street
      saga-fg slam simulated --seed 3 --online --lag 2 --output street
    """
    window = online_window(online, lag)
    check_writable_folder(output)
    settings = load_slam_config("simulated", config)
    slam, detectors = settings.slam, settings.slam.new_detectors()

    def landmarks(frames: Sequence[Frame]) -> Observations:
        return [[seen for detector in detectors for seen in detector.observations(frame)] for frame in frames]

    scene = simulate_scene(replace(street(), duration=duration), seed)
    with working("estimating"):
        run = run_joint(scene, settings, slam.joint, "lidar", seed, landmarks, window, slam.new_providers)
        write_joint(output, run)
    errors = run.errors()
    joint = errors["joint"]
    typer.echo(f"{output}: {joint.poses} poses over {joint.path_length:.0f} m")
    typer.echo(f"ATE: odometry {errors['odometry'].ate:.3f} m, joint {joint.ate:.3f} m")
    for name in [name for name in errors if name not in ("odometry", "joint")]:
        typer.echo(f"{name} (lag {window:g} s): ATE {errors[name].ate:.3f} m")


slam_app = new_group("Estimate where the vehicle was and what stands around it, in one factor graph.")
for run in (scans, g2o, generate, laser, simulated):
    slam_app.command()(as_command(run))
