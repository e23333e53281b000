"""Loops that wait for another: two that close a chain are believed, and one that does not is forgotten."""

import gtsam
import numpy as np
import pytest

from pipelines.slam.loop_closures import Agreement, deviation
from saga_fg.numerics.geometry import inverse_transform, transform, yaw_transform
from saga_fg.slam.pose_graph.running import shortest_paths
from saga_fg.slam.submaps import LoopClosure


def loop(first: int, second: int, x: float) -> LoopClosure:
    return LoopClosure(first, second, yaw_transform(x), np.eye(6))


def test_deviation_is_the_same_in_the_plane_and_in_space():
    np.testing.assert_allclose(deviation(transform(np.array([3.0, 4.0, -0.5]))), [5.0, 0.5])
    pose = gtsam.Pose3(gtsam.Rot3.Rodrigues(np.array([0.3, 0.0, 0.4])), np.array([0.0, 0.0, 2.0])).matrix()
    np.testing.assert_allclose(deviation(pose), [2.0, 0.5])
    np.testing.assert_allclose(deviation(np.eye(4)), [0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(("off", "later", "believed"), [(0.1, 4, 2), (0.8, 4, 0), (0.1, 9, 0), (0.1, 1, 0)])
def test_a_loop_is_believed_when_another_agrees(off, later, believed):
    """Poses 10 m apart along a line; two loops from 20 on to 0 on, the second off by `off` m, `later` poses on."""
    poses = [yaw_transform(x=10.0 * k) for k in range(40)]
    agreement: Agreement[LoopClosure] = Agreement(np.array([0.3, 0.05]), np.zeros(2), patience=80.0, apart=15.0)
    loops = [loop(0, 20, 5.0), loop(2, 20 + later, 5.0 + 10.0 * (later - 2) + off)]
    found = [
        agreement.confirmed(loop, lambda a, b: inverse_transform(poses[a]) @ poses[b], lambda k: 10.0 * k)
        for loop in loops
    ]
    assert len(found[0]) == 0
    assert len(found[1]) == believed


def test_ways_take_the_shortest_measurements():
    first, second = np.array([0, 1, 2, 0, 0]), np.array([1, 2, 3, 3, 1])
    length = np.array([5.0, 5.0, 5.0, 1.0, 7.0])
    np.testing.assert_allclose(shortest_paths(first, second, length, 5, 0), [0.0, 5.0, 6.0, 1.0, np.inf])
