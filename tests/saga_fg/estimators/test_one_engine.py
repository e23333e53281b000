"""One engine: what is tied is solved by the graph alone, what is alone by the Kalman kernels; objects pass between."""

import copy
import pickle
import sys
import time
from collections import Counter

import gtsam
import numpy as np
import pytest

from factors.gaussian import native_factor
from saga_fg import Edges, NodeType, SceneGraph
from saga_fg.conformance.programs import CAR, Predict, TextbookEstimator, random_graph, random_program, run
from saga_fg.estimators import GraphFilter, JointKalmanFilter, Measurements, filtering
from saga_fg.graph import OBJECT
from saga_fg.model.discretisation import discretise
from saga_fg.model.motion import ConstantVelocity
from tests.saga_fg.estimator_scenario import Textbook, assert_newest, random_covariance, tell
from tests.saga_fg.estimators.soak import LAGS, drive

JOINT_STEPS = (filtering.predict, filtering.corrected)


def replace_everywhere(monkeypatch, functions, by):
    """Put `by(function)` in the place of functions, wherever saga_fg has imported them."""
    for module in [module for name, module in sys.modules.items() if name.startswith("saga_fg")]:
        for name, value in list(vars(module).items()):
            if any(value is function for function in functions):
                monkeypatch.setattr(module, name, by(value))


def ring(nodes, rng):
    """Every car shares the velocity of its two neighbours on either side."""
    n = len(nodes)
    target = np.repeat(np.arange(n), 4)
    source = (target + np.tile([-2, -1, 1, 2], n)) % n
    A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (4 * n, 1, 1))
    return SceneGraph.of(
        nodes, CAR, [Edges("shared", target, source, rng.uniform(0.1, 1.0, 4 * n), -A, A, np.zeros((4 * n, 4)))]
    )


def seen(rng, nodes):
    return Measurements(nodes, rng.normal(size=(len(nodes), 2)), np.eye(2, 4), 0.1 * np.eye(2))


@pytest.mark.parametrize("n", [5, 20])
@pytest.mark.parametrize("lag", [0.0, 1.0])
def test_nothing_but_the_graph_solves_what_is_tied(lag, n, monkeypatch):
    """With the joint Kalman filter's steps made to raise; nodes come and go, measurements are late now and then."""

    def refuse(function):
        def refused(*_, **__):
            raise AssertionError(f"{function.__name__} was called")

        return refused

    replace_everywhere(monkeypatch, JOINT_STEPS, refuse)
    rng, textbook, estimator, present = np.random.default_rng(n), Textbook(), GraphFilter(lag=lag), list(range(n))
    prior = [("add", present, rng.normal(size=(n, 4)), random_covariance(rng, n, 4))]
    tell(textbook, prior), tell(estimator, prior)
    for frame in range(8):
        new = [n + frame]
        some = [node for node in present if rng.random() < 0.7]
        calls = [
            ("predict", discretise(ring(rng.permutation(present), rng), float(rng.choice([0.1, 0.2, 0.4])))),
            ("update", seen(rng, some), None),
            *([("update", seen(rng, some), textbook.steps[-1].time + 0.05)] if lag else []),
            ("marginalise", [present.pop(1)]),
            ("add", new, rng.normal(size=(1, 4)), random_covariance(rng, 1, 4)),
        ]
        present += new
        for call in calls:
            tell(textbook, [call]), tell(estimator, [call])
            assert_newest(estimator, textbook)


@pytest.mark.parametrize("lag", [0.0, 1.0])
def test_objects_alone_take_the_steps_of_the_kalman_filter(lag, monkeypatch):
    """The same functions, as often, to the same bits; iSAM2 holds nothing."""
    calls, apart = Counter(), []
    program = random_program(np.random.default_rng(4), density=0.0)

    def count(function):
        def counted(*arguments):
            calls[function.__name__] += 1
            return function(*arguments)

        return counted

    replace_everywhere(monkeypatch, JOINT_STEPS, count)
    for estimator in (JointKalmanFilter(), GraphFilter(lag=lag)):
        calls.clear()
        apart.append((run(program, estimator)[0], dict(calls)))
    (kalman, its), (graph, mine) = apart
    assert its == mine
    assert min(its.values()) > 3
    np.testing.assert_array_equal(graph.joint_mean(kalman.nodes), kalman.joint_mean(kalman.nodes))
    np.testing.assert_array_equal(graph.joint_covariance(kalman.nodes), kalman.joint_covariance(kalman.nodes))
    assert len(graph._smoother.graph().variables) == 0


