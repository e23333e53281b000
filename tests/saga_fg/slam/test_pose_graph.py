"""Pose graphs, running ones, and certificates of their optima."""

from dataclasses import replace
from itertools import product

import gtsam
import numpy as np
import pytest

from factors import Robust, pose
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import (
    ChordalCost,
    PointLandmarks,
    PoseGraph,
    PosePriors,
    chordal_minimum,
    chordal_poses,
    factor_graph,
    nearest_rotations,
    optimise_poses,
    pose_values,
)
from saga_fg.slam.pose_graph.certificate import descend, lowest_eigenvalue
from tests.saga_fg.loops import loop, moved


def test_the_chordal_start_is_of_rotations_and_exact_without_noise(subtests):
    for dim, seed in product([2, 3], range(3)):
        with subtests.test(dim=dim, seed=seed):
            graph, true = loop(dim, seed)
            exact = replace(graph, first_T_second=np.linalg.inv(true[graph.first]) @ true[graph.second])
            np.testing.assert_allclose(chordal_poses(exact), true, atol=1e-9)
    matrices = np.random.default_rng(0).normal(size=(20, 3, 3))
    R = nearest_rotations(matrices)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(nearest_rotations(3.0 * R), R, atol=1e-12)


def test_a_worthless_guess_leads_to_the_optimum_near_the_truth(subtests):
    for dim, seed in product([2, 3], range(3)):
        with subtests.test(dim=dim, seed=seed):
            graph, true = loop(dim, seed)
            optimised = optimise_poses(graph)
            factors = factor_graph(graph)
            near = gtsam.LevenbergMarquardtOptimizer(factors, pose_values(true)).optimize()
            assert optimised.error == pytest.approx(factors.error(near), rel=1e-5)
            assert factors.error(pose_values(optimised.world_T_pose)) == pytest.approx(optimised.error, rel=1e-9)
            assert optimised.error < factors.error(pose_values(true))
            np.testing.assert_allclose(optimised.world_T_pose[0], true[0], atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_covariances_cover_the_errors(dim):
    normalised = []
    for seed in range(8):
        graph, true = loop(dim, seed, noise=0.01)
        optimised = optimise_poses(graph)
        log = gtsam.Pose2.Logmap if dim == 2 else gtsam.Pose3.Logmap
        error = np.stack([log(pose("error", T)) for T in np.linalg.inv(optimised.world_T_pose[1:]) @ true[1:]])
        solved = np.linalg.solve(optimised.covariances()[1:], error[:, :, None])[:, :, 0]
        normalised.append((error * solved).sum(axis=1).mean() / error.shape[1])
    assert 0.6 < np.mean(normalised) < 1.6  # 1 on average; poses of one graph err together


def test_a_robust_loss_takes_the_harm_out_of_false_loop_closures():
    graph, true = loop(2, seed=1)
    false = graph.first_T_second.copy()
    closures = np.flatnonzero(np.abs(graph.second - graph.first) > 1)[::6]
    false[closures] = moved(2, np.random.default_rng(0).normal(scale=3.0, size=(len(closures), 3)))
    spoilt = replace(graph, first_T_second=false)
    errors = [
        np.linalg.norm(optimise_poses(spoilt, robust).world_T_pose[:, :2, 2] - true[:, :2, 2], axis=1).mean()
        for robust in (None, Robust("geman-mcclure", 3.0))
    ]
    assert errors[1] < 0.2
    assert errors[1] < 0.2 * errors[0]


def test_parts_without_connection_are_named():
    graph, _ = loop(2, seed=0)
    keep = (graph.first != 20) & (graph.second != 20)
    apart = replace(
        graph,
        first=graph.first[keep],
        second=graph.second[keep],
        first_T_second=graph.first_T_second[keep],
        information=graph.information[keep],
    )
    assert set(np.flatnonzero(apart.components() == 1)) == {20}
    with pytest.raises(InputError, match="pose 200: expected measurements that connect it"):
        optimise_poses(apart)


def test_what_does_not_fit_together_is_refused(subtests):
    for change, message in [
        ({"ids": np.zeros(36, dtype=int)}, "unique ids"),
        ({"first": np.full(59, 99)}, "first: expected rows"),
        ({"information": np.zeros((59, 3, 3))}, "positive definite"),
        ({"world_T_pose": np.ones((36, 3, 3))}, "world_T_pose.0.: expected a rigid transform"),
        ({"world_T_pose": np.ones((36, 5, 5))}, "3 x 3 or 4 x 4"),
    ]:
        with subtests.test(message):
            graph, _ = loop(2, seed=0)
            with pytest.raises(InputError, match=message):
                replace(graph, **change)


# The proof of the global minimum of the chordal cost, and the way to it from a bad local one


def ring(dim: int, poses: int = 20, seed: int = 0) -> PoseGraph:
    """One round of equal turns, each pose measured from the one before, the first from the last."""
    k = 3 * (dim - 1)
    turn = slice(2, 3) if dim == 2 else slice(0, 3)
    step, variance = np.zeros(k), np.full(k, 1e-2)
    step[0 if dim == 2 else 3], step[2] = 1.0, 2 * np.pi / poses
    variance[turn] = 1e-4
    measured = moved(dim, step + 0.01 * np.random.default_rng(seed).normal(size=(poses, k)))
    first = np.arange(poses)
    information = np.tile(np.diag(1 / variance), (poses, 1, 1))
    return PoseGraph.of_measurements(np.arange(poses), first, (first + 1) % poses, measured, information)


def twice_round(dim: int, poses: int = 20) -> FloatArray:
    """Poses whose headings go round twice on the way."""
    T, angle = np.tile(np.eye(dim + 1), (poses, 1, 1)), 4 * np.pi * np.arange(poses) / poses
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angle)
    T[:, 1, 0], T[:, 0, 1] = np.sin(angle), -np.sin(angle)
    return T


