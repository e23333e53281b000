"""Pose graphs made up: true poses fit the measurements, and the optimum's error is what statistics expect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from data_tools.pose_graphs import city, cube, grid, sphere, torus
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph import PoseGraph, factor_graph, optimise_poses, pose_values

Generator = Callable[..., tuple[PoseGraph, FloatArray]]


def test_residuals_at_the_truth_are_the_noise(subtests: pytest.Subtests) -> None:
    for make in [city, torus, sphere, grid, cube]:
        with subtests.test(make=make):
            graph, true = make(1200, seed=0)
            residuals = len(graph.first) * graph.information.shape[1]
            error = factor_graph(graph).error(pose_values(true))
            assert 2 * error / residuals == pytest.approx(1, abs=6 * np.sqrt(2 / residuals))
            assert (graph.components() == 0).all()
            assert len(graph.first) > 1.1 * len(graph)  # there are loops to close


def test_the_optimum_has_the_expected_error_where_the_guess_is_far_off(subtests: pytest.Subtests) -> None:
    for make in [city, torus, sphere, grid, cube]:
        with subtests.test(make=make):
            graph, true = make(600, seed=1, noise=0.15)
            optimised = optimise_poses(graph)
            k = graph.information.shape[1]
            freedom = k * (len(graph.first) - len(graph) + 1)
            assert 2 * optimised.error / freedom == pytest.approx(1, abs=6 * np.sqrt(2 / freedom))
            assert optimised.error < factor_graph(graph).error(pose_values(true))


def test_the_guess_is_dead_reckoning() -> None:
    graph, true = torus(400, seed=2, windings=10)
    steps = np.linalg.inv(graph.world_T_pose[:-1]) @ graph.world_T_pose[1:]
    np.testing.assert_allclose(steps, graph.first_T_second[:399], atol=1e-9)
    np.testing.assert_array_equal(graph.world_T_pose[0], true[0])


def test_measurements_join_the_neighbours(subtests: pytest.Subtests) -> None:
    for make, poses, measurements in [(sphere, 2500, 4949), (grid, 2500, 4900), (cube, 1000, 2700)]:
        with subtests.test(make=make, poses=poses, measurements=measurements):
            graph, true = make(poses, seed=0)
            assert len(graph.first) == pytest.approx(measurements, rel=0.01)
            steps = np.linalg.norm(true[graph.first, :-1, -1] - true[graph.second, :-1, -1], axis=1)
            assert 0.9 < steps.max() < 1.1


def test_the_same_seed_makes_the_same_graph() -> None:
    for name in ("first", "second", "first_T_second"):
        np.testing.assert_array_equal(getattr(city(300, 5)[0], name), getattr(city(300, 5)[0], name))
    assert (city(300, 5)[0].first_T_second[0] != city(300, 6)[0].first_T_second[0]).any()


def test_what_cannot_be_made_is_refused(subtests: pytest.Subtests) -> None:
    for make, message in [
        (lambda: city(1, 0), "poses: expected at least 2"),
        (lambda: city(10, 0, noise=0.0), "noise"),
        (lambda: torus(50, 0, windings=20), "poses: expected at least 80, 4 for each of 20 windings, got 50"),
        (lambda: torus(50, 0, windings=1), "windings: expected at least 2"),
        (lambda: sphere(50, 0, turns=1), "turns: expected at least 2"),
        (lambda: sphere(50, 0, turns=20), "poses: expected at least 80, 4 for each of 20 turns, got 50"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            make()
