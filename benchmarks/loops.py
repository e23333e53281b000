"""Loops by place on simulated drives.

A course of some 2 km passes three stretches again (`benchmarks.course`). Its odometry is the true motion with
errors sampled from `NOISE`, and `drift` m in a random direction more, growing evenly until the vehicle first comes
back. The graph holds odometry and loops alone. A loop is false if it is off by more than `FALSE` m; a stretch is found
if a true loop ends in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.course import SimulatedCourse, revisits
from benchmarks.joint import degraded_odometry
from benchmarks.runner import Rows, each
from benchmarks.scans import GivenPoses
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.driver import SlamResult
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, IntArray, inverse_transform
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
SETTINGS = LidarSlamSettings(landmarks=False)
PERIOD, FALSE, OVER = 0.25, 1.5, 400.0  # s between scans: 2 m at most; m; m of relative errors


def loops(
    courses: Annotated[str, typer.Option("--courses", help="Seeds of simulated drives, with commas.")] = "0,1",
    drift: Annotated[
        str, typer.Option("--drift", help="m of drift until the first loop, besides 1 %, with commas.")
    ] = "0,10,30",
) -> Rows:
    """Find the loops of drives of 2 km that pass three stretches again, and compare the path with the odometry's.

    \b
    Example:
      python -m benchmarks loops --courses 0,1
    """
    drives = [(seed, m) for seed in _numbers("--courses", courses) for m in _numbers("--drift", drift)]
    for seed, metres in each(drives, "courses"):
        yield "simulated courses: odometry that errs by 1 %, and loops", course_row(int(seed), metres)


def _numbers(option: str, text: str) -> list[float]:
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = [inf]
    if not all(0 <= number < inf for number in numbers):
        raise InputError(f"{option}: expected numbers >= 0 with commas, got {text!r:.40}")
    return numbers


def drive_course(seed: int, drift: float = 0.0) -> tuple[SimulatedCourse, SlamResult]:
    """Drive the course of a seed."""
    course = SimulatedCourse(seed, period=PERIOD, skewed=False)
    odometry = GivenPoses(odometry_of(course, seed, drift) @ course.ego_T_lidar, 2e-3, 0.03)
    return course, lidar_slam(course, odometry=odometry, settings=SETTINGS)


def course_row(seed: int, drift: float) -> dict[str, Any]:
    """Drive the course of a seed, and compare with the truth."""
    course, result = drive_course(seed, drift)
    truth = Trajectory(course.timestamps, course.world_T_ego)
    before, after = (trajectory_errors(path, truth, distance=OVER) for path in (result.odometry, result.trajectory))
    right, lost = (_right(course, result.keyframes, found) for found in (result.loops, result.false_loops))
    second = result.keyframes[np.array([loop.second for loop in result.loops], dtype=np.int64)]
    ends = course.distance[second[right]]
    stretches = [(course.distance[a], course.distance[b]) for a, b in revisits(course.world_T_ego)]
    hits = sum(bool(((ends + SETTINGS.submaps.length >= a) & (ends <= b)).any()) for a, b in stretches)
    about = {
        "seed": seed,
        "drift, m": drift,
        "m": float(course.distance[-1]),
        "odometry": before.relative_translation / OVER,
    }
    errors = {"ATE, m: odometry": before.ate, "with loops": after.ate, "ratio": after.ate / before.ate}
    counts = {"loops": len(right), "false": int((~right).sum()), "true lost": int(lost.sum())}
    return {**about, **errors, "stretches found": f"{hits} of {len(stretches)}", **counts}


def _right(course: SimulatedCourse, keyframes: IntArray, loops: Sequence[LoopClosure]) -> BoolArray:
    """Which loops (M,) between keyframes are true."""
    first, second = (
        keyframes[np.array([getattr(loop, end) for loop in loops], dtype=np.int64)] for end in ("first", "second")
    )
    true = inverse_transform(course.world_T_ego[first]) @ course.world_T_ego[second]
    found = np.array([loop.first_T_second for loop in loops]).reshape(-1, 4, 4)
    return np.asarray(np.linalg.norm((inverse_transform(true) @ found)[:, :3, 3], axis=1) < FALSE)


def odometry_of(course: SimulatedCourse, seed: int, drift: float) -> FloatArray:
    """Poses (K, 4, 4) that odometry says, from the true first pose on."""
    rng = np.random.default_rng([seed, 1])
    exact = OdometryIncrements.of(course.timestamps, course.world_T_ego)
    poses = degraded_odometry(exact, NOISE, rng).path(course.world_T_ego[0])
    angle = rng.uniform(0.0, 2 * np.pi)
    again = course.distance[revisits(course.world_T_ego)[0][0]]
    poses[:, :2, 3] += drift * (course.distance / again)[:, None] * np.array([np.cos(angle), np.sin(angle)])
    return poses
