"""`saga-fg slam`: trajectories, maps and landmarks from recorded scans, and pose graphs from files."""

import itertools
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from data_tools.files import check_writable_folder
from data_tools.laser import read_carmen
from data_tools.lidar import PERIOD, ScanSequence
from data_tools.pose_graphs import read_g2o
from data_tools.recordings import LAYOUTS, RecordingOptions, ScanRecording, is_bag, open_recording, read_bag_laser
from data_tools.sensor_logs import SensorLog
from factors import Robust
from pipelines.cli.console import counted, new_group, progress_bar, working
from pipelines.cli.options import Config, Verbose, as_command
from pipelines.slam.configuration import load_slam_config, sensor_log
from pipelines.slam.drive import Origin, SlamMap, read_map
from pipelines.slam.laser_slam import laser_slam
from pipelines.slam.lidar_slam import LidarSlamSettings, Watch, lidar_slam, path_tracker, with_objects
from pipelines.slam.localisation import LocaliserSettings, localise
from pipelines.slam.merging import merge_sessions, read_session
from pipelines.slam.results import (
    write_laser_slam,
    write_lidar_slam,
    write_localised,
    write_merged,
    write_pose_graph,
)
from saga_fg import InputError
from saga_fg.errors import error_context
from saga_fg.numerics import IntArray, yaw_transform
from saga_fg.providers.vehicle_sensors import mounting
from saga_fg.slam.pose_graph import consensus, graph_error, optimise_poses


@dataclass(frozen=True)
class SourceOptions:
    """How a recording is read."""

    layout: Annotated[
        str | None,
        typer.Option(
            "--layout",
            help=f"One of {', '.join(LAYOUTS)}; MODULE:NAME, or an installed entry point: your own.  "
            "[default: found by looking]",
            metavar="NAME",
        ),
    ] = None
    sequence: Annotated[
        str | None,
        typer.Option(
            "--sequence", help="One of several: of KITTI, a scene of nuScenes, a sensor of HeLiPR.", metavar="NAME"
        ),
    ] = None
    topic: Annotated[
        list[str] | None,
        typer.Option(
            "--topic",
            help="Of a bag with several: the topic of scans, or imu=, gps=, wheels= and that of a sensor; repeatable.",
            metavar="[SENSOR=]TOPIC",
        ),
    ] = None
    ego: Annotated[str, typer.Option("--ego", help="Frame of the vehicle in a bag.", metavar="FRAME")] = "base_link"
    mount: Annotated[
        str | None,
        typer.Option(
            "--mount",
            help="x,y,z,roll,pitch,yaw of the LiDAR on the vehicle, m and rad.  [default: as recorded]",
            metavar="NUMBERS",
        ),
    ] = None
    period: Annotated[float, typer.Option("--period", min=1e-4, help="Time between scans that have none, s.")] = PERIOD
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None
    deskew: Annotated[
        bool, typer.Option("--deskew/--no-deskew", help="Take the motion within a turn out of the scans.")
    ] = True

    def opened(self, source: Path, seed: int) -> ScanRecording:
        """The recording. Raises `InputError` naming the option or the file that is wrong."""
        topics: dict[str, str] = {}
        for value in self.topic or ():
            sensor, equals, topic = value.rpartition("=")
            if (sensor or "lidar") in topics or not topic:
                raise InputError(f"--topic {value[:60]}: expected TOPIC or SENSOR=TOPIC, once for each sensor")
            topics[sensor if equals else "lidar"] = topic
        place = None
        if self.mount is not None:
            x, y, z, *turn = _numbers("--mount", "x,y,z,roll,pitch,yaw, m and rad", 6, self.mount)
            place = mounting("--mount", (x, y, z, turn[0], turn[1], turn[2])).matrix()
        options = RecordingOptions(self.sequence, self.period, self.deskew, self.scans, topics, self.ego, place, seed)
        return open_recording(source, options, self.layout)


