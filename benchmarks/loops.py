"""False loop closures in pose graphs beside GTSAM's graduated non-convexity, and loops by place on simulated drives.

A course of some 2 km passes three stretches again (`benchmarks.course`). Its odometry is the true motion with
errors sampled from `NOISE`, and `drift` m in a random direction more, growing evenly until the vehicle first comes
back. The graph holds odometry and loops alone. A loop is false if it is off by more than `FALSE` m; a stretch is found
if a true loop ends in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Annotated, Any

import gtsam
import numpy as np
import typer

from benchmarks.course import SimulatedCourse, revisits
from benchmarks.joint import degraded_odometry
from benchmarks.runner import Row, Rows, clocked, each
from data_tools.lidar import Scan
from data_tools.pose_graphs import read_g2o
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.driver import SlamResult
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from saga_fg.errors import InputError, error_context
from saga_fg.numerics import BoolArray, FloatArray, IntArray, inverse_transform
from saga_fg.slam.joint import OdometryIncrements, OdometryNoise
from saga_fg.slam.pose_graph import (
    PoseGraph,
    consensus,
    factor_graph,
    optimise_poses,
    pose_array,
    pose_values,
    trusted,
)
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
SETTINGS = LidarSlamSettings(landmarks=False, recorded_rotation=2e-3, recorded_translation=0.03)
PERIOD, FALSE, OVER = 0.25, 1.5, 400.0  # s between scans: 2 m at most; m; m of relative errors


def loops(
    files: Annotated[list[Path] | None, typer.Argument(help="Pose graphs in the g2o format.")] = None,
    shares: Annotated[str, typer.Option("--shares", help="False loops for each true one, with commas.")] = "0.1,0.3,1",
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Graphs made for each share.")] = 5,
    gnc: Annotated[bool, typer.Option("--gnc/--no-gnc", help="Run gtsam.GncLMOptimizer too.")] = True,
    courses: Annotated[
        str | None, typer.Option("--courses", help="In place of files: seeds of simulated LiDAR drives, with commas.")
    ] = None,
    drift: Annotated[
        str, typer.Option("--drift", help="With --courses: m of drift until the first loop, besides 1 %, with commas.")
    ] = "0,10,30",
) -> Rows:
    """Add false loops to pose graphs, and compare with the optimum without them.

    With --courses: find the loops of drives of 2 km that pass three stretches again, and compare the path with that of
    the odometry.

    \b
    Examples:
      python -m benchmarks loops data/slam/CSAIL.g2o data/slam/intel.g2o
      python -m benchmarks loops --courses 0,1
    """
    if bool(files) == (courses is not None):
        raise InputError("expected either files of pose graphs, or --courses, which are simulated")
    if courses is not None:
        drives = [(seed, m) for seed in _numbers("--courses", courses) for m in _numbers("--drift", drift)]
        for seed, metres in each(drives, "courses"):
            yield "simulated courses: odometry that errs by 1 %, and loops", course_row(int(seed), metres)
        return
    wanted, graphs = _numbers("--shares", shares), {}
    for file in files or ():
        graphs[file] = read_g2o(file)
        with error_context(str(file)):
            with_false_loops(graphs[file], 0.0, seed=0)  # refuses what cannot have any, before hours of others
    for file, graph in graphs.items():
        with error_context(str(file)):
            yield from _spoilt(file.stem, graph, wanted, seeds, gnc)


def _numbers(option: str, text: str) -> list[float]:
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = [inf]
    if not all(0 <= number < inf for number in numbers):
        raise InputError(f"{option}: expected numbers >= 0 with commas, got {text!r:.40}")
    return numbers


def _spoilt(name: str, graph: PoseGraph, shares: Sequence[float], seeds: int, gnc: bool) -> Iterator[Row]:
    """Distances from the optimum without false loops: RMS over poses, the median and the largest over seeds."""
    clean, true, d = optimise_poses(graph).world_T_pose, len(graph.first), graph.dim

    def ours(spoilt: PoseGraph) -> tuple[FloatArray, BoolArray]:
        agreed = consensus(spoilt)
        return optimise_poses(agreed.graph).world_T_pose, agreed.kept

    for share in shares:
        for method, solve in (("saga-fg", ours), *((("GTSAM GNC", graduated),) if gnc else ())):
            off, lost, taken, ms = list[float](), 0, 0, list[float]()
            for seed in each(range(seeds), f"{name}, {share:g}, {method}"):
                (poses, kept), spent = clocked(solve, with_false_loops(graph, share, seed))
                ms.append(spent)
                off.append(float(np.sqrt(np.mean(np.sum((poses - clean)[:, :d, d] ** 2, axis=1)))))
                lost, taken = lost + int((~kept[:true]).sum()), taken + int(kept[true:].sum())
            about = {"graph, share": f"{name}, {share:g}", "method": method, "off, m: median": np.median(off)}
            counts = {"largest": max(off), "true lost": lost, "false taken": taken, "CPU s": np.mean(ms) / 1e3}
            yield "false loops: distance from the optimum without them", {**about, **counts}


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


def drive_course(seed: int, drift: float = 0.0) -> tuple[SimulatedCourse, SlamResult]:
    """Drive the course of a seed."""
    course = SimulatedCourse(seed, period=PERIOD, skewed=False)
    return course, lidar_slam(_Drifting(course, odometry_of(course, seed, drift)), "recorded", settings=SETTINGS)


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


def graduated(graph: PoseGraph) -> tuple[FloatArray, BoolArray]:
    """Poses of `gtsam.GncLMOptimizer` from the guess in the graph, and which measurements (M,) it kept."""
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([0, *(1 + np.flatnonzero(trusted(graph))).tolist()])
    optimizer = gtsam.GncLMOptimizer(factor_graph(graph), pose_values(graph.world_T_pose), params)
    poses = pose_array(optimizer.optimize(), graph.dim)
    return poses, np.asarray(optimizer.getWeights())[1:] > 0.5


_MIN_POSES = 4  # poses, of which two are no neighbours, whichever is first
_REACH = 10.0  # m, largest coordinate of a false measurement


def with_false_loops(graph: PoseGraph, share: float, seed: int) -> PoseGraph:
    """Append false loops, `share` times as many as the graph has loops, each with the information of one of these.

    Both poses, the position within 10 m by axis, and the rotation are uniformly distributed. Raises `InputError`.
    """
    loops = np.flatnonzero(~trusted(graph))
    if not graph.poses_alone:
        raise InputError("expected a graph of poses alone, without landmarks and priors")
    if not len(loops) or len(graph) < _MIN_POSES:
        raise InputError(f"expected {_MIN_POSES} poses and a loop or more, got {len(graph)} and {len(loops)}")
    if not 0 <= share < np.inf:
        raise InputError(f"share: expected a number >= 0, got {share:g}")
    rng = np.random.default_rng(seed)
    count, n = round(share * len(loops)), len(graph)
    first = rng.integers(0, n, count)
    second = (first + rng.integers(2, n - 1, count)) % n  # neither the same nor a neighbour
    measured = np.array([_anywhere(rng, graph.dim) for _ in range(count)]).reshape(-1, graph.dim + 1, graph.dim + 1)
    return replace(
        graph,
        first=np.concatenate([graph.first, np.minimum(first, second)]),
        second=np.concatenate([graph.second, np.maximum(first, second)]),
        first_T_second=np.concatenate([graph.first_T_second, measured]),
        information=np.concatenate([graph.information, graph.information[rng.choice(loops, count)]]),
    )


def _anywhere(rng: np.random.Generator, d: int) -> FloatArray:
    place = rng.uniform(-_REACH, _REACH, d)
    if d == 2:
        return np.asarray(gtsam.Pose2(rng.uniform(-np.pi, np.pi), place).matrix())
    w, x, y, z = rng.normal(size=4)
    return np.asarray(
        gtsam.Pose3(gtsam.Rot3.Quaternion(*(np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z]))), place).matrix()
    )
