"""The fixed-lag smoother equals the textbook smoother, late measurements included; GTSAM finds the same answer."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import RangeBearing, Robust
from saga_fg import InputError, SceneGraph, UnknownNodeError
from saga_fg.estimators import FixedLagSmoother, GraduatedNonConvexity, Measurements, Observations
from saga_fg.graph import OBJECT, key_of
from saga_fg.model.discretisation import discretise
from saga_fg.model.nonlinear_interactions import SocialForce
from saga_fg.model.scene_graph import NonlinearEdges
from tests.saga_fg.estimator_scenario import (
    EXACT,
    Textbook,
    admissible,
    assert_smoothed,
    covariance_error,
    mean_error,
    part,
    random_measurements,
    random_scenario,
    tell,
)
from tests.saga_fg.graph_keys import keys_of
from tests.saga_fg.random_graphs import BUS, CAR, CONE, POLE


@pytest.mark.parametrize("lag", [0.0, 0.6, 100.0])
@pytest.mark.parametrize("late", [0.0, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_every_moment_of_the_window_is_the_textbooks(lag, late, seed):
    scenario = random_scenario(np.random.default_rng(seed), late=late)
    textbook, smoother = Textbook(), FixedLagSmoother(lag)
    for call in scenario.calls:
        if admissible(textbook, call, smoother.start):
            tell(textbook, [call])
            tell(smoother, [call])
    assert_smoothed(smoother.smoothed(), textbook)
    (time, places, filtered, _), gone = textbook.solve()[0][-1], textbook.steps[-1].gone
    present = [node for node in places if node not in gone]
    expected = part(filtered, places, present)
    assert smoother.time == pytest.approx(time, abs=1e-12)
    assert sorted(smoother.nodes.tolist()) == sorted(present)
    assert mean_error(smoother.joint_mean(present), expected) < EXACT
    assert covariance_error(smoother.joint_covariance(present), expected.covariance) < EXACT


@pytest.mark.parametrize("density", [0.02, 1.0])
def test_scattered_and_dense_graphs_and_nodes_without_noise(density):
    rng = np.random.default_rng(7)
    scenario = random_scenario(rng, frames=6, kinds=(CAR, POLE, CONE, BUS), density=density, first=8)
    textbook, smoother = Textbook(), FixedLagSmoother(1.0)
    for call in scenario.calls:
        tell(textbook, [call])
        tell(smoother, [call])
        if call[0] == "update":
            assert_smoothed(smoother.smoothed(), textbook)


def test_the_log_likelihood_is_that_of_the_measurement_given_all_before():
    scenario = random_scenario(np.random.default_rng(3), late=0.5)
    textbook, smoother, before = Textbook(), FixedLagSmoother(100.0), 0.0
    for call in scenario.calls:
        if not admissible(textbook, call, smoother.start):
            continue
        tell(textbook, [call])
        name, *arguments = call
        answer = getattr(smoother, name)(*arguments)
        if name == "update":
            total = textbook.solve()[1]
            assert answer == pytest.approx(total - before, rel=1e-9, abs=1e-9)
            before = total


def test_a_node_may_come_back_at_the_time_at_which_it_went():
    textbook, smoother = Textbook(), FixedLagSmoother(5.0)
    rng = np.random.default_rng(0)
    calls = [
        ("add", [1, 2], rng.normal(size=(2, 4)), np.tile(np.eye(4), (2, 1, 1))),
        ("predict", discretise(SceneGraph.of([1, 2], CAR), 0.1)),
        ("marginalise", [2]),
        ("add", [2], rng.normal(size=(1, 4)), 3 * np.eye(4)[None]),
        ("update", random_measurements(rng, [1, 2], 4), None),
        ("predict", discretise(SceneGraph.of([2, 1], CAR), 0.2)),
    ]
    tell(smoother, calls)
    tell(textbook, calls[:3])
    textbook.predict(discretise(SceneGraph.of([1], CAR), 0.0))
    tell(textbook, calls[3:])
    assert_smoothed(smoother.smoothed(), textbook)


def test_gtsam_solves_the_same_graph_to_the_same_answer():
    scenario = random_scenario(np.random.default_rng(3))
    smoother = FixedLagSmoother(1.0)
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
    assert len(smoothed) == equivalent.epoch + 1
    for epoch, moment in enumerate(smoothed):
        assert set(equivalent.of(OBJECT, epoch)) == set(moment.nodes.tolist())
        for node, key in keys_of(equivalent, epoch).items():
            own = moment.covariance([node])[0]
            sigma = np.sqrt(np.diag(own))
            assert np.abs((solved.atVector(key) - moment.mean([node])[0]) / sigma).max() < 1e-8
            assert covariance_error(marginals.marginalCovariance(key), own) < 1e-7


def test_a_state_that_nothing_disturbs_keeps_its_variable():
    smoother = FixedLagSmoother(1.0)
    smoother.add([5], [[1.0, 2.0]], [np.diag([4.0, 1.0])])
    smoother.predict(discretise(SceneGraph.of([5], POLE), 0.5))
    smoother.update(Measurements([5], [[3.0]], [[1.0, 0.0]], [[1.0]]))
    equivalent = smoother.graph()
    assert [str(variable) for variable in equivalent.variables.values()] == ["object 5 at 0.00 s"]
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), equivalent.values).optimize()
    np.testing.assert_allclose(solved.atVector(key_of(OBJECT, 5, 0)), [2.6, 2.0], atol=1e-12)
    np.testing.assert_allclose(smoother.smoothed()[0].mean([5]), [[2.6, 2.0]], atol=1e-12)


def test_the_window_forgets_what_is_older_than_its_lag():
    smoother = FixedLagSmoother(0.5)
    smoother.add([1], np.zeros((1, 4)), np.eye(4)[None])
    for _ in range(40):
        smoother.predict(discretise(SceneGraph.of([1], CAR), 0.1))
    assert len(smoother.smoothed()) == 6
    assert smoother.start == pytest.approx(smoother.time - 0.5)
    with pytest.raises(InputError, match="before what is remembered"):
        smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=smoother.start - 0.01)
    with pytest.raises(InputError, match="predict first"):
        smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=smoother.time + 0.01)


def radar_window(robust=None):
    """A queue of three cars seen by a radar at the origin, by ranges and bearings, for two seconds."""
    rng = np.random.default_rng(5)
    smoother = FixedLagSmoother(10.0)
    truth = np.array([[20.0, 5.0, 8.0, 1.0], [35.0, 8.0, 8.0, 1.0], [-30.0, 0.5, 2.0, -0.5]])
    smoother.add([1, 2, 3], truth + rng.normal(size=(3, 4)), np.tile(np.diag([4.0, 4.0, 4.0, 4.0]), (3, 1, 1)))
    model = RangeBearing(state_dim=4)
    for _ in range(10):
        smoother.predict(discretise(SceneGraph.of([1, 2, 3], CAR), 0.2))
        truth[:, :2] += 0.2 * truth[:, 2:]
        z = model.predict(truth) + rng.normal(size=(3, 2)) * [0.3, 0.01]
        z[:, 1] = (z[:, 1] + np.pi) % (2 * np.pi) - np.pi
        smoother.update(Observations([1, 2, 3], z, model, np.diag([0.09, 1e-4])), robust=robust)
    return smoother


def assert_minimum(smoother):
    """GTSAM's optimiser, started at the smoother's answer, stays there; so do the covariances."""
    equivalent = smoother.graph()
    settings = gtsam.GaussNewtonParams()
    settings.setLinearSolverType("MULTIFRONTAL_QR")
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), equivalent.values, settings).optimize()
    for epoch, moment in enumerate(smoother.smoothed()):
        for node, key in keys_of(equivalent, epoch).items():
            sigma = np.sqrt(np.diag(moment.covariance([node])[0]))
            assert np.abs((solved.atVector(key) - moment.mean([node])[0]) / sigma).max() < 1e-6
    return equivalent, solved


@pytest.mark.parametrize("robust", [None, Robust("huber", 1.0), Robust("cauchy", 2.0)])
def test_nonlinear_and_robust_measurements_are_solved_by_gauss_newton(robust):
    smoother = radar_window(robust)
    equivalent, solved = assert_minimum(smoother)
    if robust is None:
        marginals = gtsam.Marginals(equivalent.native(), solved)
        newest = keys_of(equivalent, equivalent.epoch)
        for node in (1, 2, 3):
            assert covariance_error(smoother.covariance([node])[0], marginals.marginalCovariance(newest[node])) < 1e-6
    last = smoother.smoothed()[-1]
    np.testing.assert_array_equal(last.mean([1, 2, 3]), smoother.mean([1, 2, 3]))


def test_a_late_nonlinear_measurement_finds_its_place():
    punctual, late = radar_window(), radar_window()
    extra = Observations([2], [[40.0, 0.2]], RangeBearing(state_dim=4), np.diag([0.09, 1e-4]))
    late.update(extra, time=1.0)
    assert_minimum(late)
    assert np.abs(late.mean([2]) - punctual.mean([2])).max() > 1e-3


def test_linear_measurements_may_be_robust():
    smoother = FixedLagSmoother(10.0)
    smoother.add([1], np.zeros((1, 4)), np.eye(4)[None])
    for k in range(6):
        smoother.predict(discretise(SceneGraph.of([1], CAR), 0.1))
        outlier = 30.0 if k == 3 else 0.0
        seen = Measurements([1], [[0.1 * k + outlier, 0.0]], np.eye(2, 4), 0.01 * np.eye(2))
        smoother.update(seen, robust=Robust("huber", 1.345))
    assert_minimum(smoother)
    assert abs(smoother.mean([1])[0, 0] - 0.5) < 0.3


def test_a_nonlinear_interaction_is_linearised_at_the_smoothed_states():
    smoother = FixedLagSmoother(10.0)
    rng = np.random.default_rng(2)
    smoother.add([1, 2], [[0.0, 0, 1, 0], [3.0, 0.5, -1, 0]], np.tile(np.eye(4), (2, 1, 1)))
    away = NonlinearEdges(SocialForce(falloff=2.0), [0, 1], [1, 0], np.ones(2), np.zeros((2, 1, 4)))
    for _ in range(6):
        smoother.predict(discretise(SceneGraph(np.array([1, 2]), (CAR, CAR), nonlinear=(away,)), 0.2))
        seen = rng.normal([[0.0, 0.0], [2.0, 0.5]], 0.3)
        smoother.update(Measurements([1, 2], seen, np.eye(2, 4), 0.1 * np.eye(2)))
    smoother.update(Measurements([1], rng.normal(0.0, 0.3, (1, 2)), np.eye(2, 4), 0.1 * np.eye(2)), time=0.5)
    assert_minimum(smoother)


def test_a_snapshot_can_be_stored_and_continued_to_the_bit():
    scenario = random_scenario(np.random.default_rng(11), frames=10, late=0.3)
    calls = [call for call in scenario.calls if call[0] != "update" or call[2] is None or call[2] > 1e9]
    half = len(calls) // 2
    straight, resumed = FixedLagSmoother(1.0), FixedLagSmoother(1.0)
    tell(straight, calls)
    other = FixedLagSmoother(1.0)
    tell(other, calls[:half])
    resumed.restore(pickle.loads(pickle.dumps(other.snapshot())))
    tell(resumed, calls[half:])
    assert resumed.nodes.tolist() == straight.nodes.tolist()
    np.testing.assert_array_equal(resumed.joint_mean(straight.nodes), straight.joint_mean(straight.nodes))
    np.testing.assert_array_equal(resumed.joint_covariance(straight.nodes), straight.joint_covariance(straight.nodes))


def two_cars():
    smoother = FixedLagSmoother(1.0)
    smoother.add([1, 2], np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
    smoother.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    smoother.update(Measurements([1, 2], np.ones((2, 2)), np.eye(2, 4), np.eye(2)))
    return smoother


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        (lambda s: s.update(Measurements([9], [[0.0]], np.eye(1, 4), [[1.0]])), UnknownNodeError),
        (lambda s: s.update(Measurements([1], [[0.0]], np.eye(1, 3), [[1.0]])), InputError),
        (lambda s: s.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=float("nan")), InputError),
        (lambda s: s.update(Measurements([9], [[0.0]], np.eye(1, 4), [[1.0]]), time=0.05), UnknownNodeError),
        (lambda s: s.add([2], np.zeros((1, 4)), np.eye(4)[None]), InputError),
        (lambda s: s.add([3], np.zeros((1, 4)), -np.eye(4)[None]), InputError),
        (lambda s: s.predict(discretise(SceneGraph.of([1], CAR), 0.1)), InputError),
        (lambda s: s.predict(discretise(SceneGraph.of([1, 2], BUS), 0.1)), InputError),
        (lambda s: s.predict(discretise(SceneGraph.of([1, 3], CAR), 0.1)), UnknownNodeError),
        (lambda s: s.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time="now"), InputError),
        (lambda s: s.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), robust="huber"), InputError),
        (
            lambda s: s.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), robust=GraduatedNonConvexity()),
            InputError,  # it takes the whole recording
        ),
        (lambda s: s.marginalise([4]), UnknownNodeError),
        (lambda s: s.marginalise([1, 1]), InputError),
        (lambda s: s.mean([1, 7]), UnknownNodeError),
    ],
)
def test_what_is_wrong_is_said_and_changes_nothing(wrong, error):
    smoother, untouched = two_cars(), two_cars()
    with pytest.raises(error):
        wrong(smoother)
    for estimator in (smoother, untouched):
        estimator.predict(discretise(SceneGraph.of([2, 1], CAR), 0.2))
    np.testing.assert_array_equal(smoother.joint_mean([1, 2]), untouched.joint_mean([1, 2]))
    for mine, other in zip(smoother.smoothed(), untouched.smoothed(), strict=True):
        np.testing.assert_array_equal(mine.joint_covariance([1, 2]), other.joint_covariance([1, 2]))


def test_an_empty_frame_and_no_nodes_at_all():
    smoother = FixedLagSmoother(1.0)
    smoother.predict(discretise(SceneGraph([], ()), 0.1))
    assert smoother.update(Measurements([], np.empty((0, 2)), np.empty((0, 2, 4)), np.eye(2))) == 0.0
    assert smoother.nodes.tolist() == []
    assert len(smoother.smoothed()) == 2
    assert smoother.graph().native().size() == 0


def test_only_means_when_only_means_are_wanted():
    moment = two_cars().smoothed(covariances=False)[0]
    assert moment.mean([2, 1]).shape == (2, 4)
    with pytest.raises(InputError, match="only means"):
        moment.covariance([1])
