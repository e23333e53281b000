"""Which loops are believed. Loops are left out where other loops contradict them, and never by odometry alone."""

from dataclasses import replace
from itertools import accumulate

import gtsam
import numpy as np
import pytest

from benchmarks.pose_graphs import city, torus
from data_tools.pose_graphs import read_g2o
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import (
    PointLandmarks,
    PoseGraph,
    PosePriors,
    PositionPriors,
    consensus,
    graph_error,
    optimise_poses,
    trusted,
)
from saga_fg.slam.pose_graph.optimisation import chosen_edges, graph_values
from saga_fg.slam.submaps import LoopClosure
from saga_fg.slam.submaps.between import LoopSelection, _AnchoredLoops, select_loops
from tests.saga_fg.loops import with_false_loops

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
def test_true_loops_stay_however_far_odometry_is_off(noise, turn):
    for seed, count in enumerate((1, 2, 3, 3)):
        assert selected(count, seed, noise, turn).kept.all(), count
    np.testing.assert_array_equal(selected(0).inflation, [1.0, 1.0])


def test_false_loops_are_left_out_beside_true_ones_and_poor_odometry(subtests):
    for count in [1, 4]:
        with subtests.test(count=count):
            for seed in range(2):
                found = selected(count, seed, false=(0.0, 0.0, 0.0, 20.0, 0.0, 0.0))  # its rotation is right
                np.testing.assert_array_equal(found.kept, [True] * count + [False])
                assert found.inflation.max() < 3.0
    for count in (2, 4):
        found = selected(count, noise=3.0, false=(0.0, 0.0, 0.1, 20.0, 10.0, 0.0))
        np.testing.assert_array_equal(found.kept, [True] * count + [False])
        assert 1.5 < found.inflation.max() < 6.0


@pytest.mark.parametrize("seed", range(2))
def test_the_cost_is_that_of_the_dense_covariance_of_all_loops(seed):
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


# False loops are left out, true ones kept, whatever the covariances in the file are worth


@pytest.mark.parametrize(("share", "seed"), [(0.3, 2), (1.0, 0)])
def test_few_loops_and_poor_odometry(recordings, share, seed):
    """Loops that a bad solution puts far out come back when it is better."""
    graph = read_g2o(recordings / "slam" / "MIT.g2o")
    agreed = consensus(with_false_loops(graph, share, seed))
    assert agreed.kept[: len(graph.first)].all()
    assert not agreed.kept[len(graph.first) :].any()


def graph_of(dim: int) -> PoseGraph:
    graph, _ = city(200, seed=1) if dim == 2 else torus(100, seed=1, windings=10)
    return graph


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("scale", [1.0, 1 / 25])
def test_the_optimum_is_that_without_the_false_loops(dim, scale):
    """scale: of the information, as files have it that overstate their noise."""
    graph = graph_of(dim)
    graph = replace(graph, information=scale * graph.information)
    spoilt = with_false_loops(graph, 0.5, seed=3)
    agreed = consensus(spoilt)
    true = len(graph.first)
    assert not agreed.kept[true:].any()
    assert agreed.kept[:true].mean() > 0.98
    assert agreed.kept[trusted(spoilt)].all()
    clean, found = optimise_poses(graph), optimise_poses(agreed.graph)
    off = (found.world_T_pose - clean.world_T_pose)[:, :dim, dim]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05


def test_priors_and_landmarks_take_part_and_are_kept():
    """The graph lies where the priors say, and landmarks seen from far apart speak against false loops too."""
    graph, true = city(200, seed=1)
    away = np.eye(3)
    away[:2, 2] = [300.0, -40.0]
    pose, point = np.arange(0, 200, 10), np.zeros(20, dtype=np.int64)
    z = (np.linalg.inv(true[pose]) @ np.array([5.0, 6.0, 1.0]))[:, :2]
    information = np.tile(np.eye(2), (20, 1, 1))
    landmarks = PointLandmarks(np.array([999]), np.array([[0.0, 0.0]]), pose, point, z, information)
    priors = PosePriors(np.array([7, 150]), away @ true[[7, 150]], np.tile(100 * np.eye(3), (2, 1, 1)))
    spoilt = replace(with_false_loops(graph, 0.5, seed=3), priors=priors, landmarks=landmarks)
    agreed, edges = consensus(spoilt), len(graph.first)
    assert not agreed.kept[edges:].any()
    assert agreed.kept[:edges].mean() > 0.98
    assert agreed.graph.landmarks is not None
    np.testing.assert_allclose(agreed.graph.landmarks.position, [[305.0, -34.0]], atol=1.0)
    assert np.abs((agreed.graph.world_T_pose - away @ true)[:, :2, 2]).max() < 1.5


