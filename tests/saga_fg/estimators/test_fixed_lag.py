"""The fixed-lag smoother equals the textbook smoother, late measurements included; GTSAM finds the same answer."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import RangeBearing
from saga_fg import Edges, InputError, SceneGraph, UnknownNodeError
from saga_fg.conformance.programs import BUS, CAR, CONE, POLE
from saga_fg.estimators import GraphFilter, Measurements, Observations
from saga_fg.graph import OBJECT, key_of
from saga_fg.model.discretisation import discretise
from saga_fg.model.nonlinear_interactions import SocialForce
from saga_fg.model.scene_graph import NonlinearEdges
from tests.saga_fg.estimator_scenario import (
    Textbook,
    admissible,
    assert_newest,
    assert_smoothed,
    covariance_error,
    random_measurements,
    random_scenario,
    tell,
)
from tests.saga_fg.graph_keys import keys_of


@pytest.mark.parametrize("lag", [0.0, 0.6, 100.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_node_is_in_every_epoch_of_the_window_since_it_appeared(lag, seed):
    """With regular noise: intervals, also those that late measurements split, of 0.05 s and more."""
    rng = np.random.default_rng(seed)
    scenario = random_scenario(rng, kinds=(CAR, CONE), late=0.5, intervals=(0.05, 0.2, 0.5), grid=0.05)
    textbook, smoother = Textbook(), GraphFilter(lag=lag)
    for call in scenario.calls:
        if (taken := admissible(textbook, call, smoother)) is not None:
            tell(textbook, [taken])
            tell(smoother, [taken])
            if call[0] != "add":
                assert_smoothed(smoother, textbook, everything=True)
    assert_newest(smoother, textbook)


@pytest.mark.parametrize("density", [0.02, 1.0])
def test_scattered_and_dense_graphs_and_nodes_without_noise(density):
    rng = np.random.default_rng(7)
    scenario = random_scenario(rng, frames=6, kinds=(CAR, POLE, CONE, BUS), density=density, first=8)
    textbook, smoother = Textbook(), GraphFilter(lag=1.0)
    for call in scenario.calls:
        tell(textbook, [call])
        tell(smoother, [call])
        if call[0] == "update":
            assert_smoothed(smoother, textbook)
            assert_newest(smoother, textbook)


def test_a_node_that_comes_back_at_the_time_at_which_it_went_is_a_new_one():
    smoother, rng = GraphFilter(lag=5.0), np.random.default_rng(0)
    smoother.add([1, 2], rng.normal(size=(2, 4)), np.tile(np.eye(4), (2, 1, 1)))
    smoother.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    smoother.marginalise([2])
    smoother.add([2], rng.normal(size=(1, 4)), 3 * np.eye(4)[None])
    smoother.predict(discretise(SceneGraph.of([2, 1], CAR), 0.2))
    assert [sorted(epoch.nodes.tolist()) for epoch in smoother.smoothed()] == [[1], [1, 2], [1, 2]]
    assert smoother.remembered([1, 2], 0.05).tolist() == [True, False]
    with pytest.raises(UnknownNodeError):
        smoother.update(random_measurements(rng, [1, 2], 4), 0.05)


def test_gtsam_solves_the_same_graph_to_the_same_answer():
    scenario = random_scenario(np.random.default_rng(3))
    smoother = GraphFilter(lag=1.0)
    tell(smoother, scenario.calls)
    equivalent = smoother.graph()
    start = gtsam.Values()
    for key in equivalent.values.keys():  # noqa: SIM118 -- gtsam.Values is no dict
        start.insert(key, np.zeros_like(equivalent.values.atVector(key)))
    settings = gtsam.GaussNewtonParams()
    settings.setLinearSolverType("MULTIFRONTAL_QR")
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), start, settings).optimize()
    marginals = gtsam.Marginals(equivalent.native(), solved)
    smoothed = smoother.smoothed()
    for one, (time, layout, mean) in zip(smoothed, smoother.smoothed_means(), strict=True):
        assert (time, layout.nodes.tolist(), mean.tolist()) == (one.time, one.nodes.tolist(), one.x.mean.tolist())
    assert len(smoothed) == equivalent.epoch + 1
    for epoch, moment in enumerate(smoothed):
        assert set(equivalent.of(OBJECT, epoch)) == set(moment.nodes.tolist())
        for node, key in keys_of(equivalent, epoch).items():
            own = moment.covariance([node])[0]
            sigma = np.sqrt(np.diag(own))
            assert np.abs((solved.atVector(key) - moment.mean([node])[0]) / sigma).max() < 1e-8
            assert covariance_error(marginals.marginalCovariance(key), own) < 1e-7


@pytest.mark.parametrize("tied", [False, True])
def test_a_state_that_nothing_disturbs_keeps_its_variable(tied):
    """Alone, and when a car follows it."""
    smoother = GraphFilter(lag=1.0)
    smoother.add([5], [[1.0, 2.0]], [np.diag([4.0, 1.0])])
    smoother.add([6], [[1.0, 2.0, 0.0, 0.0]], [np.eye(4)])
    pull = Edges("pull", [1], [0], [0.5], [-np.eye(4)], [np.eye(4, 2)], [np.zeros(4)])
    smoother.predict(discretise(SceneGraph([5, 6], (POLE, CAR), (pull,) if tied else ()), 0.5))
    smoother.update(Measurements([5], [[3.0]], [[1.0, 0.0]], [[1.0]]))
    graph = smoother.graph()
    assert [str(one) for one in graph.variables.values() if one.id == 5] == ["object 5 at 0.00 s"]
    solved = gtsam.GaussNewtonOptimizer(graph.native(), graph.values).optimize()
    np.testing.assert_allclose(solved.atVector(key_of(OBJECT, 5, 0)), [2.6, 2.0], atol=1e-12)
    np.testing.assert_allclose(smoother.smoothed()[0].mean([5]), [[2.6, 2.0]], atol=1e-12)


def test_the_window_forgets_what_is_older_than_its_lag():
    smoother = GraphFilter(lag=0.5)
    smoother.add([1], np.zeros((1, 4)), np.eye(4)[None])
    for _ in range(40):
        smoother.predict(discretise(SceneGraph.of([1], CAR), 0.1))
    assert len(smoother.smoothed()) == 6
    assert smoother.start == pytest.approx(smoother.time - 0.5)
    with pytest.raises(InputError, match="before what is remembered"):
        smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=smoother.start - 0.01)
    with pytest.raises(InputError, match="predict first"):
        smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=smoother.time + 0.01)


def radar_window():
    """A queue of three cars seen by a radar at the origin, by ranges and bearings, for two seconds."""
    rng = np.random.default_rng(5)
    smoother = GraphFilter(lag=10.0)
    truth = np.array([[20.0, 5.0, 8.0, 1.0], [35.0, 8.0, 8.0, 1.0], [-30.0, 0.5, 2.0, -0.5]])
    smoother.add([1, 2, 3], truth + rng.normal(size=(3, 4)), np.tile(np.diag([4.0, 4.0, 4.0, 4.0]), (3, 1, 1)))
    model = RangeBearing(state_dim=4)
    for _ in range(10):
        smoother.predict(discretise(SceneGraph.of([1, 2, 3], CAR), 0.2))
        truth[:, :2] += 0.2 * truth[:, 2:]
        z = model.predict(truth) + rng.normal(size=(3, 2)) * [0.3, 0.01]
        z[:, 1] = (z[:, 1] + np.pi) % (2 * np.pi) - np.pi
        smoother.update(Observations([1, 2, 3], z, model, np.diag([0.09, 1e-4])))
    return smoother


def assert_minimum(smoother):
    """GTSAM's optimiser, started at the smoother's answer, stays there but for the threshold of relinearisation."""
    equivalent = smoother.graph()
    settings = gtsam.GaussNewtonParams()
    settings.setLinearSolverType("MULTIFRONTAL_QR")
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), equivalent.values, settings).optimize()
    epochs = {epoch.time: epoch for epoch in smoother.smoothed()}
    for key, variable in equivalent.variables.items():
        epoch, node = epochs[variable.time], [variable.id]
        sigma = np.sqrt(np.diag(epoch.covariance(node)[0]))
        assert np.abs((solved.atVector(key) - epoch.mean(node)[0]) / sigma).max() < 1e-3
    return equivalent, solved


def test_nonlinear_measurements_are_solved_by_gauss_newton():
    smoother = radar_window()
    equivalent, solved = assert_minimum(smoother)
    marginals = gtsam.Marginals(equivalent.native(), solved)
    newest = keys_of(equivalent, equivalent.epoch)
    for node in (1, 2, 3):
        assert covariance_error(smoother.covariance([node])[0], marginals.marginalCovariance(newest[node])) < 1e-4
    last = smoother.smoothed()[-1]
    np.testing.assert_array_equal(last.mean([1, 2, 3]), smoother.mean([1, 2, 3]))


def test_a_late_nonlinear_measurement_finds_its_place():
    punctual, late = radar_window(), radar_window()
    extra = Observations([2], [[40.0, 0.2]], RangeBearing(state_dim=4), np.diag([0.09, 1e-4]))
    late.update(extra, time=1.0)
    assert_minimum(late)
    assert np.abs(late.mean([2]) - punctual.mean([2])).max() > 1e-3


def test_a_nonlinear_interaction_is_linearised_at_the_smoothed_states():
    smoother = GraphFilter(lag=10.0)
    rng = np.random.default_rng(2)
    smoother.add([1, 2], [[0.0, 0, 1, 0], [3.0, 0.5, -1, 0]], np.tile(np.eye(4), (2, 1, 1)))
    away = NonlinearEdges(SocialForce(), [0, 1], [1, 0], np.ones(2), np.zeros((2, 1, 4)))
    for _ in range(6):
        smoother.predict(discretise(SceneGraph(np.array([1, 2]), (CAR, CAR), nonlinear=(away,)), 0.2))
        seen = rng.normal([[0.0, 0.0], [2.0, 0.5]], 0.3)
        smoother.update(Measurements([1, 2], seen, np.eye(2, 4), 0.1 * np.eye(2)))
    smoother.update(Measurements([1], rng.normal(0.0, 0.3, (1, 2)), np.eye(2, 4), 0.1 * np.eye(2)), time=0.5)
    assert_minimum(smoother)


def test_a_snapshot_can_be_stored_and_continued_to_the_bit():
    scenario = random_scenario(np.random.default_rng(11), frames=10, kinds=(CAR, CONE), late=0.3, grid=0.05)
    textbook, straight, resumed = Textbook(), GraphFilter(lag=1.0), GraphFilter(lag=1.0)
    for k, call in enumerate(scenario.calls):
        if (taken := admissible(textbook, call, straight)) is None:
            continue
        for one in (textbook, straight, resumed) if k > len(scenario.calls) // 2 else (textbook, straight):
            tell(one, [taken])
        if k == len(scenario.calls) // 2:
            resumed.restore(pickle.loads(pickle.dumps(straight.snapshot())))
    assert resumed.nodes.tolist() == straight.nodes.tolist()
    np.testing.assert_array_equal(resumed.joint_mean(straight.nodes), straight.joint_mean(straight.nodes))
    np.testing.assert_array_equal(resumed.joint_covariance(straight.nodes), straight.joint_covariance(straight.nodes))
    assert_newest(resumed, textbook)


ONE = Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]])


def two_cars():
    smoother = GraphFilter(lag=1.0)
    smoother.add([1, 2], np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
    smoother.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    smoother.update(Measurements([1, 2], np.ones((2, 2)), np.eye(2, 4), np.eye(2)))
    return smoother


def test_what_is_wrong_is_said_and_changes_nothing(subtests):
    for wrong, error in [
        (lambda s: s.update(ONE, time=float("nan")), InputError),
        (lambda s: s.update(ONE, time="now"), InputError),
        (lambda s: s.update(Measurements([9], [[0.0]], np.eye(1, 4), [[1.0]]), time=0.05), UnknownNodeError),
        (lambda s: s.marginalise([1, 1]), InputError),
    ]:
        with subtests.test(error.__name__):
            smoother, untouched = two_cars(), two_cars()
            with pytest.raises(error):
                wrong(smoother)
            for estimator in (smoother, untouched):
                estimator.predict(discretise(SceneGraph.of([2, 1], CAR), 0.2))
            np.testing.assert_array_equal(smoother.joint_mean([1, 2]), untouched.joint_mean([1, 2]))
            for mine, other in zip(smoother.smoothed(), untouched.smoothed(), strict=True):
                np.testing.assert_array_equal(mine.x.flat, other.x.flat)
