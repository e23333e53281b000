"""LiDAR SLAM with an IMU against SLAM without, on simulated drives between walls, in a tunnel, in turns, and carried.

A drive is a way (distance, curvature) driven at a speed that changes; houses, poles and the walls of a tunnel stand
along it. Inertial samples come at 200 Hz from its second differences, with noise and constant biases. ATE and the error
of the end are those of the solved path; NEES is the squared error of the last pose, (rotation, translation), by its
covariance and its six dimensions: 1 on average where covariances are honest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import gtsam
import numpy as np
import typer

from benchmarks.runner import Rows, Seed
from benchmarks.scans import SENSOR_HEIGHT, ScannerSettings, StaticWorld, simulate_scan
from data_tools.lidar import Scan
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.driver import SlamResult
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from saga_fg.numerics import FloatArray, inverse_transform, transforms, yaw_transform
from saga_fg.types import Boxes

RATE, PERIOD, GRAVITY = 200, 0.1, 9.81  # samples a second; s between scans; m/s^2
NOISE = np.repeat([0.02, 0.002], 3)  # densities: m/s^2 and rad/s per root Hz
BIASES = np.repeat([0.05, 0.003], 3)  # standard deviations, m/s^2 and rad/s
SCANNER = ScannerSettings(rings=24, columns=360, reach=50.0)
PAUSE, CARRIED = 4.0, yaw_transform(3.0, 3.7, 0.0, 0.7)  # s without scans and samples; the motion meanwhile
SETTINGS = LidarSlamSettings(landmarks=False, loop_closures=False)


@dataclass(frozen=True)
class Stretch:
    """length, m; curvature, 1/m, at its middle; speed, m/s, at its end; tunnel: between bare walls."""

    length: float
    curvature: float = 0.0
    speed: float = 8.0
    tunnel: bool = False


TURN = Stretch(9.4, np.pi / 18.8, 5.0)
DRIVES: dict[str, tuple[Stretch, ...]] = {
    "walls": (Stretch(60.0), TURN, Stretch(50.0, speed=10.0), Stretch(40.0, -0.02), Stretch(30.0)),
    "tunnel": (
        *(Stretch(40.0), Stretch(12.0, speed=7.0), Stretch(35.0, 0.0, 3.0, True), Stretch(35.0, 0.0, 9.0, True)),
        *(Stretch(30.0, 0.0, 9.0, True), Stretch(40.0, speed=8.0)),
    ),
    "turns": tuple(Stretch(8.0, sign * 0.25, 6.0) for sign in (1, -1, -1, 1) * 3),
    "carried": (Stretch(60.0, speed=8.0), Stretch(10.0, speed=0.5), Stretch(12.0, speed=8.0), Stretch(50.0, -0.01)),
}


@dataclass(frozen=True, eq=False)
class InertialDrive:
    """A simulated drive: `data_tools.lidar.scan.ScanSequence` with the true poses, and its inertial samples."""

    world: StaticWorld
    timestamps: FloatArray
    world_T_ego: FloatArray
    velocity: FloatArray
    imu: FloatArray
    seed: int

    @property
    def ego_T_lidar(self) -> FloatArray:
        """The LiDAR is the vehicle's frame."""
        return np.eye(4)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, row: int) -> Scan:
        return self._scans[row]

    @cached_property
    def _scans(self) -> list[Scan]:
        rng = np.random.default_rng([self.seed, 1])
        return [
            simulate_scan(self.world, pose, rng, SCANNER, velocity)
            for pose, velocity in zip(self.world_T_ego, self.velocity, strict=True)
        ]


def inertial_drive(stretches: Sequence[Stretch], seed: int, carried_at: float | None = None) -> InertialDrive:
    """Simulate a drive; carried_at: m of way at which recording pauses while the vehicle is carried."""
    rng, dt = np.random.default_rng([seed, 0]), 1 / RATE
    ends = np.concatenate([[0.0], np.cumsum([one.length for one in stretches])])
    speeds = np.array([stretches[0].speed, *(one.speed for one in stretches)])
    way, heading = [0.0], [0.0]
    while way[-1] < ends[-1]:
        s, k = way[-1], min(int(np.searchsorted(ends, way[-1], side="right")) - 1, len(stretches) - 1)
        share = (s - ends[k]) / stretches[k].length
        speed = max(float(np.interp(s, ends, speeds)), 0.5)
        way.append(s + speed * dt)
        heading.append(heading[-1] + speed * dt * stretches[k].curvature * (1 - np.cos(2 * np.pi * share)))
    driven, yaw = np.array(way), np.array(heading)
    time = dt * np.arange(len(driven))
    moved = np.diff(driven)[:, None] * np.column_stack([np.cos(yaw[:-1]), np.sin(yaw[:-1])])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    v = np.gradient(place, dt, axis=0)
    a, rate = np.gradient(v, dt, axis=0), np.gradient(yaw, dt)
    c, n = np.cos(yaw), np.sin(yaw)
    force = np.column_stack([c * a[:, 0] + n * a[:, 1], c * a[:, 1] - n * a[:, 0], np.full(len(driven), GRAVITY)])
    samples = np.column_stack([force, np.zeros((len(driven), 2)), rate])
    samples += BIASES * rng.normal(size=6) + NOISE * np.sqrt(RATE) * rng.normal(size=samples.shape)
    world = _along(stretches, ends, driven, place, yaw, rng)
    rows = np.arange(RATE * PERIOD / 2, len(driven) - 1, RATE * PERIOD).astype(int)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = np.column_stack([place[rows], np.full(len(rows), SENSOR_HEIGHT)])
    poses[:, :2, :2] = transforms(np.column_stack([place[rows], yaw[rows]]))[:, :2, :2]
    still = np.zeros(len(rows))
    ahead = np.hypot(*v[rows].T)
    velocity = np.column_stack([still, still, rate[rows], ahead, still, still])
    stamps, imu = time[rows], np.column_stack([time, samples])
    if carried_at is not None:
        k = int(np.searchsorted(driven[rows], carried_at))
        poses[k:] = poses[k] @ CARRIED @ inverse_transform(poses[k]) @ poses[k:]
        imu[time > stamps[k - 1], 0] += PAUSE
        imu = imu[(time <= stamps[k - 1]) | (time > stamps[k])]
        stamps[k:] += PAUSE
    return InertialDrive(world, stamps, poses, velocity, imu, seed)


