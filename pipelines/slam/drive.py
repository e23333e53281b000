"""Odometry of a drive: poses of the scans, covariances of the motions, and keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import gtsam
import numpy as np

from data_tools.lidar import Scan, constant_velocity, deskewed
from data_tools.lidar.moving import without_objects
from data_tools.lidar.scan import ScanSequence
from pipelines.slam.odometry import OdometrySettings, OdometryStep, moved_on
from saga_fg.errors import InputError, require_type
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import carried_covariance, checked_transform, inverse_transform
from saga_fg.types.boxes import Boxes

LEAST = np.diag([1e-4] * 3 + [5e-3] * 3) ** 2  # of a motion: the best accuracy of a registration, rad and m


@dataclass(frozen=True, eq=False)
class Drive:
    """Odometry of K scans, M of them keyframes.

    poses        (K, 4, 4) of the sensor by odometry alone
    covariances  (K, 6, 6) of the motion to each scan from the one before: (rotation, translation) in the frame of the
                 later one, rad^2, m^2
    keyframes    M rows among the scans
    """

    poses: FloatArray
    covariances: FloatArray
    keyframes: list[int]

    def motions(self, rows: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
        """Return the motion (4, 4) from each of these scans to the next, and its covariance (6, 6) at the end."""
        return [motion(self.poses[a : b + 1], self.covariances[a + 1 : b + 1]) for a, b in pairwise(rows)]

    def carried(self, world_T_lidar: FloatArray, rows: Sequence[int] | None = None) -> FloatArray:
        """Return poses (K, 4, 4) of all scans, given some, by default the keyframes: each fixed to the one before,
        or to the first."""
        known = np.array(self.keyframes if rows is None else rows)
        of = np.maximum(np.searchsorted(known, np.arange(len(self.poses)), side="right") - 1, 0)
        return np.asarray(world_T_lidar[of] @ inverse_transform(self.poses[known[of]]) @ self.poses)


class OdometryPath:
    """Odometry of a drive that goes on, scan by scan.

    times (K), s; poses K times (4, 4) of the sensor; covariances K times (6, 6), as of `Drive`; ways (K), m, driven
    """

    def __init__(self) -> None:
        self.times, self.ways = list[float](), list[float]()
        self.poses, self.covariances = list[FloatArray](), list[FloatArray]()

    def __len__(self) -> int:
        return len(self.poses)

    def check(self, scan: Scan | None, time: float, points_first: bool) -> None:
        """Raise `InputError` for what cannot be the next scan; points_first: whether the first one must have some."""
        if scan is None:
            raise InputError(
                "scan: expected one in every step: what sensors measure between scans comes with the next scan, as "
                "SensorBuffer gives it; of detections between scans give those nearest to a scan"
            )
        require_type("scan", scan, Scan)
        if not (isinstance(time, int | float | np.number) and np.isfinite(time)):
            raise InputError(f"time: expected a finite number of seconds, got {time!r}")
        if self.times and not time > self.times[-1]:
            raise InputError(f"time: expected one after {self.times[-1]:.6f} s, got {time:.6f} s")
        if points_first and not self.times and not len(scan):
            raise InputError(f"scan at {time:.3f} s: expected points to begin with, got none")

    def add(self, time: float, pose: FloatArray, step: OdometryStep) -> None:
        """Add the scan at `time` with its pose (4, 4), which stands for the poses of the scans lost before, too."""
        moved = float(np.linalg.norm(pose[:3, 3] - self.poses[-1][:3, 3])) if self.poses else 0.0
        self.times.append(time)
        self.poses.append(pose)
        self.ways.append(moved + (self.ways[-1] if self.ways else 0.0))
        covariances = shared(self.poses, step)
        self.covariances[len(self.poses) - len(covariances) :] = covariances

    def moved(self, first: int, last: int | None = None) -> tuple[FloatArray, FloatArray]:
        """The motion (4, 4) from a scan to another, by default the newest, and its covariance (6, 6) at the end."""
        end = len(self.poses) if last is None else last + 1
        return motion(self.poses[first:end], self.covariances[first + 1 : end])

    def expected(self, time: float) -> FloatArray:
        """The pose (4, 4) at `time` by the motion between the last two scans; there is one scan at least."""
        if len(self.poses) < 2:
            return self.poses[-1]
        before, last = (gtsam.Pose3(pose) for pose in self.poses[-2:])
        share = (time - self.times[-1]) / (self.times[-1] - self.times[-2])
        pose: FloatArray = last.retract(share * before.localCoordinates(last)).matrix()
        return pose

    def drive(self, keyframes: Sequence[int]) -> Drive:
        """The drive so far, its keyframes by their rows."""
        return Drive(np.array(self.poses), np.array(self.covariances), list(keyframes))


def motion(
    poses: Sequence[FloatArray] | FloatArray, covariances: Sequence[FloatArray] | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the motion (4, 4) from the first of n poses to the last, and its covariance (6, 6) in the frame of that.

    covariances: n - 1 of the motions from each to the next, each in the frame of the later one
    """
    later = np.reshape(poses[1:], (-1, 4, 4))
    total = carried_covariance(inverse_transform(poses[-1]) @ later, np.reshape(covariances, (-1, 6, 6))).sum(axis=0)
    return inverse_transform(poses[0]) @ poses[-1], (total + total.T) / 2