@dataclass(frozen=True)
class DriveOptions:
    """Landmarks and objects as nodes of the graph, and whether one looks on."""

    landmarks: Annotated[
        bool, typer.Option("--landmarks/--no-landmarks", help="Walls and poles as nodes of the graph.")
    ] = True
    objects: Annotated[
        bool, typer.Option("--objects", help="The objects of a detector as nodes of the same graph.")
    ] = False
    detections: Annotated[
        Path | None,
        typer.Option(
            "--detections",
            help="Folder of a detector: Car/, Pedestrian/, Cyclist/; SOURCE/detections/pointrcnn if not given.",
        ),
    ] = None
    view: Annotated[bool, typer.Option("--view", help="Show path and map in rerun's viewer (extra [view]).")] = False


@dataclass(frozen=True)
class LoggedOptions:
    """Further sensors of the vehicle."""

    sensors: Annotated[
        str,
        typer.Option(
            "--sensors",
            help="Some of gps,imu,wheels that the recording has. KITTI's are made from its GPS/IMU: fixes and speeds "
            "with noise added, as the result is compared with them; inertial samples as recorded, at 10 Hz.",
        ),
    ] = ""
    sensor_logs: Annotated[
        list[str] | None,
        typer.Option("--sensor-log", help="A table of your own in their place: gps=FILE, imu=FILE or wheels=FILE."),
    ] = None
    seed: Annotated[int | None, typer.Option("--seed", help="Of the noise of --sensors; 0 if not given.")] = None


@dataclass(frozen=True)
class MapOptions:
    """The map of an earlier run, to localise in."""

    known_map: Annotated[
        Path | None,
        typer.Option("--map", help="Localise in the map of an earlier run, its output folder, in place of SLAM."),
    ] = None
    guess: Annotated[
        str | None,
        typer.Option(
            "--guess",
            help="x,y,z,yaw of the vehicle at the first scan in that map, m and rad, good to a metre or two and "
            "0.1 rad; the place is looked for without it, and where the scans do not fit the map there.",
        ),
    ] = None


