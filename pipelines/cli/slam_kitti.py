"""`saga-fg slam kitti`: trajectory, map and landmarks of a KITTI sequence from its LiDAR scans."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from data_tools.datasets.kitti import KittiScans, KittiTracking
from data_tools.datasets.kitti.dataset import read_origin
from data_tools.files.atomic_files import check_writable_folder
from data_tools.lidar.scan import ScanSequence
from data_tools.sensor_logs import SensorLog
from pipelines.cli.console import counted, progress_bar, working
from pipelines.cli.options import Config, Lag, Online, Verbose, online_window
from pipelines.slam.configuration import load_slam_config, sensor_log
from pipelines.slam.joint import path_tracker, with_objects
from pipelines.slam.lidar_results import write_lidar_slam
from pipelines.slam.lidar_slam import lidar_slam
from pipelines.slam.localisation import LocaliserSettings
from pipelines.slam.localised_drive import localise, write_localised
from pipelines.slam.submaps import Origin, SlamMap, read_map
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_transform


@dataclass(frozen=True)
class DriveOptions:
    """A sequence, and what of it goes into the graph."""

    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000"
    odometry: Annotated[
        Literal["lidar", "oxts"],
        typer.Option("--odometry", help="Motion between scans: by registration, or the recording's GPS/IMU."),
    ] = "lidar"
    deskew: Annotated[
        bool, typer.Option("--deskew/--no-deskew", help="Take the motion within a turn out of the scans.")
    ] = True
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
            help="Folder of a detector: Car/, Pedestrian/, Cyclist/; DATAROOT/detections/pointrcnn if not given.",
        ),
    ] = None


@dataclass(frozen=True)
class LoggedOptions:
    """Further sensors of the vehicle."""

    sensors: Annotated[
        str,
        typer.Option(
            "--sensors",
            help="Some of gps,imu,wheels, from the GPS/IMU records: fixes and speeds with noise added, as the result "
            "is compared with them; inertial samples as recorded, at 10 Hz.",
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


@dataclass(frozen=True)
class ExtentOptions:
    """How much is estimated, and when."""

    online: Online = False
    lag: Lag = None
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None


def kitti(
    *,
    dataroot: Annotated[Path, typer.Option("--dataroot", help="KITTI tracking: training/, or oxts/ and velodyne/.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    drive: DriveOptions,
    logged: LoggedOptions,
    earlier: MapOptions,
    extent: ExtentOptions,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """LiDAR SLAM on a KITTI sequence: poses, walls, poles and, with --objects, what moves, in one graph.

    Writes the path (trajectory.txt with times.txt, trajectory.tum), those to compare it with (odometry.tum, online.tum,
    reference.tum), covariances.csv, the points (map.ply; map/ for --map), the landmarks (landmarks.csv, landmarks.json,
    landmarks.ply), the graph (graph.g2o, observations.csv), with --objects the objects in the world (tracks.csv), a
    picture from above (above.png) and the errors against GPS/IMU (metrics.json).

    With --map it writes the path in the frame of that map (trajectory.txt with times.txt, trajectory.tum),
    covariances.csv, reference.tum, above.png and metrics.json.

    With --objects and --odometry oxts a sequence needs no scans.

    \b
    Examples:
      saga-fg slam kitti --dataroot data/kitti --sequence 0000 --output slam
      saga-fg slam kitti --dataroot data/kitti --sequence 0000 --sensors gps,imu,wheels --output slam
      saga-fg slam kitti --dataroot data/kitti --sequence 0000 --map slam --output again
      saga-fg slam kitti --dataroot data/kitti --sequence 0000 --objects --output slam
      saga-fg slam kitti --dataroot data/kitti --sequence 0004 --objects --odometry oxts --output slam
    """
    if drive.detections is not None and not drive.objects:
        raise InputError("--detections: expected with --objects only")
    if extent.online and not drive.objects:
        raise InputError("--online: expected with --objects; without them the poses are estimated online in any case")
    if earlier.known_map is None and earlier.guess is not None:
        raise InputError("--guess: expected with --map only")
    if earlier.known_map is not None and (drive.objects or drive.odometry == "oxts" or not drive.landmarks):
        raise InputError("--map: expected without --objects, --no-landmarks and --odometry oxts")
    if earlier.known_map is not None and earlier.known_map.resolve() == output.resolve():
        raise InputError("--output: expected another folder than that of --map, whose run would lose its files")
    if logged.seed is not None and not logged.sensors:
        raise InputError("--seed: expected with --sensors only")
    window = online_window(extent.online, extent.lag)
    check_writable_folder(output)
    frames, settings = [], load_slam_config("kitti", config)
    slam = settings.slam
    if drive.objects:
        detector = drive.detections or dataroot / "detections" / "pointrcnn"
        frames = list(KittiTracking(dataroot, detector, [drive.sequence]).scene(drive.sequence).frames)
    training = dataroot / "training" if (dataroot / "training").is_dir() else dataroot
    blind = drive.objects and drive.odometry == "oxts" and not (training / "velodyne" / drive.sequence).is_dir()
    recorded = KittiScans(dataroot, drive.sequence, timed=drive.deskew, most=extent.scans, blind=blind)
    records = training / "oxts" / f"{drive.sequence}.txt"
    slam_map = None if earlier.known_map is None else read_map(earlier.known_map)
    if slam_map is not None and (slam.providers or slam.landmarks):
        raise InputError("--config: slam.providers, slam.landmarks: expected without --map, where nothing reads them")

    def origin() -> Origin:
        """Latitude, longitude and altitude of the origin of a map, or else of the recording's world."""
        if slam_map is None:
            return read_origin(records)
        if slam_map.origin is None:
            raise InputError(
                f"{earlier.known_map}: expected a map with origin.csv, its place on Earth, which fixes need"
            )
        return slam_map.origin

    log = sensor_log(
        records, logged.sensors, logged.sensor_logs or (), logged.seed or 0, recorded.timestamps, origin, slam.sensors
    )
    if slam_map is not None:
        _localise(recorded, slam_map, earlier.guess, slam.localisation, output, log)
        return
    with progress_bar() as progress:
        lidar = replace(
            slam.lidar,
            landmarks=slam.lidar.landmarks and drive.landmarks and not blind,
            loop_closures=slam.lidar.loop_closures and not blind,
        )
        tracker = path_tracker(settings) if drive.objects and not blind else None
        result = lidar_slam(
            recorded,
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
            result = with_objects(result, recorded, frames, settings, lidar, window, slam.new_providers, log)
    figures = write_lidar_slam(output, result, recorded, settings=lidar, origin=origin())
    counts = [counted(len(recorded), "scan"), counted(figures["keyframes"], "keyframe")]
    counts += [counted(number, name) for name, number in figures["landmarks"].items()]
    counts.append(counted(figures["loops"], "loop"))
    if drive.objects:
        counts.append(counted(figures["objects"], "object"))
    typer.echo(f"{output}: {', '.join(counts)}")
    compared = ["odometry", "online", *(["without_objects"] if drive.objects else []), "trajectory"]
    if drive.odometry == "oxts":  # these are the recording itself
        compared = [*(["online"] if extent.online else []), "trajectory"]
    for name in compared:
        e, what = figures[name], name.replace("_", " ")
        relative = f"no RPE on a path shorter than {e['relative_distance']:g} m"
        if e["pieces"]:
            turn = 57.29578 * e["relative_rotation"]
            relative = f"RPE {e['relative_translation']:.3f} m and {turn:.3f} deg per {e['relative_distance']:g} m"
        typer.echo(f"{what} against GPS/IMU: ATE {e['ate']:.3f} m, {relative}, end {e['end_error']:.3f} m")
    for span in figures["degenerate"]:
        typer.echo(f"scans {span['first']} to {span['last']} leave open: {', '.join(span['motions'])}")
    if not blind:
        typer.echo(f"mean scan-to-map residual: {1e3 * figures['scan_to_map_residual']:.1f} mm")


def _localise(
    scans: ScanSequence,
    slam_map: SlamMap,
    guess: str | None,
    settings: LocaliserSettings,
    output: Path,
    log: SensorLog | None,
) -> None:
    with progress_bar() as progress:
        start = None if guess is None else _guess(guess)
        found = localise(scans, slam_map, start, settings, progress, log)
    figures = write_localised(output, found, scans, slam_map)
    registered = (
        f"{figures['registered']} registered with the map, the first of them scan {figures['first_registered']}"
    )
    typer.echo(f"{output}: {counted(figures['scans'], 'scan')}, {registered}")
    for name, what in (("trajectory", "in the map's frame"), ("aligned", "aligned with it")):
        typer.echo(f"against GPS/IMU, {what}: ATE {figures[name]['ate']:.3f} m, end {figures[name]['end_error']:.3f} m")


def _guess(numbers: str) -> FloatArray:
    """A pose (4, 4) of x, y, z, yaw as a text "1.5,-3,1.8,0.2", m and rad."""
    try:
        values = [float(word) for word in numbers.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not np.isfinite(values).all():
        raise InputError(f"--guess: expected x,y,z,yaw, m and rad, got {numbers[:60]!r}")
    return yaw_transform(*values)
