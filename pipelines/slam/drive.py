"""A drive as odometry leaves it: poses of all scans, and motions between them with their covariances."""

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from data_tools.lidar import Scan
from pipelines.slam.odometry import OdometryStep
from saga_fg.errors import InputError, require_type
from saga_fg.numerics import FloatArray, carried_covariance, inverse_transform

LEAST = np.diag([1e-4] * 3 + [5e-3] * 3) ** 2  # of a motion: the best accuracy of a registration, rad and m


class Drive:
    """Odometry of a drive that goes on, scan by scan.

    times (K), s; poses K times (4, 4) of the sensor by odometry alone; ways (K), m, driven
    covariances  K times (6, 6) of the motion to each scan from the one before: (rotation, translation) in the frame of
                 the later one, rad^2, m^2
    keyframes    rows among the scans
    """

    def __init__(self) -> None:
        self.times, self.ways = list[float](), list[float]()
        self.poses, self.covariances = list[FloatArray](), list[FloatArray]()
        self.keyframes = list[int]()

    def __len__(self) -> int:
        return len(self.poses)

    def check(self, scan: Scan | None, time: float) -> None:
        """Raise `InputError` for what cannot be the next scan."""
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

    def motions(self, rows: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
        """Return the motion (4, 4) from each of these scans to the next, and its covariance (6, 6) at the end."""
        return [self.moved(a, b) for a, b in pairwise(rows)]

    def carried(self, world_T_lidar: FloatArray, rows: Sequence[int] | None = None) -> FloatArray:
        """Return poses (K, 4, 4) of all scans, given some, by default the keyframes: each fixed to the one before,
        or to the first."""
        known, poses = np.array(self.keyframes if rows is None else rows), np.array(self.poses)
        of = np.maximum(np.searchsorted(known, np.arange(len(poses)), side="right") - 1, 0)
        return np.asarray(world_T_lidar[of] @ inverse_transform(poses[known[of]]) @ poses)


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
