"""Range-only SLAM: a drive and its beacons from odometry and ranges of an uncalibrated radio.

A range does not say where its beacon is, so nothing can be begun from one. The beginning of the drive, by dead
reckoning, gives each beacon a first place by linear trilateration,

    z^2 = || l - t ||^2    =>    2 (t_k - t_mean)^T l = z_mean^2 - z_k^2 + |t_k|^2 - |t|^2_mean

From there everything is solved at once, for ever longer parts of the drive, each starting where the last ended and
going on by dead reckoning: poses, beacons, and the radio's scale and offset, with a robust loss over ranges, since
echoes are long.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from benchmarks.recordings.landmarks import LandmarkLog
from data_tools.trajectories import absolute_errors, matched, rigid_alignment
from factors import PlanarPose, ResidualFactors, Robust, SolverSettings, prior_factor
from pipelines.slam.results import planar_trajectory
from saga_fg.errors import InputError
from saga_fg.estimators import BatchSolver
from saga_fg.graph import EGO_ERROR, LANDMARK, Additions, GraphView, NewVariable, SceneFactorGraph, ask_all, key_of
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.slam.mapping import MeasuredMotion, landmark_key, pose_key

_SOLVER = SolverSettings(tolerance=1e-2, max_iterations=50)
_START = 1e-8  # variance of the first pose, m^2 and rad^2
_RANGES = 10  # at least, to place a beacon by
_LOSS = Robust("cauchy", 2.0)  # of ranges, standard deviations
_RADIO = np.diag([0.1, 1.0]) ** 2  # covariance of scale and offset (m) of the radio at the start
_BEGINNING = 100.0  # m driven before the beacons are placed
_GROWTH = 1.3  # ratio of the lengths of two successive parts of the drive
_CALIBRATION = key_of(EGO_ERROR, 0, None)


@dataclass(frozen=True, eq=False)
class BeaconMap:
    """world_T_pose (N, 3, 3), the first at the origin; beacons (2,) by number, and their covariances (2, 2), m and m^2;
    scale and offset (m) of the ranges; dead_reckoning (N, 3, 3).
    """

    world_T_pose: FloatArray
    beacons: dict[int, FloatArray]
    covariances: dict[int, FloatArray]
    scale: float
    offset: float
    dead_reckoning: FloatArray


def map_beacons(drive: LandmarkLog) -> BeaconMap:
    """Estimate all of a drive. Raises `InputError` for a beacon without ranges enough to place it."""
    reckoned = np.stack(list(accumulate(drive.a_T_b, np.matmul, initial=np.eye(3))))
    end = int(np.searchsorted(np.cumsum(np.hypot(*drive.a_T_b[:, :2, 2].T)), _BEGINNING)) + 2
    graph, numbers = SceneFactorGraph(), np.unique(drive.landmark).tolist()
    while graph.epoch + 1 < len(reckoned):
        for row in range(graph.epoch + 1, min(end, len(reckoned))):
            step = (
                (drive.a_T_b[row - 1], drive.odometry_covariance[row - 1]) if row else (np.eye(3), _START * np.eye(3))
            )
            graph.advance(max(drive.time[row], np.nextafter(graph.time, np.inf)))  # rows may have one time
            ask_all([MeasuredMotion(*step)], graph)
        poses = np.stack([graph.state(pose_key(row)).matrix() for row in range(graph.epoch + 1)])
        places: dict[int, FloatArray] = {}
        for number in numbers:
            seen = (drive.landmark == number) & (drive.pose <= graph.epoch)
            if landmark_key(number) not in graph.variables and np.count_nonzero(seen) >= _RANGES:
                places[number] = trilateration(poses[drive.pose[seen], :2, 2], drive.value[seen, 0])
        ask_all([_Ranges(drive, places)], graph)
        solver = BatchSolver(graph=graph, settings=_SOLVER)
        solver.solve()
        graph = solver.snapshot()
        end = max(end + 1, int(_GROWTH * end))
    beacons = {n: graph.state(landmark_key(n)) for n in numbers if landmark_key(n) in graph.variables}
    missing = set(numbers) - set(beacons)
    if missing:
        raise InputError(f"beacon {min(missing)}: expected at least {_RANGES} ranges to place it")
    poses = np.stack([graph.state(pose_key(row)).matrix() for row in range(len(reckoned))])
    covariances = {number: solver.covariance(landmark_key(number)) for number in beacons}
    scale, offset = graph.state(_CALIBRATION).tolist()
    return BeaconMap(poses, beacons, covariances, scale, offset, reckoned)


@dataclass(frozen=True, eq=False)
class _Ranges:
    """All ranges of beacons in the graph from poses in it, those at new places (2,) among them, and the calibration."""

    drive: LandmarkLog
    places: Mapping[int, FloatArray]
    name: str = "ranges"

    def factors(self, view: GraphView) -> Additions:
        drive = self.drive
        new = [NewVariable(LANDMARK, n, place, static=True, label="beacon") for n, place in self.places.items()]
        factors = []
        if _CALIBRATION not in view.variables:
            new.append(NewVariable(EGO_ERROR, 0, np.zeros(2), static=True, label="calibration"))
            factors.append(prior_factor(_CALIBRATION, np.zeros(2), _RADIO))
        used = (drive.pose <= view.epoch) & np.isin(drive.landmark, [*view.static(LANDMARK), *self.places])
        pairs = zip(drive.pose[used].tolist(), drive.landmark[used].tolist(), strict=True)
        rows = [[pose_key(row), landmark_key(number), _CALIBRATION] for row, number in pairs]
        ranges = _range_factors(rows, drive.value[used, 0], float(drive.covariance[0, 0, 0]))
        return Additions(new, factors, {"ranges": [ranges]})


def _range_factors(rows: list[list[int]], z: FloatArray, variance: float) -> ResidualFactors:
    """r = (1 + s) || l - t || + o - z of poses (R, t), beacons l and the radio's calibration (s, o); z (n,) m.

    With u the unit vector towards the beacon, and the pose moved to t + R v, dr/dv = -(1 + s) u^T R,
    dr/dl = (1 + s) u^T, dr/ds = || l - t ||, dr/do = 1.
    """

    def residual(pose: FloatArray, beacon: FloatArray, calibration: FloatArray) -> FloatArray:
        distance = np.linalg.norm(beacon - pose[:, :2, 2], axis=1)
        expected: FloatArray = (1 + calibration[:, 0]) * distance + calibration[:, 1]
        return (expected - z)[:, None]

    def jacobians(pose: FloatArray, beacon: FloatArray, calibration: FloatArray) -> list[FloatArray]:
        towards = beacon - pose[:, :2, 2]
        distance = np.linalg.norm(towards, axis=1)
        if (distance == 0).any():
            raise InputError("range: the pose is at its beacon, where the direction is undefined")
        scaled = ((1 + calibration[:, :1]) * towards / distance[:, None])[:, None, :]
        by_pose = np.concatenate([-scaled @ pose[:, :2, :2], np.zeros((len(z), 1, 1))], axis=2)
        return [by_pose, scaled, np.stack([distance, np.ones_like(distance)], axis=1)[:, None, :]]

    keys = np.array(rows, dtype=np.uint64).reshape(-1, 3)
    return ResidualFactors(keys, (PlanarPose(), 2, 2), residual, variance * np.eye(1), jacobians, _LOSS, name="ranges")


def compared(drive: LandmarkLog, found: BeaconMap) -> dict[str, float]:
    """Figures against the truth where there is one.

    The estimate is moved as a whole to lie nearest to the true path; beacons are compared after the same motion. The
    true heading has no part in it: its zero is not that of the direction of travel in every recording.
    """
    figures = {"scale": found.scale, "offset, m": found.offset}
    if drive.truth is None:
        return figures
    tolerance = float(np.diff(drive.time).max(initial=0.01))
    estimate, truth = matched(planar_trajectory(drive.time, found.world_T_pose), drive.truth, tolerance)
    reckoned, _ = matched(planar_trajectory(drive.time, found.dead_reckoning), drive.truth, tolerance)
    figures["ATE, m"] = _root_mean_square(absolute_errors(estimate, truth))
    figures["ATE of dead reckoning, m"] = _root_mean_square(absolute_errors(reckoned, truth))
    known = [number for number in found.beacons if number in drive.places]
    if known:
        truth_T_world = rigid_alignment(estimate.positions, truth.positions)
        places = np.array([[*found.beacons[number], 0.0] for number in known])
        off = transform_points(truth_T_world, places)[:, :2] - np.array([drive.places[number] for number in known])
        figures["beacons, m"] = _root_mean_square(np.linalg.norm(off, axis=1))
    return figures


def _root_mean_square(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def trilateration(places: FloatArray, ranges: FloatArray) -> FloatArray:
    """Return the point (2,) at these ranges (K,) from these places (K, 2), m, in the sense of linear least squares."""
    b = (ranges**2).mean() - ranges**2 + (places**2).sum(axis=1) - (places**2).sum(axis=1).mean()
    return np.asarray(np.linalg.lstsq(2 * (places - places.mean(axis=0)), b, rcond=None)[0])
