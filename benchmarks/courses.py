"""Drift and loops on simulated courses: LiDAR SLAM whose odometry errs by some 1 % of the way, with loops by place.

A course of some 2 km passes three stretches again (`data_tools.simulator.course`). Its odometry is the true motion with
errors sampled from `NOISE`, and `drift` m in a random direction more, growing evenly until the vehicle first comes
back. The graph holds odometry and loops alone. A loop is false if it is off by more than `_FALSE` m; a stretch is found
if a true loop ends in it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_tools.lidar import Scan
from data_tools.simulator.course import SimulatedCourse, revisits
from data_tools.trajectories import Trajectory, degraded_odometry, trajectory_errors
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from pipelines.slam.lidar_slam_types import LidarSlamResult
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.slam.joint import OdometryIncrements, OdometryNoise
from saga_fg.slam.submaps import LoopClosure

NOISE = OdometryNoise(  # like that of scan registration: headings drift, distances are right
    turn_noise=3e-3,
    tilt_noise=2e-4,
    distance_noise=0.02,
    time_noise=0.005,
    scale=1e-3,
    scale_drift=1e-5,
    bias=3e-4,
    bias_drift=3e-6,
    course=1e-3,
    course_drift=1e-5,
)
SETTINGS = LidarSlamSettings(landmarks=False, oxts_rotation=2e-3, oxts_translation=0.03)
_PERIOD = 0.25  # s between scans: 2 m at most
_FALSE = 1.5  # m
_OVER = 400.0  # m


@dataclass(frozen=True)
class CourseRow:
    """One drive: length, m; relative error of odometry over `_OVER` m; ATE of odometry and of the graph, m, and their
    ratio; loops, how many are false, and true ones that were left out; stretches that are passed again, and how many
    were found; CPU seconds.
    """

    seed: int
    drift: float
    length: float
    error: float
    odometry: float
    graph: float
    ratio: float
    loops: int
    false: int
    lost: int
    stretches: int
    found: int
    seconds: float


@dataclass(frozen=True, eq=False)
class _Drifting:
    """The scans of a course with the poses of its odometry: a `ScanSequence`."""

    course: SimulatedCourse
    world_T_ego: FloatArray

    @property
    def timestamps(self) -> FloatArray:
        return self.course.timestamps

    @property
    def ego_T_lidar(self) -> FloatArray:
        return self.course.ego_T_lidar

    def __len__(self) -> int:
        return len(self.course)

    def __getitem__(self, row: int) -> Scan:
        return replace(self.course[row], time=None)  # without skew


def drive_course(
    seed: int, drift: float = 0.0, progress: Progress | None = None
) -> tuple[SimulatedCourse, LidarSlamResult]:
    """Drive the course of a seed."""
    course = SimulatedCourse(seed, period=_PERIOD, skewed=False)
    scans = _Drifting(course, odometry_of(course, seed, drift))
    return course, lidar_slam(scans, "oxts", settings=SETTINGS, progress=progress)


def bench_course(seed: int, drift: float = 0.0, progress: Progress | None = None) -> CourseRow:
    """Drive the course of a seed, and compare with the truth."""
    began = time.process_time()
    course, result = drive_course(seed, drift, progress)
    seconds = time.process_time() - began
    truth = Trajectory(course.timestamps, course.world_T_ego)
    before, after = (trajectory_errors(each, truth, distance=_OVER) for each in (result.odometry, result.trajectory))
    right, lost = (_right(course, result.keyframes, loops) for loops in (result.loops, result.false_loops))
    second = result.keyframes[np.array([loop.second for loop in result.loops], dtype=np.int64)]
    ends = course.way[second[right]]
    stretches = [(course.way[a], course.way[b]) for a, b in revisits(course.world_T_ego)]
    reach = SETTINGS.submaps.length
    hits = sum(bool(((ends + reach >= a) & (ends <= b)).any()) for a, b in stretches)
    return CourseRow(
        seed,
        drift,
        float(course.way[-1]),
        before.relative_translation / _OVER,
        before.ate,
        after.ate,
        after.ate / before.ate,
        len(right),
        int((~right).sum()),
        int(lost.sum()),
        len(stretches),
        hits,
        seconds,
    )


def _right(course: SimulatedCourse, keyframes: IntArray, loops: Sequence[LoopClosure]) -> BoolArray:
    """Which loops (M,) between keyframes are true."""
    first, second = (
        keyframes[np.array([getattr(loop, end) for loop in loops], dtype=np.int64)] for end in ("first", "second")
    )
    true = inverse_transform(course.world_T_ego[first]) @ course.world_T_ego[second]
    found = np.array([loop.first_T_second for loop in loops]).reshape(-1, 4, 4)
    return np.asarray(np.linalg.norm((inverse_transform(true) @ found)[:, :3, 3], axis=1) < _FALSE)


def odometry_of(course: SimulatedCourse, seed: int, drift: float) -> FloatArray:
    """Poses (K, 4, 4) that odometry says, from the true first pose on."""
    rng = np.random.default_rng([seed, 1])
    exact = OdometryIncrements.of(course.timestamps, course.world_T_ego)
    poses = degraded_odometry(exact, NOISE, rng).path(course.world_T_ego[0])
    angle = rng.uniform(0.0, 2 * np.pi)
    again = course.way[revisits(course.world_T_ego)[0][0]]
    poses[:, :2, 3] += drift * (course.way / again)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return poses