def test_a_gap_in_the_odometry_is_bridged_and_a_graph_in_pieces_refused():
    graph = graph_of(2)
    agreed = consensus(chosen_edges(graph, ~trusted(graph) | (np.minimum(graph.first, graph.second) != 150)))
    assert agreed.kept.mean() > 0.98
    graph = graph_of(2)
    with pytest.raises(InputError, match="expected measurements that connect it with the first pose"):
        consensus(chosen_edges(graph, graph.first < 10))


def test_a_graph_without_measurements_is_kept():
    none = np.zeros(0, dtype=np.int64)
    alone = PoseGraph(np.arange(1), np.eye(3)[None], none, none, np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    agreed = consensus(alone)
    assert agreed.kept.shape == (0,)
    assert len(agreed.graph) == 1


# Places of poses known from outside, as by GPS, in a pose graph


def surveyed(dim: int, sigma: float = 0.01) -> tuple[PoseGraph, FloatArray]:
    """A graph of which every tenth place is known, in a world other than the guess's, and the true poses there."""
    graph, true = city(120, seed=3) if dim == 2 else torus(120, seed=3, windings=6)
    world = np.eye(dim + 1)
    world[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    world[:dim, dim] = np.arange(dim) + 20.0
    true = world @ true
    rows = np.arange(0, len(graph), 10)
    information = np.tile(np.eye(dim) / sigma**2, (len(rows), 1, 1))
    return replace(graph, places=PositionPriors(rows, true[rows, :dim, dim], information)), true


@pytest.mark.parametrize("dim", [2, 3])
def test_known_places_say_where_the_graph_is_and_how_it_is_turned(dim):
    graph, true = surveyed(dim)
    optimised = optimise_poses(graph, certify=True)
    off = optimised.world_T_pose[:, :dim, dim] - true[:, :dim, dim]
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert graph.places is not None
    assert np.linalg.norm(off[graph.places.pose], axis=1).max() < 0.05
    assert graph_error(graph.at(optimised.world_T_pose)) == pytest.approx(optimised.error)
    assert optimised.chordal is not None
    assert optimised.chordal.certified
    near = optimised.chordal.world_T_pose[:, :dim, dim] - true[:, :dim, dim]
    assert np.linalg.norm(near, axis=1).max() < 0.3
    spread = optimised.covariances()[:, -dim:, -dim:] if dim == 3 else optimised.covariances()[:, :2, :2]
    assert np.sqrt(spread[graph.places.pose].max()) < 0.011  # no worse than what is known of them


def test_known_places_count_by_their_distance_and_find_false_loops():
    graph, _ = surveyed(2)
    assert graph.places is not None
    off = graph.world_T_pose[graph.places.pose, :2, 2] - graph.places.position
    expected = 0.5 * np.einsum("ni,nij,nj", off, graph.places.information, off)
    held = replace(graph, places=None)
    assert graph_error(graph) == pytest.approx(expected + graph_error(held))
    graph, true = surveyed(2)
    places = graph.places
    spoilt = replace(with_false_loops(replace(graph, places=None), 0.5, seed=1), places=places)
    agreed = consensus(spoilt)
    assert not agreed.kept[len(graph.first) :].any()
    assert np.linalg.norm((agreed.graph.world_T_pose - true)[:, :2, 2], axis=1).max() < 0.3


def test_too_few_places_are_refused_unless_a_pose_is_known(subtests):
    for dim, count in [(2, 1), (3, 2)]:
        with subtests.test(dim=dim, count=count):
            graph, true = surveyed(dim)
            places = graph.places
            assert places is not None
            few = replace(
                graph, places=PositionPriors(places.pose[:count], places.position[:count], places.information[:count])
            )
            with pytest.raises(InputError, match="nothing tells which way the graph is turned"):
                optimise_poses(few)
            k = 3 * (dim - 1)
            known = PosePriors(np.array([0]), true[:1], 1e6 * np.eye(k)[None])
            off = optimise_poses(replace(few, priors=known), certify=True).world_T_pose[0] - true[0]
            assert np.abs(off).max() < 0.05
