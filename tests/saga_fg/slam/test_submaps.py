"""Incremental SLAM in submaps: against the whole graph solved at once, far from the start, with loops and providers."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
import pytest

from factors import SolverSettings
from saga_fg import Detections, Frame, InputError
from saga_fg.estimators.solvers import BatchSolver
from saga_fg.model import PlaneLandmark, PoleLandmark
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.providers.vehicle_sensors import Gps
from saga_fg.slam.mapping import pose_key
from saga_fg.slam.submaps import LoopClosure, LoopSelection, SubmapGraph, SubmapSettings
from saga_fg.types.frame import EgoMeasurements, GpsFix, Observation

FIRST = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2
Q = np.diag([2e-4, 2e-4, 5e-4, 5e-3, 5e-3, 5e-3]) ** 2
POOR = np.diag([5e-4, 5e-4, 1e-2, 2e-2, 2e-2, 5e-3]) ** 2
POLE, WALL = PoleLandmark(), PlaneLandmark(name="wall")


def square(count: int, side: float = 40.0, step: float = 0.5) -> np.ndarray:
    """Poses (count, 4, 4) round a square block."""
    poses, turning, per = [np.eye(4)], 8, int(side / step)
    for k in range(count - 1):
        turn = np.pi / 2 / turning if k % per >= per - turning else 0.0
        poses.append(poses[-1] @ yaw_transform(step, yaw=turn))
    return np.array(poses)


class Drive:
    """Measured motions and observations of poles and walls along poses, with noise."""

    def __init__(self, poses: np.ndarray, seed: int = 0, Q: np.ndarray = Q, landmarks: bool = True) -> None:
        rng = np.random.default_rng(seed)
        centre = poses[:, :2, 3].mean(axis=0)
        poles = centre + rng.uniform(-50, 50, (150, 2))
        angle = rng.uniform(-np.pi, np.pi, 20)
        normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(20)])
        walls = [
            gtsam.OrientedPlane3(*n, d - n[:2] @ centre) for n, d in zip(normal, rng.uniform(30, 60, 20), strict=True)
        ]
        self.poses, self.poles, self.motions, self.observations = poses, poles, [None], []
        for last, pose in pairwise(poses):
            moved = gtsam.Pose3(inverse_transform(last) @ pose).retract(rng.normal(size=6) * np.sqrt(np.diag(Q)))
            self.motions.append((moved.matrix(), Q))
        for pose in poses:
            if not landmarks:
                self.observations.append([])
                continue
            near = np.argsort(np.linalg.norm(poles - pose[:2, 3], axis=1))[:6]
            self.observations.append([self.pole(pose, row, rng) for row in near])
            self.observations[-1] += [self.wall(gtsam.Pose3(pose), wall, rng) for wall in walls[:3]]

    def pole(self, pose: np.ndarray, row: int, rng: np.random.Generator) -> Observation:
        z = inverse_transform(pose) @ [*self.poles[row], rng.uniform(-1, 1), 1.0]
        return Observation(POLE, z[:3] + rng.normal(0, 0.05, 3) * [1, 1, 0], 0.05**2 * np.eye(2))

    def wall(self, pose: gtsam.Pose3, wall: gtsam.OrientedPlane3, rng: np.random.Generator) -> Observation:
        sigma = np.array([0.01, 0.01, 0.05])
        seen = wall.transform(pose).retract(sigma * rng.normal(size=3)).planeCoefficients()
        return Observation(WALL, seen, np.diag(sigma**2))

    def into(self, graph: SubmapGraph, rows: range, frames: Sequence[Frame | None] | None = None) -> list[int]:
        """Add keyframes; returns those that closed a submap."""
        closed = []
        for k in rows:
            if graph.append(0.1 * k, self.motions[k], self.observations[k], None if frames is None else frames[k]):
                closed.append(k)
        return closed


def started(drive: Drive, settings: SubmapSettings | None = None, providers: Sequence[Any] = ()) -> SubmapGraph:
    return SubmapGraph(drive.poses[0], FIRST, settings, providers)


def sigmas(estimate: np.ndarray, other: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    off = [gtsam.Pose3(a).localCoordinates(gtsam.Pose3(b)) for a, b in zip(estimate, other, strict=True)]
    return np.array([np.sqrt(x @ np.linalg.solve(P, x)) for x, P in zip(off, covariances, strict=True)])


def test_the_end_is_the_minimum_of_all_measurements():
    drive = Drive(square(150))
    graph = started(drive, SubmapSettings(length=15.0))
    assert len(drive.into(graph, range(150))) == 4
    found = graph.finish()
    alone = BatchSolver(graph=graph.measurements(found.loops)[0], settings=SolverSettings(tolerance=1e-9)).solve()
    poses = [alone.values.atPose3(pose_key(k)).matrix() for k in range(150)]
    assert sigmas(found.world_T_pose, poses, found.covariances).max() < 1e-3
    np.testing.assert_allclose(found.covariances[77], alone.marginal(pose_key(77)), rtol=1e-4, atol=1e-12)
    truth = sigmas(found.world_T_pose, drive.poses, found.covariances)
    assert np.sqrt(np.mean(truth[1:] ** 2) / 6) < 1.5


def test_while_running_submaps_say_nearly_what_their_measurements_do():
    drive = Drive(square(150))
    settings = SubmapSettings(length=15.0, confirm_after=1, robust_scale=100.0, relinearise_above=1e-3)
    graph = started(drive, settings)
    drive.into(graph, range(150))
    found = graph.finish()
    off = sigmas(graph.poses(), found.world_T_pose, found.covariances)
    assert off[graph.anchors[-1] :].max() < 0.02
    assert off[graph.anchors].max() < 0.5  # the others hear of the running submap when it is closed
    np.testing.assert_allclose(graph.covariance(), found.covariances[-1], rtol=0.05, atol=3e-6)


def test_a_graph_stays_small_and_landmarks_keep_their_numbers():
    drive = Drive(square(200))
    graph = started(drive, SubmapSettings(length=10.0))
    sizes = []
    for k in range(200):
        drive.into(graph, range(k, k + 1))
        sizes.append(len(graph.smoother.graph().variables))
    assert max(sizes[150:]) < max(sizes[:50]) + 200 / 20
    assert len(graph.anchors) == 10
    by_submap: dict[int, set[int]] = {}
    for k, now in enumerate(graph.seen):
        by_submap.setdefault(int(np.searchsorted(graph.anchors, k, side="right")) - 1, set()).update(n for n, _ in now)
    assert all(not by_submap[i] & by_submap[i + 1] for i in range(9))
    poles = [mark for mark in graph.finish().landmarks if mark.kind == POLE]
    off = [np.linalg.norm(drive.poles - mark.state, axis=1).min() for mark in poles]
    assert np.median(off) < 0.3


def test_far_from_the_start_association_is_the_same():
    near, far = Drive(square(60)), Drive(yaw_transform(5000.0, -5000.0) @ square(60))
    graphs = [started(near), started(far)]
    for drive, graph in zip((near, far), graphs, strict=True):
        drive.into(graph, range(60))
    numbers = [[n for now in graph.seen for n, _ in now] for graph in graphs]
    assert numbers[0] == numbers[1]


def test_fronts_in_one_plane_are_walls_of_their_own():
    def seen(x: float, d: float) -> Observation:
        return Observation(WALL, [0, -1, 0, d], np.diag([3e-3, 3e-3, 0.02]) ** 2, [[x - 3, d, 0], [x + 3, d, 2]])

    graph = SubmapGraph(np.eye(4), FIRST)
    graph.append(0.0, None, [seen(0.0, 8.0), seen(12.0, 8.02)])
    graph.append(0.1, (yaw_transform(1.0), Q), [seen(4.0, 8.0), seen(11.0, 8.02)])  # on from the first; the second
    assert [n for now in graph.seen for n, _ in now] == [1, 2, 1, 2]
    graph.append(0.2, (yaw_transform(1.0), Q), [seen(22.0, 8.0), Observation(WALL, [0, -1, 0, 8.0], Q[:3, :3])])
    assert graph.seen[-1][0][0] == 3


def test_a_loop_moves_submaps_as_a_whole():
    drive = Drive(square(330), 0, POOR, landmarks=False)  # once round, and on
    graph = started(drive, SubmapSettings(length=20.0))
    drive.into(graph, range(330))
    off = np.linalg.norm(graph.poses()[:, :3, 3] - drive.poses[:, :3, 3], axis=1)
    assert off.max() > 1.0
    first, second = graph.anchors[0], graph.anchors[-1]
    seen = inverse_transform(drive.poses[first]) @ drive.poses[second]
    inner = inverse_transform(graph.pose(graph.anchors[3])) @ graph.pose(graph.anchors[3] + 5)
    graph.close_loops([LoopClosure(0, len(graph.anchors) - 1, seen, np.diag([1e-3] * 3 + [0.02] * 3) ** 2)])
    assert np.linalg.norm(graph.pose(second)[:3, 3] - drive.poses[second, :3, 3]) < 0.1
    np.testing.assert_allclose(
        inverse_transform(graph.pose(graph.anchors[3])) @ graph.pose(graph.anchors[3] + 5), inner, atol=1e-9
    )
    found = graph.finish()
    assert np.linalg.norm(found.world_T_pose[:, :3, 3] - drive.poses[:, :3, 3], axis=1).max() < 0.7 * off.max()
    stated, _ = graph.measurements(LoopSelection(np.ones(1, dtype=bool), np.ones(2)))
    alone = BatchSolver(graph=stated, settings=SolverSettings(tolerance=1e-9)).solve()
    anchors = [alone.values.atPose3(pose_key(k)).matrix() for k in graph.anchors]
    assert sigmas(graph.world_T_anchor(), np.array(anchors), found.covariances[graph.anchors]).max() < 0.1
    with pytest.raises(InputError, match="loop: expected two submaps in order, got 3 and 3"):
        graph.close_loops([LoopClosure(3, 3, seen, Q)])


def test_a_loop_that_is_none_names_its_ends(subtests):
    for motion, covariance, message in [
        (np.eye(3), Q, r"first_T_second: expected shape \(4, 4\), got \(3, 3\)"),
        (np.eye(4), Q[:3, :3], r"covariance: expected shape \(6, 6\), got \(3, 3\)"),
        (np.eye(4), Q + np.triu(np.full((6, 6), 1e-9), 1), "covariance: expected a symmetric matrix"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=f"loop from 2 to 5: {message}"):
            LoopClosure(2, 5, motion, covariance)


def test_fixes_of_gps_hold_through_closed_submaps():
    poses, rng = square(120), np.random.default_rng(1)
    drive = Drive(poses, 0, POOR, landmarks=False)
    frames = [
        Frame(0.1 * k, "lidar", Detections.empty(), ego=EgoMeasurements(gps=GpsFix(place)))
        for k, place in enumerate(poses[:, :3, 3] + rng.normal(0, 0.3, (120, 3)))
    ]
    fixes = started(drive, SubmapSettings(length=10.0), [Gps(deviation=0.3, height_deviation=0.3, gate=1.0)])
    without = started(drive, SubmapSettings(length=10.0))
    drive.into(fixes, range(120), frames)
    drive.into(without, range(120))
    off = [np.linalg.norm(graph.pose(119)[:2, 3] - poses[119, :2, 3]) for graph in (fixes, without)]
    assert off[0] < 0.5
    assert off[0] < 0.5 * off[1]
    found = fixes.finish()
    assert np.linalg.norm(found.world_T_pose[:, :2, 3] - poses[:, :2, 3], axis=1).max() < 0.6
    solved, covariances = found.world_T_pose[fixes.anchors], found.covariances[fixes.anchors]
    assert sigmas(fixes.world_T_anchor(), solved, covariances)[-1] < 0.1
    assert (
        sigmas(fixes.world_T_anchor(), solved, covariances).max() < 2.0
    )  # the others hear of the running submap when it is closed


def test_a_keyframe_that_is_refused_leaves_the_graph_as_it_was():
    drive = Drive(square(6))
    graph = started(drive)
    drive.into(graph, range(3))
    before = graph.poses()
    with pytest.raises(InputError, match="motion: expected one for every keyframe but the first"):
        graph.append(0.3, None)
    with pytest.raises(ValueError, match="time"):
        graph.append(0.1, drive.motions[3], drive.observations[3])
    np.testing.assert_array_equal(graph.poses(), before)
    drive.into(graph, range(3, 6))
    assert len(graph) == 6
    with pytest.raises(InputError, match="expected at least one keyframe"):
        started(drive).finish()


def looping() -> tuple[SubmapGraph, list[LoopClosure]]:
    """Nearly twice round a block, with a true loop at every submap of the second round."""
    drive, rng = Drive(square(500), 3, POOR, landmarks=False), np.random.default_rng(0)
    graph, loops = started(drive, SubmapSettings(length=15.0)), []
    R = np.diag([1e-3] * 3 + [0.02] * 3) ** 2
    for k in range(500):
        drive.into(graph, range(k, k + 1))
        number = len(graph.anchors) - 1
        if graph.anchors[-1] == k and number > 8:
            places = drive.poses[graph.anchors[:-5], :3, 3]
            first = int(np.linalg.norm(places - drive.poses[k, :3, 3], axis=1).argmin())
            true = inverse_transform(drive.poses[graph.anchors[first]]) @ drive.poses[k]
            seen = gtsam.Pose3(true).retract(rng.normal(size=6) * np.sqrt(np.diag(R))).matrix()
            loops.append(LoopClosure(first, number, seen, R, confirmed=True))
            graph.close_loops(loops[-1:])
    return graph, loops


def test_a_false_loop_does_not_bend_the_map():
    graph, loops = looping()
    assert len(loops) >= 4
    clean = graph.finish()
    assert clean.loops.kept.all()
    false = LoopClosure(2, len(graph.anchors) - 2, yaw_transform(5.0, 4.0), loops[0].covariance, confirmed=True)
    graph.close_loops([false])
    spoilt = graph.finish()
    np.testing.assert_array_equal(spoilt.loops.kept, [True] * len(loops) + [False])
    np.testing.assert_allclose(spoilt.world_T_pose, clean.world_T_pose, atol=0.02)
