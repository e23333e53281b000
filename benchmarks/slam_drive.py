"""Cost of SLAM in the course of a long drive: a keyframe at its end beside one at its beginning, in one run.

The vehicle drives lap after lap through a simulated town. Its odometry, the poles and house fronts that it sees and the
loops between submaps come straight from the truth, with noise, so that time goes into the running graph alone and none
into scans. Times are CPU times of the process, on one thread.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from data_tools.simulator.course import SimulatedCourse
from data_tools.simulator.town import Town
from pipelines.process import one_thread, peak_memory
from pipelines.slam.scan_landmarks import POLE, WALL
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.slam.submaps import LoopClosure, SubmapGraph
from saga_fg.types.landmark import Observation

_START = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2
_MOTION = np.array([1e-4, 1e-4, 2e-4, 5e-3, 5e-3, 5e-3])  # standard deviations of a motion, rad and m
_LOOP = np.array([2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05])
_POLE, _WALL = 0.05, np.array([0.003, 0.003, 0.02])  # of observations, m; rad, rad, m
_POLES, _WALLS, _REACH = 6, 4, 25.0  # seen from a keyframe; m
_NEAR, _APART = 8.0, 10  # m between the places of anchors that make a loop, and submaps between them


@dataclass(frozen=True)
class DrivePart:
    """Keyframes `first` to `last`; milliseconds a keyframe, and of closing a submap with its loops; variables held."""

    first: int
    last: int
    keyframe: float
    submap: float
    variables: int


@dataclass(frozen=True)
class DriveCost:
    """A drive of so many keyframes: its tenths, and how cost a keyframe grew.

    ratio           of milliseconds a keyframe, the last lap to the first one, in the same streets; the last half to the
                    first one on a drive of less than two laps

    error, before   m, RMS distance from the truth of the whole drive at its end, and of odometry alone
    finish          s for the solution of everything together at the end
    memory          MB, largest of the process
    """

    keyframes: int
    metres: float
    submaps: int
    loops: int
    landmarks: int
    parts: list[DrivePart]
    ratio: float
    error: float
    before: float
    finish: float
    memory: float


def bench_drive(keyframes: int, seed: int = 0, progress: Progress | None = None) -> DriveCost:
    """Drive and measure."""
    course = SimulatedCourse(seed, 0.8 * keyframes + 10.0)
    poses, rng = course.world_T_ego[:keyframes], np.random.default_rng(seed)
    sights, graph = _Sights(course.town), SubmapGraph(poses[0], _START)
    cost, closing, sizes, loops = np.zeros(keyframes), np.zeros(keyframes), np.zeros(keyframes, dtype=int), 0
    odometry = [poses[0]]
    with one_thread():
        for k, pose in enumerate(poses):
            motion = None
            if k:
                motion = _noisy(inverse_transform(poses[k - 1]) @ pose, _MOTION, rng), np.diag(_MOTION**2)
                odometry.append(odometry[-1] @ motion[0])
            seen = sights.observed(pose, rng)
            began = time.process_time()
            closed = graph.append(float(course.timestamps[k]), motion, seen)
            graph.covariance()
            cost[k] = time.process_time() - began
            if closed:
                found = _loops(graph, poses, rng)
                began = time.process_time()
                graph.close_loops(found)
                closing[k], cost[k], loops = cost[k] + time.process_time() - began, np.nan, loops + len(found)
            sizes[k] = graph.size
            if progress is not None:
                progress("drive", k + 1, keyframes)
        began = time.process_time()
        solved = graph.finish()
        finish = time.process_time() - began
    edges = np.linspace(0, keyframes, 11).astype(int)
    lap = min(course.lap, float(course.way[keyframes - 1]) / 2)
    way = course.way[:keyframes]
    early, late = (float(np.nanmean(cost[rows])) for rows in (way <= lap, way >= way[-1] - lap))
    parts = []
    for a, b in pairwise(edges.tolist()):
        mean = 1e3 * float(np.nanmean(cost[a:b]))
        parts.append(DrivePart(a, b, mean, _mean_of(1e3 * closing[a:b]), int(sizes[a:b].max())))
    paths = (solved.world_T_pose, np.array(odometry))
    off = [float(np.sqrt(np.mean(np.sum((p - poses)[:, :3, 3] ** 2, axis=1)))) for p in paths]
    return DriveCost(
        keyframes=keyframes,
        metres=float(way[-1]),
        submaps=len(graph.anchors),
        loops=loops,
        landmarks=graph.landmarks,
        parts=parts,
        ratio=late / early,
        error=off[0],
        before=off[1],
        finish=finish,
        memory=peak_memory(),
    )


class _Sights:
    """Poles and fronts of houses of a town."""

    def __init__(self, town: Town) -> None:
        self._poles = town.world.poles[:, :2]
        houses = town.world.boxes.select(town.world.boxes.label == "house")
        c, s = np.cos(houses.yaw), np.sin(houses.yaw)
        normals = np.stack([np.column_stack([c, s]), np.column_stack([-s, c])])
        half = houses.size.T[:2] / 2
        self._half = np.concatenate([half[1 - axis] for axis in (0, 1) for _ in (1, -1)])
        self._normal = np.concatenate([sign * normals[axis] for axis in (0, 1) for sign in (1, -1)])
        self._centre = np.concatenate(
            [houses.position[:, :2] + sign * half[axis][:, None] * normals[axis] for axis in (0, 1) for sign in (1, -1)]
        )
        self._pole_tree, self._wall_tree = cKDTree(self._poles), cKDTree(self._centre)

    def observed(self, pose: FloatArray, rng: np.random.Generator) -> list[Observation]:
        """Observations from a pose (4, 4) of the nearest poles and the nearest fronts that face it."""
        place, lidar_T_world = pose[:2, 3], inverse_transform(pose)
        distance, rows = self._pole_tree.query(place, _POLES)
        seen = []
        for row in rows[distance < _REACH]:
            point = lidar_T_world[:3, :3] @ [*self._poles[row], pose[2, 3]] + lidar_T_world[:3, 3]
            seen.append(Observation(POLE, point + np.append(rng.normal(0, _POLE, 2), 0.0), _POLE**2 * np.eye(2)))
        near = np.array(self._wall_tree.query_ball_point(place, _REACH), dtype=np.int64)
        ahead = ((place - self._centre[near]) * self._normal[near]).sum(axis=1)
        for row in near[np.argsort(np.where(ahead > 1.0, ahead, np.inf))][:_WALLS]:
            if (place - self._centre[row]) @ self._normal[row] <= 1.0:
                continue
            nx, ny = self._normal[row].tolist()
            plane = gtsam.OrientedPlane3(nx, ny, 0.0, -float(self._normal[row] @ self._centre[row]))
            noisy = plane.transform(gtsam.Pose3(pose)).retract(_WALL * rng.normal(size=3))
            along = np.array([-self._normal[row, 1], self._normal[row, 0]]) * self._half[row]
            ends = np.column_stack([self._centre[row] + np.outer([-1, 1], along), np.full(2, pose[2, 3])])
            extent = ends @ lidar_T_world[:3, :3].T + lidar_T_world[:3, 3]
            seen.append(Observation(WALL, noisy.planeCoefficients(), np.diag(_WALL**2), extent))
        return seen


def _loops(graph: SubmapGraph, poses: FloatArray, rng: np.random.Generator) -> list[LoopClosure]:
    """A loop from the newest anchor to the nearest old one, if one is near in truth."""
    places = poses[list(graph.anchors), :2, 3]
    if len(places) <= _APART:
        return []
    distance = np.linalg.norm(places[:-_APART] - places[-1], axis=1)
    i, j = int(distance.argmin()), len(places) - 1
    if distance[i] > _NEAR:
        return []
    true = inverse_transform(poses[graph.anchors[i]]) @ poses[graph.anchors[j]]
    return [LoopClosure(i, j, _noisy(true, _LOOP, rng), np.diag(_LOOP**2))]


def _noisy(transform: FloatArray, sigma: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(gtsam.Pose3(transform).retract(sigma * rng.normal(size=6)).matrix())


def _mean_of(values: FloatArray) -> float:
    closed = values[values > 0]
    return float(closed.mean()) if len(closed) else float("nan")
