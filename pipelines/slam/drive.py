"""Odometry of a recording: poses of the scans, covariances of the motions, and keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from data_tools.lidar import constant_velocity, deskewed
from data_tools.lidar.scan import ScanSequence
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform

LEAST = np.diag([1e-4] * 3 + [5e-3] * 3) ** 2  # of a motion: the best accuracy of a registration, rad and m


@dataclass(frozen=True, eq=False)
class Drive:
    """Odometry of K scans, M of them keyframes.

    poses        (K, 4, 4) of the sensor by odometry alone
    covariances  (K, 6, 6) of the motion to each scan from the one before: (rotation, translation) in the frame of the
                 later one, rad^2, m^2
    keyframes    M rows among the scans
    points       M arrays (N, 3) of theirs, without skew, m, in the sensor's frame
    """

    poses: FloatArray
    covariances: FloatArray
    keyframes: list[int]
    points: list[FloatArray]

    def motions(self, rows: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
        """Return the motion (4, 4) from each of these scans to the next, and its covariance (6, 6) at the end."""
        motions = []
        for a, b in pairwise(rows):
            total = np.zeros((6, 6))
            for k in range(a + 1, b + 1):
                Ad = gtsam.Pose3(inverse_transform(self.poses[b]) @ self.poses[k]).AdjointMap()
                total += Ad @ self.covariances[k] @ Ad.T
            motions.append((inverse_transform(self.poses[a]) @ self.poses[b], (total + total.T) / 2))
        return motions

    def carried(self, world_T_lidar: FloatArray, rows: Sequence[int] | None = None) -> FloatArray:
        """Return poses (K, 4, 4) of all scans, given some, by default the keyframes: each fixed to the one before."""
        known = np.array(self.keyframes if rows is None else rows)
        of = np.searchsorted(known, np.arange(len(self.poses)), side="right") - 1
        return np.asarray(world_T_lidar[of] @ inverse_transform(self.poses[known[of]]) @ self.poses)


def drive_by_lidar(
    scans: ScanSequence, start: FloatArray, settings: OdometrySettings, progress: Progress | None = None
) -> Drive:
    """Return the odometry by registration of each scan, from the sensor's pose `start` (4, 4) on."""
    odometry = LidarOdometry(settings)
    drive = Drive(np.empty((len(scans), 4, 4)), np.empty((len(scans), 6, 6)), [], [])
    for k, timestamp in enumerate(scans.timestamps.tolist()):
        step = odometry.step(scans[k], timestamp)
        drive.poses[k], drive.covariances[k] = start @ step.map_T_lidar, step.covariance + LEAST
        if step.keyframe:
            drive.keyframes.append(k)
            drive.points.append(step.scan.points)
        if progress is not None:
            progress("odometry", k + 1, len(scans))
    return drive


def drive_by_poses(
    scans: ScanSequence,
    rotation: float,
    translation: float,
    settings: OdometrySettings,
    progress: Progress | None = None,
) -> Drive:
    """Return the recording's poses as odometry with deviations of `rotation`, rad, and `translation`, m, a scan."""
    poses = scans.world_T_ego @ scans.ego_T_lidar
    noise = np.diag([rotation] * 3 + [translation] * 3) ** 2
    drive = Drive(poses, np.broadcast_to(noise, (len(scans), 6, 6)), [], [])
    for k in range(len(scans)):
        moved = inverse_transform(poses[drive.keyframes[-1]]) @ poses[k] if k else np.eye(4)
        if k == 0 or np.linalg.norm(moved[:3, 3]) >= settings.keyframe_distance:
            scan = scans[k].within(settings.min_range, settings.max_range)
            before = max(k - 1, 0)
            if scan.time is not None:
                duration = float(scans.timestamps[before + 1] - scans.timestamps[before])
                scan = deskewed(scan, constant_velocity(inverse_transform(poses[before]) @ poses[before + 1], duration))
            drive.keyframes.append(k)
            drive.points.append(scan.points)
        if progress is not None:
            progress("reading", k + 1, len(scans))
    return drive
