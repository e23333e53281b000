"""Law 5 of the running graph: an interaction, a motion and a sensor of one's own act in every back end as they are.

All three are defined here, and no estimator knows them.
"""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, NodeType, SceneGraph
from saga_fg.estimators import (
    GraphFilter,
    JointKalmanFilter,
    Observations,
)
from saga_fg.model.discretisation import discretise
from saga_fg.model.nonlinear_interactions import Accelerations
from saga_fg.model.scene_graph import NonlinearEdges

BACK_ENDS = {
    "kalman": JointKalmanFilter,
    "isam2": GraphFilter,
    "fixed-lag": lambda: GraphFilter(lag=1.0),
}


class Spring:
    """A node is drawn to another, the more the farther it is."""

    time_constant = 1.0
    alone = np.zeros((1, 0))

    needs = ((), ())

    def given(self, nodes, target, source):
        return np.zeros((len(target), 0))

    def accelerations(self, own, other, given):
        d = other[..., :2] - own[..., :2]
        length = np.linalg.norm(d, axis=-1)[..., None, None]
        by_d = 0.2 * (length * np.eye(2) + d[..., :, None] * d[..., None, :] / np.maximum(length, 1e-9))
        by_other = np.concatenate([by_d, np.zeros_like(by_d)], axis=-1)
        return Accelerations(0.2 * length[..., 0] * d, -by_other, by_other)


class Whirl(ConstantVelocity):
    """Round the origin with one radian a second, whatever the velocity says."""

    def flow(self, x, dt):
        return x @ self._turn(dt).T

    def flow_jacobian(self, x, dt):
        return np.broadcast_to(self._turn(dt), (*x.shape, 4))

    def _turn(self, dt):
        return np.kron(np.eye(2), [[np.cos(dt), -np.sin(dt)], [np.sin(dt), np.cos(dt)]])


class SquaredRange:
    """(x^2 + y^2) of the place."""

    name, state_dim, dim, angles, linear = "squared range", 4, 1, (), False

    def predict(self, x):
        return (x[..., :2] ** 2).sum(axis=-1, keepdims=True)

    def jacobian(self, x):
        return np.concatenate([2 * x[..., None, :2], np.zeros_like(x[..., None, :2])], axis=-1)


def driven(estimator, sprung=True, motion=ConstantVelocity, seen=True):
    """The newest states of two nodes."""
    estimator.add([1, 2], [[0.0, 2.0, 1.0, 0.0], [3.0, 2.5, 0.0, 0.0]], 0.04 * np.stack([np.eye(4)] * 2))
    node_type = NodeType("own", motion(0.1))
    edges = (NonlinearEdges(Spring(), [0], [1], [1.0], np.zeros((1, 0))),) if sprung else ()
    for k in range(3):
        estimator.predict(discretise(SceneGraph(np.array([1, 2]), (node_type,) * 2, nonlinear=edges), 0.2))
        if seen and k == 1:
            estimator.update(Observations([1], [[5.0]], SquaredRange(), np.array([[0.2]])))
    return estimator.mean([1, 2])


@pytest.mark.parametrize("name", BACK_ENDS)
def test_what_is_ones_own_acts(name):
    whole = driven(BACK_ENDS[name]())
    assert np.abs(whole - driven(BACK_ENDS[name](), sprung=False)).max() > 0.05
    assert np.abs(whole - driven(BACK_ENDS[name](), motion=Whirl)).max() > 0.5
    assert np.abs(whole - driven(BACK_ENDS[name](), seen=False)).max() > 0.02


@pytest.mark.parametrize("name", [name for name in BACK_ENDS if name != "kalman"])
def test_before_anything_is_measured_all_answer_alike(name, subtests):
    for motion in [ConstantVelocity, Whirl]:
        with subtests.test(motion=motion):
            kalman = driven(JointKalmanFilter(), motion=motion, seen=False)
            np.testing.assert_allclose(driven(BACK_ENDS[name](), motion=motion, seen=False), kalman, atol=1e-9)
