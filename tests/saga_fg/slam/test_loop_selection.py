"""Loops are left out where other loops contradict them, and never by odometry alone."""

from __future__ import annotations

import time
from itertools import accumulate

import gtsam
import numpy as np
import pytest

from saga_fg.slam.pose_graph.optimisation import graph_values
from saga_fg.slam.submaps import LoopClosure
from saga_fg.slam.submaps.loops import LoopSelection, _AnchoredLoops, select_loops

PER_LAP, STEPS, EVERY = 100, 200, 5
STATED = np.array([1e-3] * 3 + [0.03] * 3)
OWN = np.array([2e-3] * 3 + [0.05] * 3)


def selected(
    count: int, seed: int = 0, noise: float = 1.0, turn: float = 0.0, false: tuple[float, ...] = ()
) -> LoopSelection:
    """Two laps of a circle; true loops from lap to lap, and a false one of this error behind them.

    noise: of odometry, times that stated; turn: its bias, rad a step
    """
    rng = np.random.default_rng(seed)
    step = gtsam.Pose3(gtsam.Rot3.Yaw(2 * np.pi / PER_LAP), [6.0, 0.0, 0.0])
    bias = gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.zeros(3))
    true, motions = [gtsam.Pose3()], []
    for _ in range(STEPS - 1):
        true.append(true[-1].compose(step))
        moved = step.compose(bias).retract(noise * STATED * rng.normal(size=6))
        motions.append((moved.matrix(), np.diag(STATED**2)))

    def loop(first: int, second: int, error: tuple[float, ...] = (0.0,) * 6) -> LoopClosure:
        between = true[EVERY * first].between(true[EVERY * second]).retract(np.array(error))
        seen = between.retract(OWN * rng.normal(size=6))
        return LoopClosure(first, second, seen.matrix(), np.diag(OWN**2), confirmed=True)

    loops = [loop(2 * k, 2 * k + PER_LAP // EVERY) for k in range(count)]
    loops += [loop(2, 25, false)] if false else []
    return select_loops(motions, range(0, STEPS, EVERY), loops)


@pytest.mark.parametrize(("noise", "turn"), [(1.0, 1e-3), (1.0, 5e-3), (5.0, 0.0)])
def test_true_loops_stay_however_far_odometry_is_off(noise: float, turn: float) -> None:
    for seed, count in enumerate((1, 2, 3, 3)):
        assert selected(count, seed, noise, turn).kept.all(), count


def test_a_false_loop_beside_true_ones_is_left_out(subtests: pytest.Subtests) -> None:
    for count in [1, 2, 4]:
        with subtests.test(count=count):
            for seed in range(3):
                found = selected(count, seed, false=(0.0, 0.0, 0.0, 20.0, 0.0, 0.0))  # its rotation is right
                np.testing.assert_array_equal(found.kept, [True] * count + [False])
                assert found.inflation.max() < 3.0


def test_a_false_loop_is_left_out_where_odometry_is_worse_than_it_says() -> None:
    for count in (2, 4):
        found = selected(count, noise=3.0, false=(0.0, 0.0, 0.1, 20.0, 10.0, 0.0))
        np.testing.assert_array_equal(found.kept, [True] * count + [False])
        assert 1.5 < found.inflation.max() < 6.0


def many(loops: int, anchors: int, false: int) -> tuple[LoopSelection, float]:
    """Lap after lap of a circle, loops to all laps before, the first `false` of them false; and CPU seconds."""
    rng = np.random.default_rng(loops)
    step = gtsam.Pose3(gtsam.Rot3.Yaw(2 * np.pi / PER_LAP), [6.0, 0.0, 0.0])
    true = list(accumulate([step] * (EVERY * anchors), lambda pose, moved: pose.compose(moved), initial=gtsam.Pose3()))
    odometry = [(step.retract(STATED * rng.normal(size=6)).matrix(), np.diag(STATED**2)) for _ in true[1:]]
    found, lap = [], PER_LAP // EVERY
    for row in range(loops):
        second = int(rng.integers(lap, anchors))
        first = second - lap * int(rng.integers(1, second // lap + 1))
        error = np.array([0.0, 0.0, 0.1, 10.0, 5.0, 0.0]) * rng.normal(size=6) * (row < false)
        between = true[EVERY * first].between(true[EVERY * second]).retract(error).retract(OWN * rng.normal(size=6))
        found.append(LoopClosure(first, second, between.matrix(), np.diag(OWN**2)))
    began = time.process_time()
    return select_loops(odometry, range(0, EVERY * anchors, EVERY), found), time.process_time() - began


def test_hundreds_of_loops_take_time_by_their_number() -> None:
    (few, short), (all_of_them, long) = many(50, 60, 2), many(500, 120, 2)
    for selection in (few, all_of_them):
        np.testing.assert_array_equal(selection.kept, np.arange(len(selection.kept)) >= 2)
    assert long < 100 * short  # by the dense covariance of all loops 1000


def test_nothing_is_known_without_loops() -> None:
    np.testing.assert_array_equal(selected(0).inflation, [1.0, 1.0])


@pytest.mark.parametrize("seed", range(2))
def test_the_cost_is_that_of_the_dense_covariance_of_all_loops(seed: int) -> None:
    """m^T C^-1 m + log |C| + 2 log s_1 s_2 but for a constant, where errors are small."""
    rng, small = np.random.default_rng(seed), 1e-3
    true = [gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(6)]
    A = small * rng.normal(size=(7, 6, 8))
    step, loops, parts = [], [], np.zeros((5, 3, 6, 6))
    for k in range(5):
        P = A[k] @ A[k].T
        parts[k, 0, :3, :3], parts[k, 1, 3:, 3:] = P[:3, :3], P[3:, 3:]
        parts[k, 2] = P - parts[k, 0] - parts[k, 1]
        step.append(true[k].between(true[k + 1]).retract(A[k] @ rng.normal(size=8)).matrix())
    ends, R = [(0, 4), (1, 5)], [A[k] @ A[k].T for k in (5, 6)]
    for k, (a, b) in enumerate(ends):
        seen = true[a].between(true[b]).retract(A[5 + k] @ rng.normal(size=8))
        loops.append(LoopClosure(a, b, seen.matrix(), R[k]))
    drive = _AnchoredLoops.from_steps(list(zip(step, parts, strict=True)), loops)
    poses = list(accumulate(map(gtsam.Pose3, step), lambda pose, moved: pose.compose(moved), initial=gtsam.Pose3()))
    m = np.concatenate(
        [
            gtsam.Pose3(loop.first_T_second).localCoordinates(poses[loop.first].between(poses[loop.second]))
            for loop in loops
        ]
    )
    J = np.zeros((12, 30))
    for row, (a, b) in enumerate(ends):
        for k in range(a, b):
            J[6 * row : 6 * row + 6, 6 * k : 6 * k + 6] = poses[b].between(poses[k + 1]).AdjointMap()
    off = []
    for inflation in (np.ones(2), np.array([2.0, 5.0])):
        s, t = inflation
        Q = np.zeros((30, 30))
        for k, P in enumerate(np.einsum("g,sgij->sij", [s**2, t**2, s * t], parts)):
            Q[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = P
        C = J @ Q @ J.T
        for row in range(2):
            C[6 * row : 6 * row + 6, 6 * row : 6 * row + 6] += R[row]
        expected = m @ np.linalg.solve(C, m) + np.linalg.slogdet(C)[1] + 2 * np.log(s * t)
        both = np.ones(2, dtype=bool)
        solution = drive.solved(both, inflation, graph_values(drive.measured))
        off.append(drive.cost(solution, both, inflation) - expected)
    assert off[0] == pytest.approx(off[1], abs=0.02)
