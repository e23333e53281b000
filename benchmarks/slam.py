"""LiDAR odometry against KISS-ICP: the same scans, in turn, in one run.

Each contender places every scan, ours first, theirs next, so that what else the machine does hits both alike; times are
CPU times of the process, each on one thread. Three measures:

* the relative error over 10 m against the GPS/IMU poses, which have errors of their own,
* the mean residual of scans in the map of their neighbours, which needs no reference (`scan_to_map_residual`),
* milliseconds a scan, and their ratio.

"as recorded" gives no times of points, and nobody de-skews; "de-skewed" gives both the times, and each removes the skew
with his own velocity. KISS-ICP dates a scan at the end of its sweep when it de-skews; its poses are moved back to the
middle, by its own velocity, before they are compared. Source: Vizzo et al., KISS-ICP, RA-L 2023.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from data_tools.lidar import Scan, constant_velocity, deskewed, scan_to_map_residual
from data_tools.lidar.scan import ScanSequence
from data_tools.trajectories import Trajectory, TrajectoryErrors, trajectory_errors
from pipelines.process import one_thread
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.tracking import Progress
from saga_fg.errors import MissingExtraError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform

OURS, OPEN3D, KISS = "saga-fg", "saga-fg, open3d icp", "kiss-icp"


@dataclass(frozen=True)
class SlamRow:
    """One contender on the scans of one case.

    errors        against the reference, poses of the vehicle
    residual      mean scan-to-map residual, m
    milliseconds  a scan, CPU time, median
    """

    case: str
    contender: str
    errors: TrajectoryErrors
    residual: float
    milliseconds: float


def bench_slam(
    scans: ScanSequence,
    kiss: bool = True,
    settings: OdometrySettings | None = None,
    progress: Progress | None = None,
    open3d: bool = False,
) -> list[SlamRow]:
    """All rows; open3d: our odometry with Open3D's registration as well.

    Raises `MissingExtraError` when `kiss` is wanted and not installed.
    """
    settings = settings or OdometrySettings()
    rows = []
    for case, timed in (("as recorded", False), ("de-skewed", True)):
        contenders: dict[str, Callable[[Scan, float], FloatArray]] = {OURS: _ours(settings)}
        if open3d:
            theirs = replace(settings.registration, method="open3d")
            contenders[OPEN3D] = _ours(replace(settings, registration=theirs))
        if kiss:
            contenders[KISS] = _kiss(settings, timed)
        poses: dict[str, list[FloatArray]] = {name: [] for name in contenders}
        seconds: dict[str, list[float]] = {name: [] for name in contenders}
        with one_thread():
            for k, timestamp in enumerate(scans.timestamps.tolist()):
                scan = scans[k] if timed else replace(scans[k], time=None)
                for name, place in contenders.items():
                    begin = time.process_time()
                    poses[name].append(place(scan, timestamp))
                    seconds[name].append(time.process_time() - begin)
                if progress is not None:
                    progress(case, k + 1, len(scans))
        rows += [
            _row(case, name, scans, np.array(poses[name]), 1e3 * float(np.median(seconds[name])), timed, settings)
            for name in contenders
        ]
    return rows


def _ours(settings: OdometrySettings) -> Callable[[Scan, float], FloatArray]:
    odometry = LidarOdometry(settings)
    return lambda scan, timestamp: odometry.step(scan, timestamp).map_T_lidar


def _kiss(settings: OdometrySettings, timed: bool) -> Callable[[Scan, float], FloatArray]:
    """KISS-ICP with its own defaults, a voxel of 1 % of the reach among them, on one thread."""
    try:
        kiss_icp: Any = importlib.import_module("kiss_icp.kiss_icp")
        config: Any = importlib.import_module("kiss_icp.config")
    except ImportError as error:
        raise MissingExtraError(f'kiss-icp cannot be imported: {error}; `pip install "saga-fg[bench]"`') from error
    chosen = config.KISSConfig()
    chosen.mapping.voxel_size = settings.max_range / 100.0
    chosen.data.min_range, chosen.data.max_range, chosen.data.deskew = settings.min_range, settings.max_range, timed
    chosen.registration.max_num_threads = 1
    pipeline = kiss_icp.KissICP(chosen)

    def place(scan: Scan, timestamp: float) -> FloatArray:
        share = np.zeros(len(scan))
        if scan.time is not None:  # of the sweep, from 0 to 1
            share = (scan.time - scan.time.min()) / max(float(np.ptp(scan.time)), 1e-9)
        pipeline.register_frame(np.array(scan.points), share)
        pose = np.asarray(pipeline.last_pose, dtype=np.float64)
        if not timed:
            return pose
        half = gtsam.Pose3.Expmap(-0.5 * gtsam.Pose3.Logmap(gtsam.Pose3(pipeline.last_delta)))
        return np.asarray(pose @ half.matrix())

    return place


def _row(
    case: str,
    name: str,
    scans: ScanSequence,
    map_T_lidar: FloatArray,
    milliseconds: float,
    timed: bool,
    settings: OdometrySettings,
) -> SlamRow:
    truth = Trajectory(scans.timestamps, scans.world_T_ego)
    ego_T_lidar = scans.ego_T_lidar
    estimate = Trajectory(scans.timestamps, ego_T_lidar @ map_T_lidar @ inverse_transform(ego_T_lidar))
    clouds = still_clouds([scans[k] for k in range(len(scans))], scans.timestamps, map_T_lidar, timed, settings)
    return SlamRow(
        case, name, trajectory_errors(estimate, truth), scan_to_map_residual(clouds, map_T_lidar), milliseconds
    )


def still_clouds(
    scans: Sequence[Scan], timestamps: FloatArray, map_T_lidar: FloatArray, timed: bool, settings: OdometrySettings
) -> list[FloatArray]:
    """Points (N, 3) of each scan, in its sensor's frame, without skew if `timed`: by the motion of the poses."""
    clouds = []
    for k, scan in enumerate(scans):
        scan = scan.within(settings.min_range, settings.max_range)
        if timed and scan.time is not None and len(scans) > 1:
            before = max(k - 1, 0)
            motion = inverse_transform(map_T_lidar[before]) @ map_T_lidar[before + 1]
            scan = deskewed(scan, constant_velocity(motion, float(timestamps[before + 1] - timestamps[before])))
        clouds.append(scan.points)
    return clouds