def test_a_staircase_that_ends_early_has_a_bound_and_no_proof(monkeypatch):
    graph, start = ring(2, poses=60), twice_round(2, poses=60)
    whole = chordal_minimum(graph, start)
    monkeypatch.setattr("saga_fg.slam.pose_graph.certificate._MAX_WORK", 1)
    early = chordal_minimum(graph, start)
    assert whole.certified
    assert not early.certified
    assert early.bound <= whole.cost < early.cost


@pytest.mark.parametrize("dim", [2, 3])
def test_the_cost_is_the_sum_over_measurements_and_none_where_all_agree(dim):
    graph, true = loop(dim, seed=2)
    T, covariance = graph.first_T_second, np.linalg.inv(graph.information)
    kappa = (1.0 if dim == 2 else 1.5) / np.trace(covariance[:, graph.rotation, graph.rotation], axis1=1, axis2=2)
    tau = dim / np.trace(covariance[:, graph.translation, graph.translation], axis1=1, axis2=2)
    R, t = true[:, :dim, :dim], true[:, :dim, dim]
    turned = R[graph.second] - R[graph.first] @ T[:, :dim, :dim]
    shifted = t[graph.second] - t[graph.first] - (R[graph.first] @ T[:, :dim, dim:])[:, :, 0]
    expected = (kappa * (turned**2).sum(axis=(1, 2)) + tau * (shifted**2).sum(axis=1)).sum()
    assert ChordalCost.of(graph).at(true) == pytest.approx(expected, rel=1e-9)
    graph, true = loop(dim, seed=0)
    exact = replace(graph, first_T_second=np.linalg.inv(true[graph.first]) @ true[graph.second])
    minimum = chordal_minimum(exact, chordal_poses(exact))
    assert (minimum.cost, minimum.bound, minimum.gap) == (0.0, 0.0, 0.0)
    assert minimum.certified


def seen_from_outside(dim: int, noise: float, seed: int = 0) -> tuple[PoseGraph, FloatArray, FloatArray]:
    """A loop with priors on two poses and four points, each seen from every third pose; the true poses and points."""
    graph, true = loop(dim, seed=seed)
    true, k, rng = np.linalg.inv(true[3]) @ true, 3 * (dim - 1), np.random.default_rng(seed)
    points = true[[0, 5, 10, 15], :dim, dim] + rng.normal(size=(4, dim))
    pose, landmark = (each.ravel() for each in np.meshgrid(np.arange(0, len(graph), 3), np.arange(4)))
    R, t = true[pose, :dim, :dim], true[pose, :dim, dim]
    z = (R.swapaxes(1, 2) @ (points[landmark] - t)[:, :, None])[:, :, 0] + noise * rng.normal(size=(len(pose), dim))
    information = np.tile(np.diag(np.arange(1.0, dim + 1)), (len(pose), 1, 1))
    priors = PosePriors(np.array([3, 9]), true[[3, 9]], np.tile(100 * np.eye(k), (2, 1, 1)))
    landmarks = PointLandmarks(1000 + np.arange(4), np.full((4, dim), np.nan), pose, landmark, z, information)
    return replace(graph, priors=priors).with_landmarks(landmarks), true, points