def moved_pose(
    pose: FloatArray, covariance: FloatArray, since: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return a pose (4, 4) and the covariance (6, 6) of its tangent after the motion `since`, as `motion` gives it."""
    return pose @ since[0], carried_covariance(inverse_transform(since[0]), covariance) + since[1]


def shared(poses: Sequence[FloatArray], step: OdometryStep) -> list[FloatArray]:
    """Covariances (6, 6) of the motions to a scan, the last of `poses`, and to the `step.lost` scans before it.

    They have equal shares of that of the whole motion, which registration in the map knows; `motion` adds them up.
    """
    lost = min(step.lost, len(poses) - 1)
    them = np.array(poses[len(poses) - 1 - lost :])
    return list(carried_covariance(inverse_transform(them) @ poses[-1], (step.covariance + LEAST) / (lost + 1)))


def checked_step(step: object) -> OdometryStep:
    """The step of an odometry, as it is; raises `InputError` for what is no pose, covariance or scan."""
    if not isinstance(step, OdometryStep):
        raise InputError(f"odometry: expected an OdometryStep, got {type(step).__name__}")
    if not isinstance(step.scan, Scan):
        raise InputError(f"odometry: scan: expected a Scan, got {type(step.scan).__name__}")
    if not (isinstance(step.lost, int) and step.lost >= 0):
        raise InputError(f"odometry: lost: expected a number of scans, got {step.lost!r}")
    checked_transform("odometry: map_T_lidar", step.map_T_lidar)
    P = checked("odometry: covariance", step.covariance, (6, 6))
    size = float(np.abs(P).max())
    if np.abs(P - P.T).max() > 1e-9 * size or np.linalg.eigvalsh((P + P.T) / 2)[0] < -1e-9 * size:
        raise InputError("odometry: covariance: expected a symmetric matrix without negative eigenvalues")
    return step


class Odometry(Protocol):
    """Places scans one by one, in the frame of the first; `pipelines.slam.odometry.LidarOdometry` is one."""

    def step(self, scan: Scan, timestamp: float) -> OdometryStep:
        """Place the next scan."""


class RecordedOdometry:
    """The poses of a recording as odometry, with deviations of `rotation`, rad, and `translation`, m, a scan."""

    def __init__(self, scans: ScanSequence, rotation: float, translation: float, settings: OdometrySettings) -> None:
        self._poses, self._times, self._settings = scans.world_T_ego @ scans.ego_T_lidar, scans.timestamps, settings
        self._noise = np.diag([rotation] * 3 + [translation] * 3) ** 2
        self._row, self._keyframe = -1, 0

    def step(self, scan: Scan, timestamp: float) -> OdometryStep:
        """Place the next scan of the recording; raises `InputError` for one of another time."""
        k, s = self._row + 1, self._settings
        if k == len(self._times) or timestamp != self._times[k]:
            raise InputError(f"timestamp: expected that of scan {k} of the recording, got {timestamp:.6f} s")
        moved = inverse_transform(self._poses[self._keyframe]) @ self._poses[k]
        keyframe = k == 0 or moved_on(moved)
        self._row, self._keyframe = k, k if keyframe else self._keyframe
        scan = deskewed_in_range(scan, k, self._poses, self._times, s)
        placed = inverse_transform(self._poses[0]) @ self._poses[k]
        return OdometryStep(timestamp, placed, self._noise if k else np.zeros((6, 6)), scan, keyframe, None)


def deskewed_in_range(
    scan: Scan, row: int, poses: FloatArray, timestamps: FloatArray, settings: OdometrySettings
) -> Scan:
    """Return a scan within range and without skew, by poses (K, 4, 4) of the sensor at all scans."""
    scan, before = scan.within(settings.min_range, settings.max_range), max(row - 1, 0)
    if scan.time is None or len(poses) < 2:
        return scan
    duration = float(timestamps[before + 1] - timestamps[before])
    return deskewed(scan, constant_velocity(inverse_transform(poses[before]) @ poses[before + 1], duration))


class KeyframeClouds(Sequence[FloatArray]):
    """Points (N, 3) of keyframes in the frame of the sensor, without skew by `drive`, read from the recording again.

    moving: (K) boxes of moving objects in the frame of each scan, which are left out
    """

    def __init__(self, scans: ScanSequence, drive: Drive, settings: OdometrySettings, moving: Sequence[Boxes]) -> None:
        self._scans, self._drive, self._settings, self._moving = scans, drive, settings, moving

    def __len__(self) -> int:
        return len(self._drive.keyframes)

    def __getitem__(self, k: Any) -> Any:
        row = self._drive.keyframes[k]
        scan = without_objects(self._scans[row], self._moving[row])
        return deskewed_in_range(scan, row, self._drive.poses, self._scans.timestamps, self._settings).points
