"""`saga-fg slam`: trajectories and maps, from recordings and graph files."""

import math
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from data_tools.files import check_writable_folder
from data_tools.laser import read_carmen
from data_tools.pose_graphs import read_g2o
from data_tools.recordings import RecordingOptions, is_bag, read_bag_laser
from factors import Robust
from pipelines.cli.console import counted, new_group, progress_bar, working
from pipelines.cli.options import Config, Verbose, as_command
from pipelines.cli.slam_scans import scans
from pipelines.slam.configuration import load_laser_settings
from pipelines.slam.laser_slam import laser_slam
from pipelines.slam.results import write_laser_slam, write_pose_graph
from saga_fg import InputError
from saga_fg.errors import error_context
from saga_fg.numerics import IntArray
from saga_fg.slam.pose_graph import consensus, graph_error, optimise_poses

Loss = Literal["consensus", "huber", "cauchy", "geman-mcclure", "tukey"]


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
    graph = read_g2o(file)
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
        count += len(graph.landmarks.pose)
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


slam_app = new_group("Estimate where the vehicle was and what stands around it, in one factor graph.")
for run in (scans, g2o, laser):
    slam_app.command()(as_command(run))