def _along(
    stretches: Sequence[Stretch],
    ends: FloatArray,
    s: FloatArray,
    place: FloatArray,
    yaw: FloatArray,
    rng: np.random.Generator,
) -> StaticWorld:
    """Houses and poles beside a way, and bare walls where it is a tunnel."""
    centres, sizes, turns, poles = list[FloatArray](), list[FloatArray](), list[float](), list[FloatArray]()

    def beside(at: float, off: float, size: Sequence[float]) -> None:
        row = min(int(np.searchsorted(s, at)), len(s) - 1)
        aside = np.array([-np.sin(yaw[row]), np.cos(yaw[row])])
        centre = place[row] + off * aside
        if size[1] > 1.0 and np.linalg.norm(place - centre, axis=1).min() < 4.5 + np.hypot(size[0], size[1]) / 2 - 3.0:
            return  # it would stand on the way
        centres.append(np.array([*centre, size[2] / 2]))
        sizes.append(np.array(size))
        turns.append(float(yaw[row]))

    for stretch, begin, end in zip(stretches, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if stretch.tunnel:
            for side in (-1.0, 1.0):
                beside((begin + end) / 2, 4.0 * side, [end - begin, 0.5, 8.0])
            continue
        for side in (-1.0, 1.0):
            at = begin + 2.0
            while at < end:
                length, depth, back = rng.uniform([5.0, 4.0, 5.5], [10.0, 7.0, 9.0]).tolist()
                beside(at + length / 2, side * (back + depth / 2), [length, depth, 8.0])
                at += length + float(rng.uniform(2.0, 5.0))
            for at in np.arange(begin + 3.0, end, 12.0):
                row = int(np.searchsorted(s, at))
                aside = np.array([-np.sin(yaw[row]), np.cos(yaw[row])])
                poles.append(np.array([*(place[row] + 4.0 * side * aside), 0.15, 5.0]))
    n = len(centres)
    boxes = Boxes.of(["house"] * n, np.array(centres), np.array(sizes), np.array(turns), np.zeros((n, 2)))
    return StaticWorld(boxes, np.array(poles))


def end_nees(result: SlamResult, drive: InertialDrive) -> float:
    """Squared error of the last keyframe's pose by its covariance, over its six dimensions."""
    row = int(result.keyframes[-1])
    off = gtsam.Pose3(result.world_T_lidar[-1]).localCoordinates(gtsam.Pose3(drive.world_T_ego[row]))
    return float(off @ np.linalg.solve(result.covariances[-1], off)) / 6


def inertial(
    drives: Annotated[str, typer.Option("--drives", help="Some of walls,tunnel,turns,carried.")] = ",".join(DRIVES),
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Drives of each kind.")] = 3,
    seed: Seed = 0,
) -> Rows:
    """SLAM with and without an IMU on simulated drives of 100 to 200 m: ATE, error of the end, NEES.

    \b
    Example:
      python -m benchmarks inertial --seeds 3
    """
    for name in drives.split(","):
        found: dict[str, list[tuple[float, float, float]]] = {"without": [], "with": []}
        for k in range(seed, seed + seeds):
            drive = inertial_drive(DRIVES[name], k, 66.0 if name == "carried" else None)
            truth = Trajectory(drive.timestamps, drive.world_T_ego)
            for which in found:
                log = SensorLog({"imu": drive.imu}) if which == "with" else None
                result = lidar_slam(drive, settings=SETTINGS, log=log)
                e = trajectory_errors(result.trajectory, truth, "start")
                found[which].append((e.ate, e.end_error, end_nees(result, drive)))
        for which, rows in found.items():
            ate, end, nees = np.array(rows).T
            figures = {"ATE, m": float(ate.mean()), "end, m": float(end.mean()), "NEES": float(np.median(nees))}
            ratio = {"ATE / without": float(ate.mean() / np.mean([row[0] for row in found["without"]]))}
            yield "LiDAR SLAM and an IMU", {"drive": name, "IMU": which, **figures, **ratio}
