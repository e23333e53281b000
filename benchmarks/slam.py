"""LiDAR odometry against KISS-ICP, and what SLAM costs scan by scan.

Of odometry, each contender places every scan, ours first, theirs next. Three measures:

* the relative error over 10 m against the GPS/IMU poses, which have errors of their own,
* the mean residual of scans in the map of the scans around them, which needs no reference: each point q of a scan has k
  nearest neighbours in that map, with mean c and normal n (direction of the least spread); its residual is
  | n . (q - c) |. Wrong poses make surfaces thick, which increases residuals. Compare Razlaw et al., Evaluation of
  registration methods for sparse 3D laser scans, ECMR 2015 (mean plane variance);
* milliseconds a scan.

"as recorded" gives no times of points, and nobody de-skews; "de-skewed" gives both the times, and each removes the skew
with his own velocity. KISS-ICP dates a scan at the end of its sweep when it de-skews; its poses are moved back to the
middle, by its own velocity, before they are compared. Source: Vizzo et al., KISS-ICP, RA-L 2023.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import gtsam
import numpy as np
import typer
from scipy.spatial import cKDTree

from benchmarks.course import SimulatedCourse
from benchmarks.runner import Row, Rows, Seed, clocked, each, in_turn, timed
from benchmarks.scans import ScannerSettings
from data_tools.datasets.kitti import kitti_scans
from data_tools.lidar import Scan, constant_velocity, deskewed, voxel_downsample
from data_tools.lidar.scan import ScanSequence
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.lidar_slam import LidarSlam
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.slam.vehicle_sensors import Vehicle
from pipelines.tracking import one_thread, peak_memory
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points

OURS, KISS = "saga-fg", "kiss-icp"
SETTINGS = OdometrySettings()
EVERY = 50  # scans from one measurement of the machine's load to the next
NEIGHBOURS = 8
SPACING = 0.2  # m, of the map's points
THINNED = 0.5  # m, of the scan's
NEAREST_WITHIN = 0.5  # m; points without a neighbour this near are new and left out
FARTHEST = 50.0  # m from the sensor: beyond, rings are too far apart for planes

Place = Callable[[Scan, float], FloatArray]


def slam(
    dataroot: Annotated[
        Path | None, typer.Option("--dataroot", help="KITTI tracking: training/, or oxts/ and velodyne/.")
    ] = None,
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
    scans: Annotated[int | None, typer.Option("--scans", min=2, help="Only so many, from the first on.")] = None,
    kiss: Annotated[
        bool, typer.Option("--kiss/--no-kiss", help="With KISS-ICP, of the extra bench, or ours alone.")
    ] = True,
    dense: Annotated[
        int | None,
        typer.Option("--dense", min=2, help="Instead: SLAM all in on so many simulated scans of full density."),
    ] = None,
    firings: Annotated[
        int, typer.Option("--columns", min=100, help="With --dense: points of a beam; 2000 are full density.")
    ] = 2000,
    seed: Seed = 0,
) -> Rows:
    """LiDAR odometry against KISS-ICP, on the same scans in turn.

    RPE is the error over 10 m against GPS/IMU, which is itself not exact; the residual of scans in the map of their
    neighbours needs no reference. Both are printed for the scans as recorded and for de-skewed ones. Then follows the
    CPU time of SLAM all in: odometry, landmarks, graph and loops.

    \b
    Examples:
      python -m benchmarks slam --dataroot data/kitti --sequence 0000
      python -m benchmarks slam --dense 40
    """
    if (dataroot is None) == (dense is None):
        raise InputError("expected one of --dataroot and --dense")
    if dataroot is not None:
        recorded = kitti_scans(dataroot, sequence, most=scans)
        yield from odometry_rows(recorded, kiss)
        yield from all_in_rows(recorded)
    elif dense is not None:
        course = SimulatedCourse(seed, 0.8 * dense, settings=ScannerSettings(rings=64, columns=firings))
        yield from all_in_rows(course, course.lap)


def odometry_rows(scans: ScanSequence, kiss: bool = True) -> Iterator[Row]:
    """Each contender on the scans of each case. Raises `MissingExtraError` when `kiss` is wanted and not installed."""
    truth, ego_T_lidar = Trajectory(scans.timestamps, _poses(scans)), scans.ego_T_lidar
    for case, skewed in (("as recorded", False), ("de-skewed", True)):
        places: dict[str, Place] = {OURS: _ours(SETTINGS)}
        if kiss:
            places[KISS] = _kiss(skewed)
        poses: dict[str, list[FloatArray]] = {name: [] for name in places}

        def contender(name: str, place: Place, poses: Any = poses, skewed: bool = skewed) -> Callable[[int], Any]:
            def prepare(k: int) -> Callable[[], None]:
                scan, timestamp = scans[k] if skewed else replace(scans[k], time=None), float(scans.timestamps[k])
                return lambda: poses[name].append(place(scan, timestamp))

            return prepare

        contenders = {name: contender(name, place) for name, place in places.items()}
        times = in_turn(contenders, each(range(len(scans)), case))
        slowest = KISS if kiss else OURS
        for name, found in poses.items():
            map_T_lidar = np.array(found)
            path = Trajectory(scans.timestamps, ego_T_lidar @ map_T_lidar @ inverse_transform(ego_T_lidar))
            e, clouds = trajectory_errors(path, truth), still_clouds(scans, map_T_lidar, skewed)
            about = {"scans": case, "method": name, "RPE, m per 10 m": e.relative_translation}
            errors = {"RPE, deg per 10 m": float(np.degrees(e.relative_rotation)), "end, m": e.end_error}
            ms = float(np.median(times[name]))
            cost = {"ms a scan": ms, f"/ {slowest}": ms / float(np.median(times[slowest]))}
            residual = {"residual, mm": 1e3 * scan_to_map_residual(clouds, map_T_lidar)}
            yield "odometry against GPS/IMU", {**about, **errors, **residual, **cost}


def _ours(settings: OdometrySettings) -> Place:
    odometry = LidarOdometry(settings)
    return lambda scan, timestamp: odometry.step(scan, timestamp).map_T_lidar


def _kiss(skewed: bool) -> Place:
    """KISS-ICP with its own defaults, a voxel of 1 % of the reach among them, on one thread."""
    try:
        kiss_icp: Any = importlib.import_module("kiss_icp.kiss_icp")
        config: Any = importlib.import_module("kiss_icp.config")
    except ImportError as error:
        raise MissingExtraError(f'kiss-icp cannot be imported: {error}; `pip install "saga-fg[bench]"`') from error
    chosen = config.KISSConfig()
    chosen.mapping.voxel_size = SETTINGS.max_range / 100.0
    chosen.data.min_range, chosen.data.max_range, chosen.data.deskew = SETTINGS.min_range, SETTINGS.max_range, skewed
    chosen.registration.max_num_threads = 1
    pipeline = kiss_icp.KissICP(chosen)

    def place(scan: Scan, timestamp: float) -> FloatArray:
        share = np.zeros(len(scan))
        if scan.time is not None:  # of the sweep, from 0 to 1
            share = (scan.time - scan.time.min()) / max(float(np.ptp(scan.time)), 1e-9)
        pipeline.register_frame(np.array(scan.points), share)
        pose = np.asarray(pipeline.last_pose, dtype=np.float64)
        if not skewed:
            return pose
        half = gtsam.Pose3.Expmap(-0.5 * gtsam.Pose3.Logmap(gtsam.Pose3(pipeline.last_delta)))
        return np.asarray(pose @ half.matrix())

    return place


def still_clouds(scans: ScanSequence, map_T_lidar: FloatArray, skewed: bool) -> list[FloatArray]:
    """Points (N, 3) of each scan, in its sensor's frame, without skew if they have one: by the motion of the poses."""
    clouds = []
    for k in range(len(scans)):
        scan = scans[k].within(SETTINGS.min_range, SETTINGS.max_range)
        if skewed and scan.time is not None and len(scans) > 1:
            before = max(k - 1, 0)
            motion = inverse_transform(map_T_lidar[before]) @ map_T_lidar[before + 1]
            dt = float(scans.timestamps[before + 1] - scans.timestamps[before])
            scan = deskewed(scan, constant_velocity(motion, dt))
        clouds.append(scan.points)
    return clouds


