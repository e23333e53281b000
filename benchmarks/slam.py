"""LiDAR odometry against KISS-ICP, and what SLAM costs: scan by scan, and with landmarks.

Of odometry, each contender places every scan, ours first, theirs next. Three measures:

* the relative error over 10 m against the GPS/IMU poses, which have errors of their own,
* the mean residual of scans in the map of their neighbours, which needs no reference (`scan_to_map_residual`),
* milliseconds a scan.

"as recorded" gives no times of points, and nobody de-skews; "de-skewed" gives both the times, and each removes the skew
with his own velocity. KISS-ICP dates a scan at the end of its sweep when it de-skews; its poses are moved back to the
middle, by its own velocity, before they are compared. Source: Vizzo et al., KISS-ICP, RA-L 2023.

The landmarks are those of a field that the vehicle drives up and down, line beside line, so that those of the line
before are always seen again; `LandmarkMapper` is not told which one is which.
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

from benchmarks.agreement import pairwise_agreement
from benchmarks.course import SimulatedCourse
from benchmarks.landmark_mapper import LandmarkMapper
from benchmarks.map_sharpness import scan_to_map_residual
from benchmarks.runner import Row, Rows, Seed, clocked, each, in_turn, timed
from benchmarks.scans import ScannerSettings
from data_tools.datasets.kitti import kitti_scans
from data_tools.lidar import Scan, ScanSequence, constant_velocity, deskewed
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.lidar_slam import LidarSlam
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.slam.vehicle_sensors import Vehicle
from pipelines.tracking import one_thread, peak_memory
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.model import PointLandmark
from saga_fg.numerics import BoolArray, FloatArray, inverse_transform
from saga_fg.types import Observation

OURS, KISS = "saga-fg", "kiss-icp"
SETTINGS = OdometrySettings()
APART, LINES, WIDTH = 10.0, 20.0, 200.0  # m between landmarks, between lines, and of the field
STEP, REACH = 2.0, 20.0  # m
MOTION, NOISE = np.array([0.03, 0.02, 0.002]), 0.1  # standard deviations of a motion (m, m, rad), of places, m
EVERY = 50  # scans from one measurement of the machine's load to the next

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
    landmarks: Annotated[
        int | None,
        typer.Option("--landmarks", min=20, help="Instead: cost of `LandmarkMapper` up to so many landmarks."),
    ] = None,
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
      python -m benchmarks slam --landmarks 3000
    """
    if sum(one is not None for one in (dataroot, landmarks, dense)) != 1:
        raise InputError("expected one of --dataroot, --landmarks and --dense")
    if dataroot is not None:
        recorded = kitti_scans(dataroot, sequence, most=scans)
        yield from odometry_rows(recorded, kiss)
        yield from all_in_rows(recorded)
    elif dense is not None:
        course = SimulatedCourse(seed, 0.8 * dense, settings=ScannerSettings(rings=64, columns=firings))
        yield from all_in_rows(course, course.lap)
    else:
        yield from landmark_rows(landmarks or 0, seed)


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


def landmark_rows(landmarks: int, seed: int) -> Iterator[Row]:
    """Tenths of a drive, and its last one by the second: at the start no line has another beside it."""
    rng = np.random.default_rng(seed)
    across = int(WIDTH / APART)
    grid = np.stack([np.arange(landmarks) % across, np.arange(landmarks) // across], axis=1)
    places = APART * grid + rng.uniform(-3.0, 3.0, (landmarks, 2))
    poses = _lines(APART * float(grid[:, 1].max()))
    tree, kind, Q = cKDTree(places), PointLandmark(density=1 / APART**2), np.diag(MOTION**2)
    mapper, cost = LandmarkMapper(poses[0].matrix(), 1e-6 * np.eye(3)), np.zeros(len(poses))
    sizes, true = np.zeros((len(poses), 2), dtype=int), list[int]()
    with one_thread():
        for k in each(range(len(poses)), "landmarks"):
            near = np.sort(np.array(tree.query_ball_point(poses[k].translation(), REACH), dtype=np.int64))
            seen = [poses[k].transformTo(places[n]) for n in near]
            ahead = [row for row, place in enumerate(seen) if place[0] > 0]
            R = NOISE**2 * np.eye(2)
            observations = [Observation(kind, seen[row] + NOISE * rng.normal(size=2), R) for row in ahead]
            if k:
                noise = MOTION * rng.normal(size=3)
                cost[k] = timed(mapper.move, poses[k - 1].between(poses[k]).retract(noise).matrix(), Q)
            cost[k] += timed(mapper.observe, observations)
            true += near[ahead].tolist()
            sizes[k] = len(mapper.landmarks), len(mapper.local.kinds)
        done = mapper.map()
    edges = np.linspace(0, len(poses), 11).astype(int).tolist()
    for a, b in pairwise(edges):
        counts = {"landmarks of the map": sizes[b - 1, 0], "in the local Gaussian": sizes[b - 1, 1]}
        yield "tenths of the drive", {"poses": f"{a} to {b}", "ms a pose": cost[a:b].mean(), **counts}
    off = done.world_T_pose[:, :2, 2] - np.array([pose.translation() for pose in poses])
    f1 = pairwise_agreement([one.landmark for one in done.observations], true).f1
    about = {"poses": len(poses), "observations": len(true), "landmarks": len(done.landmarks), "F1 over pairs": f1}
    ratio = cost[edges[-2] :].mean() / cost[edges[1] : edges[2]].mean()
    growth = {"time, last tenth / second": ratio, "landmarks, likewise": sizes[-1, 0] / sizes[edges[2] - 1, 0]}
    error = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    yield "the whole drive", {**about, **growth, "error, m": error, "MB": peak_memory()}


def _lines(length: float) -> list[gtsam.Pose2]:
    """Poses along lines across the field, up and down, over its length."""
    corners: list[FloatArray] = []
    for line in range(int(length / LINES) + 1):
        corners += list(np.array([[0.0, WIDTH][:: 1 if line % 2 == 0 else -1], [line * LINES] * 2]).T)
    poses = []
    for a, b in pairwise(corners):
        count = max(1, round(float(np.linalg.norm(b - a)) / STEP))
        heading = float(np.arctan2(*(b - a)[::-1]))
        poses += [gtsam.Pose2(heading, a + (b - a) * k / count) for k in range(count)]
    return poses