@pytest.mark.parametrize(("lag", "late"), [(0.0, False), (1.0, False), (1.0, True)])
def test_an_object_passes_to_isam2_and_back(lag, late):
    """An edge comes and goes, the correlation that it leaves decays, and it comes again: the textbook's all along."""
    rng, textbook, estimator, held = np.random.default_rng(8), Textbook(), GraphFilter(lag=lag), []
    nodes, eye = [1, 2, 3], np.eye(4)[None]
    apart = SceneGraph.of(nodes, CAR)
    tied = SceneGraph.of(nodes, CAR, [Edges("tie", [0], [1], [0.5], -eye, eye, np.zeros((1, 4)))])
    prior = [("add", nodes, rng.normal(size=(3, 4)), random_covariance(rng, 3, 4))]
    tell(textbook, prior), tell(estimator, prior)
    for graph, frames in ((apart, 3), (tied, 4), (apart, 45), (tied, 2)):
        for frame in range(frames):
            exact = Measurements(nodes, rng.normal(size=(3, 4)), np.eye(4), 0.01 * np.eye(4))
            calls = [("predict", discretise(graph, 0.2)), ("update", exact, None)]
            if late and frame % 3 == 1:
                calls.append(("update", seen(rng, [int(rng.choice(nodes))]), textbook.steps[-1].time + 0.1))
            for call in calls:
                tell(textbook, [call]), tell(estimator, [call])
            assert_newest(estimator, textbook)
        held.append(len(estimator._keys))
    assert held == [0, 2, 0, 2]


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("late", [0.0, 0.3])
def test_a_long_drive_stays_beside_the_kalman_filter_and_does_not_grow(lag, late):
    """Births, deaths, ids that come back, edges that come and go, milliseconds beside seconds, snapshots between."""
    worst, late_ones, largest = drive(1, lag, 200, late, until=time.monotonic() + 10.0)
    assert worst.max() < 1e-9
    assert (late_ones > 3) == (late * lag > 0)
    assert largest <= 20 * (3 + 20 * lag)


def test_little_noise_beside_large_variances_costs_no_digits():
    """Acceleration noise of 1e-10 m^2/s^3 over 10 ms: information matrices have nothing left, moments all."""
    quiet = NodeType("quiet", ConstantVelocity(acceleration_noise=1e-10))
    eye, rng = np.eye(4)[None], np.random.default_rng(5)
    tie = Edges("tie", [0], [1], [0.5], -eye, eye, np.zeros((1, 4)))
    textbook, estimator = Textbook(), GraphFilter(lag=1.0)
    calls = [("add", [1, 2], 1e3 * rng.normal(size=(2, 4)), np.tile(100 * np.eye(4), (2, 1, 1)))]
    for _ in range(20):
        calls.append(("predict", discretise(SceneGraph.of([1, 2], quiet, [tie]), 0.01)))
        calls.append(("update", Measurements([1, 2], 1e3 + rng.normal(size=(2, 2)), np.eye(2, 4), 0.01 * np.eye(2))))
    tell(textbook, calls), tell(estimator, calls)
    assert_newest(estimator, textbook)


def running(rng, leaving=()):
    """After two intervals with measurements; some nodes leave at the end."""
    estimator = GraphFilter()
    estimator.add(range(4), rng.normal(size=(4, 4)), random_covariance(rng, 4, 4))
    for _ in range(2):
        estimator.predict(discretise(random_graph(rng, (CAR,) * 4, range(4), density=0.7), 0.3))
        estimator.update(seen(rng, [0, 1, 3]))
    estimator.marginalise(leaving)
    return estimator