def scan_to_map_residual(
    clouds: Sequence[FloatArray], world_T_lidar: FloatArray, around: int = 10, every: int = 5
) -> float:
    """Mean residual, m, of every fifth scan in the map of the ten before it and the ten after it; NaN for one scan.

    clouds         K scans without skew, points (N, 3) in the sensor's frame; asked for when they are needed
    world_T_lidar  (K, 4, 4)
    """
    residuals, thin = [np.empty(0)], dict[int, FloatArray]()
    for k in range(0, len(clouds), every):
        near = range(max(0, k - around), min(len(clouds), k + around + 1))
        thin = {j: thin[j] if j in thin else _thinned(clouds[j]) for j in near}
        others = [j for j in near if j != k]
        if others:
            map_points = np.concatenate([transform_points(world_T_lidar[j], thin[j]) for j in others])
            residuals.append(_residuals(thin[k], map_points, world_T_lidar[k]))
    found = np.concatenate(residuals)
    return float(found.mean()) if len(found) else float("nan")


def _thinned(cloud: FloatArray) -> FloatArray:
    return cloud[voxel_downsample(cloud, SPACING)]


def _residuals(scan: FloatArray, map_points: FloatArray, world_T_lidar: FloatArray) -> FloatArray:
    scan = scan[np.linalg.norm(scan, axis=1) <= FARTHEST]
    points = transform_points(world_T_lidar, scan[voxel_downsample(scan, THINNED)])
    map_points = map_points[voxel_downsample(map_points, SPACING)]
    if len(map_points) < NEIGHBOURS:
        return np.empty(0)
    distance, row = cKDTree(map_points).query(points, k=NEIGHBOURS)
    near = distance[:, 0] <= NEAREST_WITHIN
    around = map_points[row[near]]
    mean = around.mean(axis=1)
    off = around - mean[:, None]
    normal = np.linalg.eigh(off.swapaxes(1, 2) @ off)[1][:, :, 0]
    return np.asarray(np.abs(np.einsum("ni,ni->n", points[near] - mean, normal)))


