"""Pose graphs: the optimum does not depend on the guess, and its covariances are honest."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import gtsam
import numpy as np
import pytest

from factors import Robust, pose
from saga_fg import InputError
from saga_fg.slam.pose_graph import chordal_poses, factor_graph, nearest_rotations, optimise_poses, pose_values
from tests.saga_fg.loops import loop, moved


def test_the_chordal_start_is_exact_without_noise(subtests: pytest.Subtests) -> None:
    for dim, seed in product([2, 3], range(3)):
        with subtests.test(dim=dim, seed=seed):
            graph, true = loop(dim, seed)
            exact = replace(graph, first_T_second=np.linalg.inv(true[graph.first]) @ true[graph.second])
            np.testing.assert_allclose(chordal_poses(exact), true, atol=1e-9)


def test_a_worthless_guess_leads_to_the_optimum_near_the_truth(subtests: pytest.Subtests) -> None:
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
def test_covariances_cover_the_errors(dim: int) -> None:
    normalised = []
    for seed in range(8):
        graph, true = loop(dim, seed, noise=0.01)
        optimised = optimise_poses(graph)
        log = gtsam.Pose2.Logmap if dim == 2 else gtsam.Pose3.Logmap
        error = np.stack([log(pose("error", T)) for T in np.linalg.inv(optimised.world_T_pose[1:]) @ true[1:]])
        solved = np.linalg.solve(optimised.covariances()[1:], error[:, :, None])[:, :, 0]
        normalised.append((error * solved).sum(axis=1).mean() / error.shape[1])
    assert 0.6 < np.mean(normalised) < 1.6  # 1 on average; poses of one graph err together


def test_a_robust_loss_takes_the_harm_out_of_false_loop_closures() -> None:
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


def test_nearest_rotations_are_rotations() -> None:
    matrices = np.random.default_rng(0).normal(size=(20, 3, 3))
    R = nearest_rotations(matrices)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(nearest_rotations(3.0 * R), R, atol=1e-12)


def test_parts_without_connection_are_named() -> None:
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


def test_what_does_not_fit_together_is_refused(subtests: pytest.Subtests) -> None:
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