def content(graph):
    """Epoch and time, and every factor with its variables."""
    every = [(one.provider, one.kind, [str(variable) for variable in one.variables]) for one in graph.factors()]
    return graph.epoch, graph.time, sorted(every)


def test_a_snapshot_leaves_the_graph_as_it_is(subtests):
    for stored in [lambda one: None, pickle.dumps, copy.deepcopy]:
        with subtests.test(stored=stored):
            estimator, resumed = running(np.random.default_rng(0), leaving=[2]), GraphFilter()
            before = content(estimator.graph())
            resumed.restore(estimator.snapshot())
            stored(estimator)
            assert content(estimator.graph()) == content(resumed.graph()) == before
            estimator.predict(discretise(SceneGraph.of([0, 1, 3], CAR), 0.0))  # no time at all
            assert content(estimator.graph()) == before


def test_copies_go_on_independently_of_each_other():
    """Whichever of them has GTSAM's tree."""
    rng = np.random.default_rng(7)
    interval = discretise(random_graph(rng, (CAR,) * 4, range(4), density=1.0), 0.1)
    original, textbook = GraphFilter(), TextbookEstimator()
    programs = [[Predict(interval)], [Predict(interval), Predict(interval)], [Predict(interval)] * 3]
    prior = range(4), rng.normal(size=(4, 4)), random_covariance(rng, 4, 4)
    for one in (original, textbook):
        one.add(*prior)
        one.predict(interval)
        one.update(seen(np.random.default_rng(1), [0, 1]))
    for program, one in zip(programs, [copy.copy(original), copy.copy(original), original], strict=True):
        expected = copy.deepcopy(textbook)
        for either in (one, expected):
            run(program, either)
            either.update(seen(np.random.default_rng(2), [1, 2, 3]))
        P = expected.joint_covariance(range(4))
        assert np.abs((one.joint_mean(range(4)) - expected.joint_mean(range(4))) / np.sqrt(np.diag(P))).max() < 1e-9
        assert np.linalg.norm(one.joint_covariance(range(4)) - P) < 1e-9 * np.linalg.norm(P)


def test_a_node_that_is_removed_and_added_at_one_time_is_another_one_in_the_graph():
    rng = np.random.default_rng(3)
    estimator = running(rng)
    others = Counter(one.provider for one in estimator.graph().factors())["interactions"] - 1
    for again in range(2):
        estimator.marginalise([1])
        estimator.add([1], [[float(again)] * 4], random_covariance(rng, 1, 4))
        graph = estimator.graph()
        newest = graph.of(OBJECT, graph.epoch)
        assert Counter(one.provider for one in graph.factors())["interactions"] == others, "the last interval"
        np.testing.assert_allclose(graph.state(newest[1].key), [float(again)] * 4)
    estimator.predict(discretise(random_graph(rng, (CAR,) * 4, range(4), density=0.7), 0.2))
    assert estimator.graph().of(OBJECT, estimator.graph().epoch).keys() == {0, 1, 2, 3}


class TreeWithoutDigits:
    """An iSAM2 whose query fails, or whose clique has pivots that have rounded to zero."""

    def __init__(self, isam, failure):
        self.isam, self.failure, self.asked = isam, failure, 0

    def __getattr__(self, name):
        return getattr(self.isam, name)

    def jointBayesNet(self, keys, take):
        self.asked += 1
        if self.failure == "error":
            raise RuntimeError("indeterminate")
        clique = gtsam.GaussianFactorGraph()
        n = 4 * len(keys)
        clique.push_back(native_factor(keys, [4] * len(keys), np.zeros((n, n + 1), order="F")))
        take(clique, gtsam.Ordering())


@pytest.mark.parametrize("failure", ["error", "zero"])
def test_where_the_tree_has_too_few_digits_the_posterior_is_eliminated_anew(failure):
    expected = running(np.random.default_rng(4)).joint_covariance(range(4))
    twin = running(np.random.default_rng(4))
    engine = twin._smoother._ready()
    engine.isam, twin._posterior, twin._tied = TreeWithoutDigits(engine.isam, failure), None, None
    np.testing.assert_allclose(twin.joint_covariance(range(4)), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert engine.isam.asked == 1