def _poses(scans: ScanSequence) -> FloatArray:
    """world_T_ego (K, 4, 4) of scans that have them."""
    assert scans.world_T_ego is not None
    return scans.world_T_ego


def all_in_rows(scans: ScanSequence, lap: float | None = None) -> Iterator[Row]:
    """CPU time of every step: odometry, landmarks, graph and loops; lap: m, if each passes the same streets.

    The last row compares the end with the beginning (the last lap's keyframes with the first lap's, else the last third
    with the first): of keyframes, of those that close a submap, and of work that never changes.
    """
    slam = LidarSlam(_poses(scans)[0] @ scans.ego_T_lidar, vehicle=Vehicle(scans.ego_T_lidar))
    spent, points, memory = np.zeros(len(scans)), np.zeros(len(scans)), np.zeros(len(scans))
    keyframes, closing = np.zeros((2, len(scans)), dtype=np.bool_)
    load = np.full(len(scans), np.nan)
    with one_thread():
        for k in each(range(len(scans)), "all in"):
            scan = scans[k]
            step, spent[k] = clocked(slam.step, scan, float(scans.timestamps[k]))
            keyframes[k], closing[k] = step.keyframe is not None, step.submap is not None
            points[k], memory[k] = len(scan), peak_memory()
            if k % EVERY == EVERY - 1:
                load[k] = _load(scans)
        result, finish = clocked(slam.finish)
    way = np.linalg.norm(np.diff(_poses(scans)[:, :3, 3], axis=0), axis=1).cumsum()
    way = np.concatenate([[0.0], way])
    plain, closed = (np.where(keyframes & rows, spent, np.nan) for rows in (~closing, closing))
    counts = {"scans": len(scans), "keyframes": int(keyframes.sum()), "submaps": len(result.submaps)}
    loops = {"loops": len(result.loops), "left out": len(result.false_loops), "points a scan": points.mean()}
    means = {"ms a scan": spent.mean(), "no keyframe": _mean(np.where(keyframes, np.nan, spent))}
    times = {**means, "keyframe": _mean(np.where(keyframes, spent, np.nan)), "longest": spent.max()}
    yield "SLAM all in, CPU time", {**counts, **loops, **times, "at the end, s": finish / 1e3, "MB": memory[-1]}
    for a, b in pairwise(np.linspace(0, len(scans), 11).astype(int).tolist()):
        if b > a:
            part = {"ms, keyframe": _mean(plain[a:b]), "where a submap closes, with loops": _mean(closed[a:b])}
            yield "tenths of the drive", {"scans": f"{a} to {b}", **part, "MB so far": memory[b - 1]}
    growths = (_growth(values, keyframes, way, lap) for values in (plain, closed, load))
    of = ("keyframe", "where a submap closes", "work that never changes")
    yield "end / beginning", dict(zip(of, growths, strict=True))


def _growth(values: FloatArray, keyframe: BoolArray, way: FloatArray, lap: float | None) -> float:
    """The mean at the end by that at the beginning; NaN are left out."""
    if lap is None or way[-1] < lap:
        number = keyframe.cumsum()
        early, late = number <= number[-1] / 3, number > 2 * number[-1] / 3
    else:
        long = min(lap, way[-1] / 2)
        early, late = way <= long, way >= way[-1] - long
    return _mean(values[late]) / _mean(values[early])


def _load(scans: ScanSequence) -> float:
    """Milliseconds to place two scans by odometry alone."""
    pair, odometry = [(scans[k], float(scans.timestamps[k])) for k in range(2)], LidarOdometry()
    return sum(timed(odometry.step, *one) for one in pair)


def _mean(values: FloatArray | Sequence[float]) -> float:
    known = np.asarray(values)[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")