def scans(
    source: Annotated[Path, typer.Argument(help="Folder of scans, bag, or dataset.", metavar="SOURCE")],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    reading: SourceOptions,
    drive: DriveOptions,
    logged: LoggedOptions,
    earlier: MapOptions,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """LiDAR SLAM on recorded scans: poses, walls, poles and, with --objects, what moves, in one graph.

    SOURCE is a folder of scans (.bin, .pcd, .ply, .las, .npy, .npz), MCAP, a bag of ROS 2 with PointCloud2, KITTI
    (tracking or odometry), MulRan, HeLiPR, Newer College, Hilti or nuScenes.

    Writes the path (trajectory.txt with times.txt, trajectory.tum), those to compare it with (odometry.tum, online.tum,
    reference.tum), covariances.csv, the points (map.ply; map/ for --map), the landmarks (landmarks.csv,
    landmarks.json), the graph (graph.g2o, observations.csv), with --objects the objects in the world (tracks.csv), a
    picture from above (above.png) and the errors against the recording's poses, if it has any (metrics.json).

    With --map it writes the path in the frame of that map (trajectory.txt with times.txt, trajectory.tum),
    covariances.csv, reference.tum, above.png and metrics.json.

    --objects needs KITTI tracking.

    \b
    Examples:
      saga-fg slam scans my_scans --output slam
      saga-fg slam scans drive.mcap --sensors imu --output slam
      saga-fg slam scans bag --topic /points --topic imu=/imu/data --ego body --sensors imu --output slam
      saga-fg slam scans data/kitti --sequence 0000 --sensors gps,imu,wheels --output slam
      saga-fg slam scans data/kitti --sequence 0000 --map slam --output again
      saga-fg slam scans data/kitti --sequence 0000 --objects --output slam
      saga-fg slam scans data/kitti_odometry --sequence 07 --output slam
    """
    if drive.view and earlier.known_map is not None:
        raise InputError("--view: expected without --map")
    if drive.view:
        from pipelines.view import load_rerun

        load_rerun()
    if drive.detections is not None and not drive.objects:
        raise InputError("--detections: expected with --objects only")
    if earlier.known_map is None and earlier.guess is not None:
        raise InputError("--guess: expected with --map only")
    if earlier.known_map is not None and (drive.objects or not drive.landmarks):
        raise InputError("--map: expected without --objects and --no-landmarks")
    if earlier.known_map is not None and earlier.known_map.resolve() == output.resolve():
        raise InputError("--output: expected another folder than that of --map, whose run would lose its files")
    place = os.path.realpath(source)
    if os.path.realpath(output) in (place, str(Path(place).parent), os.path.realpath(source.parent)):
        raise InputError(f"--output {output}: expected another folder than SOURCE and the one that it is in")
    if logged.seed is not None and not logged.sensors:
        raise InputError("--seed: expected with --sensors only")
    check_writable_folder(output)
    settings = load_slam_config("kitti", config)
    slam, slam_map = settings.slam, None if earlier.known_map is None else read_map(earlier.known_map)
    if slam_map is not None and (slam.providers or slam.landmarks):
        raise InputError("--config: slam.providers, slam.landmarks: expected without --map, where nothing reads them")
    with working("reading"):
        recording = reading.opened(source, logged.seed or 0)
    frames = []
    if drive.objects:
        if recording.objects is None:
            raise InputError(
                f"--objects: expected a recording with detections, as KITTI tracking, got {recording.layout}"
            )
        frames = list(recording.objects(drive.detections))

    def origin() -> Origin:
        """Latitude, longitude and altitude of the origin of the map."""
        if slam_map is None or slam_map.origin is None:
            raise InputError(
                f"{earlier.known_map}: expected a map with origin.csv, its place on Earth, which fixes need"
            )
        return slam_map.origin

    log = sensor_log(
        recording, logged.sensors, logged.sensor_logs or (), slam.sensors, None if slam_map is None else origin
    )
    if log is not None and "gps" in log.tables and recording.origin is None:
        recording = replace(recording, world_T_ego=None)  # which is not the world of the fixes
    if slam_map is not None:
        _localise(recording, slam_map, earlier.guess, slam.localisation, output, log)
        return
    shown, number = _opened_viewer(output.name) if drive.view else None, itertools.count(1)
    with progress_bar(unit="scans") as progress:

        def watch(*placed: Any) -> None:
            if shown is not None:
                shown(*placed)
            progress("slam", next(number), len(recording))

        lidar = replace(slam.lidar, landmarks=slam.lidar.landmarks and drive.landmarks)
        result = lidar_slam(
            recording,
            settings=lidar,
            providers=slam.new_providers(),
            detectors=slam.new_detectors(),
            log=log,
            objects=(frames, path_tracker(settings)) if drive.objects else None,
            watch=watch,
        )
    if drive.objects:
        with working("objects"):
            result = with_objects(result, recording, frames, settings, lidar, slam.new_providers, log)
    figures = write_lidar_slam(output, result, recording, settings=lidar, origin=recording.origin)
    counts = [counted(len(recording), "scan"), counted(figures["keyframes"], "keyframe")]
    counts += [counted(number, name) for name, number in figures["landmarks"].items()]
    counts.append(counted(figures["loops"], "loop"))
    if drive.objects:
        counts.append(counted(figures["objects"], "object"))
    typer.echo(f"{output}: {', '.join(counts)}")
    compared = ["odometry", "online", *(["without_objects"] if drive.objects else []), "trajectory"]
    for name in compared if recording.world_T_ego is not None else ():
        e, what = figures[name], name.replace("_", " ")
        relative = f"no RPE on a path shorter than {e['relative_distance']:g} m"
        if e["pieces"]:
            turn = 57.29578 * e["relative_rotation"]
            relative = f"RPE {e['relative_translation']:.3f} m and {turn:.3f} deg per {e['relative_distance']:g} m"
        typer.echo(f"{what} against the recording: ATE {e['ate']:.3f} m, {relative}, end {e['end_error']:.3f} m")
    for span in figures["degenerate"]:
        typer.echo(f"scans {span['first']} to {span['last']} leave open: {', '.join(span['motions'])}")
    if recording.dropped:
        typer.echo(
            f"points without a place: {sum(recording.dropped.values())} in {counted(len(recording.dropped), 'scan')}"
        )


def _opened_viewer(name: str) -> Watch:
    """Rerun's viewer on the screen; returns what draws each scan there."""
    from pipelines.view import RerunViewer, draw_slam_step

    viewer = RerunViewer(name, ["slam"])
    return lambda *placed: viewer.draw(draw_slam_step(*placed))


def _localise(
    scans: ScanSequence,
    slam_map: SlamMap,
    guess: str | None,
    settings: LocaliserSettings,
    output: Path,
    log: SensorLog | None,
) -> None:
    with progress_bar() as progress:
        start = None if guess is None else yaw_transform(*_numbers("--guess", "x,y,z,yaw, m and rad", 4, guess))
        found = localise(scans, slam_map, start, settings, progress, log)
    figures = write_localised(output, found, scans, slam_map)
    registered = (
        f"{figures['registered']} registered with the map, the first of them scan {figures['first_registered']}"
    )
    typer.echo(f"{output}: {counted(figures['scans'], 'scan')}, {registered}")
    for name, what in (("trajectory", "in the map's frame"), ("aligned", "aligned with it")):
        if name in figures:
            ate, end = figures[name]["ate"], figures[name]["end_error"]
            typer.echo(f"against the recording, {what}: ATE {ate:.3f} m, end {end:.3f} m")


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Output folders of `saga-fg slam scans`.", metavar="RUN RUN ...")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    verbose: Verbose = False,
) -> None:
    """Put several drives into one map, in the world of the first.

    Places that the drives have in common are looked for without a guess and become loops between the drives; false ones
    are left out. Writes the path of each drive (paths/NAME.tum), the map (map.ply; map/ for --map), the graph
    (graph.g2o), a picture from above (above.png) and counts (metrics.json).

    \b
    Examples:
      saga-fg slam merge monday tuesday --output both
      saga-fg slam merge runs/* --output town
      saga-fg slam scans wednesday.mcap --map town --output in_town
    """
    names = [run.resolve().name for run in runs]
    if len(runs) < 2 or len(set(names)) < len(names):
        raise InputError(f"RUN: expected two folders or more of different names, got {', '.join(names)}")
    if any(output.resolve() in (run.resolve(), *run.resolve().parents) for run in runs):
        raise InputError(f"--output {output}: expected another folder than the runs' and those that they are in")
    check_writable_folder(output)
    with progress_bar(unit="drives") as progress:
        merged = merge_sessions([read_session(run) for run in runs], progress)
    figures = write_merged(output, merged, LidarSlamSettings().map_spacing)
    loops = (
        f"{counted(figures['loops_between'], 'loop')} between them, {figures['false_loops_between']} left out as false"
    )
    typer.echo(f"{output}: {counted(len(runs), 'drive')}, {counted(figures['submaps'], 'submap')}, {loops}")


def _numbers(option: str, what: str, count: int, text: str) -> list[float]:
    """Finite numbers of a text "1.5,-3,1.8,0.2"."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option}: expected {what}, got {text[:60]!r}")
    return values


Loss = Literal["consensus", "huber", "cauchy", "geman-mcclure", "tukey"]
_LOSS_SCALE = 3.0  # standard deviations, of losses over loops


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
    project: Annotated[bool, typer.Option("--project", help="Project indefinite information, and count it.")] = False,
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
    check_writable_folder(output)
    rejected: list[str] = []
    loss = None if robust is None or robust == "consensus" else Robust(robust, _LOSS_SCALE)
    graph = read_g2o(file, project)
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
    settings = load_slam_config("kitti", config).slam.laser
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
for run in (scans, merge, g2o, laser):
    slam_app.command()(as_command(run))
