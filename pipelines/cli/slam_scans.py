"""`saga-fg slam scans`: trajectory, map and landmarks from recorded LiDAR scans."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from data_tools.files import check_writable_folder
from data_tools.lidar import PERIOD, ScanSequence
from data_tools.recordings import LAYOUTS, RecordingOptions, ScanRecording, open_recording
from data_tools.sensor_logs import SensorLog
from pipelines.cli.console import counted, progress_bar, working
from pipelines.cli.options import Config, Verbose
from pipelines.slam.configuration import load_slam_config, sensor_log
from pipelines.slam.lidar_slam import lidar_slam, path_tracker, with_objects
from pipelines.slam.localisation import LocaliserSettings, localise
from pipelines.slam.results import write_lidar_slam, write_localised
from pipelines.slam.submaps import Origin, SlamMap, read_map
from saga_fg.errors import InputError
from saga_fg.numerics import yaw_transform
from saga_fg.providers.vehicle_sensors import mounting


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

    def opened(self, source: Path, seed: int, blind: bool) -> ScanRecording:
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
        options = RecordingOptions(
            self.sequence, self.period, self.deskew, self.scans, blind, topics, self.ego, place, seed
        )
        return open_recording(source, options, self.layout)


@dataclass(frozen=True)
class DriveOptions:
    """What of a drive goes into the graph."""

    odometry: Annotated[
        Literal["lidar", "recorded"],
        typer.Option("--odometry", help="Motion between scans: by registration, or the recording's own poses."),
    ] = "lidar"
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

    --objects needs KITTI tracking; with --odometry recorded it needs no scans.

    \b
    Examples:
      saga-fg slam scans my_scans --output slam
      saga-fg slam scans drive.mcap --sensors imu --output slam
      saga-fg slam scans bag --topic /points --topic imu=/imu/data --ego body --sensors imu --output slam
      saga-fg slam scans data/kitti --sequence 0000 --sensors gps,imu,wheels --output slam
      saga-fg slam scans data/kitti --sequence 0000 --map slam --output again
      saga-fg slam scans data/kitti --sequence 0004 --objects --odometry recorded --output slam
      saga-fg slam scans data/kitti_odometry --sequence 07 --output slam
    """
    if drive.detections is not None and not drive.objects:
        raise InputError("--detections: expected with --objects only")
    if earlier.known_map is None and earlier.guess is not None:
        raise InputError("--guess: expected with --map only")
    if earlier.known_map is not None and (drive.objects or drive.odometry == "recorded" or not drive.landmarks):
        raise InputError("--map: expected without --objects, --no-landmarks and --odometry recorded")
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
    blind = drive.objects and drive.odometry == "recorded"
    with working("reading"):
        recording = reading.opened(source, logged.seed or 0, blind)
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
    with progress_bar(unit="scans") as progress:
        lidar = replace(
            slam.lidar,
            landmarks=slam.lidar.landmarks and drive.landmarks and not recording.blind,
            loop_closures=slam.lidar.loop_closures and not recording.blind,
        )
        tracker = path_tracker(settings) if drive.objects and not recording.blind else None
        result = lidar_slam(
            recording,
            drive.odometry,
            settings=lidar,
            progress=progress,
            providers=slam.new_providers(),
            detectors=slam.new_detectors(),
            log=log,
            objects=None if tracker is None else (frames, tracker),
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
    if drive.odometry == "recorded":  # these are the recording itself
        compared = ["trajectory"]
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


def _numbers(option: str, what: str, count: int, text: str) -> list[float]:
    """Finite numbers of a text "1.5,-3,1.8,0.2"."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option}: expected {what}, got {text[:60]!r}")
    return values