@pytest.mark.parametrize("dim", [2, 3])
def test_points_and_priors_are_part_of_the_cost(dim):
    graph, true, points = seen_from_outside(dim, noise=0.2)
    seen = graph.landmarks
    assert seen is not None
    T = true[seen.pose]
    off = points[seen.landmark] - T[:, :dim, dim] - (T[:, :dim, :dim] @ seen.z[:, :, None])[:, :, 0]
    tau = dim / np.trace(np.linalg.inv(seen.information), axis1=1, axis2=2)
    frame = np.concatenate([true, np.eye(dim + 1)[None]])  # at which the priors agree
    expected = ChordalCost.of(replace(graph, landmarks=None, priors=None)).at(true) + (tau * (off**2).sum(axis=1)).sum()
    assert ChordalCost.of(graph).at(frame, points) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_graph_with_points_and_priors_is_certified_in_the_frame_of_the_priors(dim):
    graph, true, _ = seen_from_outside(dim, noise=0.05)
    away = np.eye(dim + 1)
    away[:dim, dim] = 50.0
    optimised = optimise_poses(graph.at(away @ graph.world_T_pose), certify=True)
    assert optimised.chordal is not None
    assert optimised.chordal.certified
    assert optimised.errors["chordal minimum"] == pytest.approx(optimised.error, rel=1e-6)
    for poses in (optimised.chordal.world_T_pose, chordal_poses(graph)):
        assert np.abs((poses - true)[:, :dim, dim]).max() < 0.5
    assert optimised.landmarks is not None


def test_the_minimum_is_proven_and_no_other_poses_are_below_the_bound(subtests):
    for dim, seed in product([2, 3], range(3)):
        with subtests.test(dim=dim, seed=seed):
            graph, true = loop(dim, seed)
            minimum = chordal_minimum(graph, chordal_poses(graph))
            cost = ChordalCost.of(graph)
            assert minimum.certified
            assert minimum.bound <= minimum.cost <= cost.at(true)
            assert minimum.cost == pytest.approx(cost.at(minimum.world_T_pose), rel=1e-9)
            np.testing.assert_allclose(minimum.world_T_pose[0], graph.world_T_pose[0], atol=1e-9)
            rng, k = np.random.default_rng(seed), 3 * (dim - 1)
            for scale in (0.01, 0.1, 1.0):
                assert cost.at(true @ moved(dim, scale * rng.normal(size=(len(true), k)))) > minimum.bound


@pytest.mark.parametrize("dim", [2, 3])
def test_a_bad_local_minimum_is_told_and_left(dim):
    graph, start = ring(dim), twice_round(dim)
    cost = ChordalCost.of(graph)
    stuck = descend(cost, start[:, :dim, :dim].swapaxes(1, 2))
    lowest = lowest_eigenvalue(cost, stuck.Y)
    assert stuck.cost + dim * len(graph) * lowest.value < 0.5 * stuck.cost
    assert lowest.direction is not None
    minimum, known = chordal_minimum(graph, start), chordal_minimum(graph, chordal_poses(graph))
    assert stuck.cost > 1000 * known.cost
    assert minimum.cost == pytest.approx(known.cost, rel=1e-6)
    assert minimum.certified
    assert known.certified


@pytest.mark.parametrize("dim", [2, 3])
def test_the_lowest_eigenvalue_is_that_of_the_dense_matrix(dim):
    graph = ring(dim)
    cost, n = ChordalCost.of(graph), len(graph)
    for start in (twice_round(dim), chordal_poses(graph)):
        Y = descend(cost, start[:, :dim, :dim].swapaxes(1, 2)).Y
        Q = cost.times(np.eye(n * dim))
        product = (Q @ Y.reshape(-1, dim)).reshape(Y.shape) @ Y.swapaxes(1, 2)
        S = Q.copy()
        for i in range(n):
            block = slice(i * dim, (i + 1) * dim)
            S[block, block] -= (product[i] + product[i].T) / 2
        dense = np.linalg.eigvalsh((S + S.T) / 2)[0]
        assert lowest_eigenvalue(cost, Y).value == pytest.approx(min(dense, 0.0), rel=1e-2, abs=1e-6)


def test_other_starts_are_tried_beside_proven_poses_only_where_they_are_better():
    graph, _ = loop(2, seed=1)
    far = optimise_poses(graph.at(twice_round(2, poses=len(graph))), certify=True)
    assert far.chordal is not None
    assert far.chordal.certified
    assert set(far.errors) == {"chordal minimum"}
    assert optimise_poses(graph).chordal is None
    there = optimise_poses(graph.at(far.world_T_pose), certify=True)
    assert there.error <= far.error * (1 + 1e-9)
