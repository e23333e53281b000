"""A pose graph that grows: its estimate, and the ways along its measurements."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg.slam.pose_graph.running import Measured, RunningPoseGraph
from tests.saga_fg.loops import moved


def squares(rounds: int) -> RunningPoseGraph:
    """A drive round a square, 1 m a step, by exact odometry."""
    graph = RunningPoseGraph(np.eye(3))
    for _ in range(4 * rounds):
        graph.append(moved(2, np.array([[np.pi / 4, np.pi / 4, np.pi / 2]]))[0], 1e-4 * np.eye(3))
    return graph


def test_the_shortest_way_takes_the_least_of_parallel_measurements() -> None:
    graph = RunningPoseGraph(np.eye(3))
    for _ in range(4):
        graph.append(moved(2, np.array([[1.0, 0, 0]]))[0], 1e-4 * np.eye(3))
    assert graph.distances(0) == pytest.approx([0, 1, 2, 3, 4])
    step = moved(2, np.array([[1.0, 0, 0]]))[0]
    shorter = moved(2, np.array([[0.5, 0, 0]]))[0]
    graph.close([Measured(1, 2, step, np.eye(3)), Measured(3, 2, np.linalg.inv(shorter), np.eye(3))])
    assert graph.distances(0) == pytest.approx([0, 1, 2, 2.5, 3.5])
    assert graph.distances(4) == pytest.approx([3.5, 2.5, 1.5, 1, 0])


def test_loops_are_closed_and_a_false_one_is_left_out_at_the_end() -> None:
    graph = squares(3)
    graph.close([Measured(row, row + 4, np.eye(3), 1e-4 * np.eye(3)) for row in range(8)])
    np.testing.assert_allclose(graph.poses[4], np.eye(3), atol=1e-6)
    graph.close([Measured(0, 10, moved(2, np.array([[8.0, 0, 0]]))[0], 1e-4 * np.eye(3))])
    agreed = graph.settled()
    assert agreed.kept.tolist() == [True] * 20 + [False]
    np.testing.assert_allclose(agreed.graph.world_T_pose[8], np.eye(3), atol=1e-6)


def test_a_pose_alone_is_settled() -> None:
    graph = RunningPoseGraph(np.eye(3))
    assert graph.distances(0).tolist() == [0]
    assert len(graph.settled().graph) == 1
