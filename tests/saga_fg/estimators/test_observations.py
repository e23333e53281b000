"""Nonlinear sensors in every back end: filters linearise at the prediction, smoothers at their estimates."""

import numpy as np
import pytest

from factors import Bearing, Radar, Range, RangeBearing, RangeRate
from saga_fg import ConstantVelocity, NodeType, SagaError, SceneGraph
from saga_fg.estimators import BatchSolver, GraphFilter, JointKalmanFilter, Measurements, Observations
from saga_fg.model.discretisation import discretise
from tests.saga_fg.graph_keys import newest_key
from tests.saga_fg.model.test_nonlinear_motion import BACK_ENDS

POSE = (2.0, -3.0, 3.0)
MODELS = {
    "range": Range(4, sensor_pose=POSE),
    "bearing": Bearing(4, sensor_pose=POSE),
    "range and bearing": RangeBearing(4, sensor_pose=POSE),
    "range rate": RangeRate(4, sensor_pose=POSE),
    "radar": Radar(4, sensor_pose=POSE),
}
TRUTH = np.array([[-8.0, -2.0, 4.0, 1.0], [-9.0, -3.5, 6.0, -1.0]])  # west of the sensor: bearings about pi
CAR = NodeType("car", ConstantVelocity(1.0))


def noise(model):
    return np.diag([1e-4 if k in model.angles else 1e-2 for k in range(model.dim)])


def told(estimator, model, offset=0.3, turns=0.0):
    """Two cars, known to half a metre, measured after an interval; whole turns are counted as the sensor likes."""
    estimator.add([1, 2], TRUTH + offset * np.array([1, -1, 1, 1]), np.tile(np.diag([0.25, 0.25, 1.0, 1.0]), (2, 1, 1)))
    estimator.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    z = model.predict(TRUTH + 0.1 * np.roll(TRUTH, 2, axis=1) * [1, 1, 0, 0])
    z[:, list(model.angles)] += turns
    estimator.update(Observations([1, 2], z, model, noise(model)))
    return estimator


def apart(a, b):
    sigma = np.sqrt(np.diag(b.joint_covariance([1, 2])))
    return np.abs((a.joint_mean([1, 2]) - b.joint_mean([1, 2])) / sigma).max()


@pytest.mark.parametrize("kind", MODELS)
def test_a_filter_takes_the_linearisation_at_the_prediction(kind):
    model, plain = MODELS[kind], JointKalmanFilter()
    filtered = told(JointKalmanFilter(), model)
    plain.add([1, 2], TRUTH + 0.3 * np.array([1, -1, 1, 1]), np.tile(np.diag([0.25, 0.25, 1.0, 1.0]), (2, 1, 1)))
    plain.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    before = apart(plain, filtered)
    x = plain.mean([1, 2])
    J = model.jacobian(x)  # type: ignore[attr-defined]
    innovation = model.predict(TRUTH + 0.1 * np.roll(TRUTH, 2, axis=1) * [1, 1, 0, 0]) - model.predict(x)  # type: ignore[attr-defined]
    angles = list(model.angles)  # type: ignore[attr-defined]
    innovation[:, angles] = (innovation[:, angles] + np.pi) % (2 * np.pi) - np.pi
    plain.update(Measurements([1, 2], innovation + (J @ x[:, :, None])[:, :, 0], J, noise(model)))
    assert apart(filtered, plain) < 1e-9
    assert before > 0.1  # it acts


@pytest.mark.parametrize("name", BACK_ENDS)
@pytest.mark.parametrize("kind", MODELS)
def test_every_back_end_takes_every_sensor(name, kind):
    """`kalman` is the extended Kalman filter; what linearises again comes to the minimum of the graph."""
    model, estimator = MODELS[kind], told(BACK_ENDS[name](), MODELS[kind])
    if name != "kalman":
        solver, nodes = BatchSolver(graph=told(GraphFilter(lag=100.0), model).graph()), [1, 2]
        minimum = np.array([solver.state(newest_key(solver.graph(), node)) for node in nodes])
        sigma = np.sqrt(np.diagonal(estimator.covariance(nodes), axis1=1, axis2=2))
        off, extended = (
            np.abs((x.mean(nodes) - minimum) / sigma).max() for x in (estimator, told(JointKalmanFilter(), model))
        )
        assert off < (0.5 * extended + 1e-9 if name == "isam2" else 5e-3)
    assert apart(estimator, told(BACK_ENDS[name](), model, turns=2 * np.pi)) < 1e-9


def test_where_a_bearing_is_undefined_is_an_error_after_which_all_goes_on(subtests):
    for name in BACK_ENDS:
        with subtests.test(name=name):
            estimator, model = BACK_ENDS[name](), MODELS["bearing"]
            estimator.add([1], [[*POSE[:2], 0.0, 0.0]], [np.eye(4)])
            estimator.predict(discretise(SceneGraph.of([1], CAR), 0.1))
            with pytest.raises(SagaError, match="at the sensor"):
                estimator.update(Observations([1], [[0.1]], model, [[0.01]]))
            estimator.update(Measurements([1], [[3.0, -3.0]], np.eye(2, 4), np.eye(2)))
            assert 2.0 < estimator.mean([1])[0, 0] < 3.0


def test_relinearisation_makes_a_difference():
    model = MODELS["range and bearing"]
    assert apart(told(JointKalmanFilter(), model, offset=1.0), told(GraphFilter(()), model, offset=1.0)) > 0.01
