"""The incremental filter: iSAM2 does the work, equals the textbook, and does not grow."""

import copy
import pickle

import gtsam
import numpy as np
import pytest

from saga_fg import Edges, SceneGraph
from saga_fg.errors import UnknownNodeError
from saga_fg.estimators import IncrementalFilter, JointKalmanFilter, Measurements
from saga_fg.graph import OBJECT, key_of
from saga_fg.model.discretisation import discretise
from tests.saga_fg.estimator_scenario import (
    Textbook,
    covariance_error,
    mean_error,
    part,
    random_covariance,
    random_scenario,
)
from tests.saga_fg.random_graphs import BUS, CAR, CONE, POLE, random_graph

EXACT = 1e-9


def tell(estimator, calls):
    for name, *arguments in calls:
        getattr(estimator, name)(*(arguments[:1] if name == "update" else arguments))
    return estimator


@pytest.fixture
def updates(monkeypatch):
    """Counts the calls of `gtsam.ISAM2.update`: how many factors each brought."""
    brought = []
    original = gtsam.ISAM2.update

    def update(isam, factors, *rest):
        brought.append(factors.size())
        return original(isam, factors, *rest)

    monkeypatch.setattr(gtsam.ISAM2, "update", update)
    return brought


def assert_textbook(estimator, textbook, tolerance=EXACT):
    _, places, filtered, _ = textbook.solve()[0][-1]
    nodes = [node for node in places if node not in textbook.steps[-1].gone]
    expected = part(filtered, places, nodes)
    assert sorted(estimator.nodes.tolist()) == sorted(nodes)
    assert mean_error(estimator.joint_mean(nodes), expected) < tolerance
    assert covariance_error(estimator.joint_covariance(nodes), expected.covariance) < tolerance
    for node in nodes:
        own = part(filtered, places, [node])
        assert covariance_error(estimator.covariance([node])[0], own.covariance) < tolerance


@pytest.mark.parametrize("kinds", [(CAR, CONE), (CAR, BUS, POLE, CONE)])
@pytest.mark.parametrize("seed", range(5))
def test_the_filter_is_the_textbooks(kinds, seed, updates):
    calls = random_scenario(np.random.default_rng(seed), frames=10, kinds=kinds, density=0.15).calls
    textbook, estimator = Textbook(), IncrementalFilter()
    for name, *arguments in calls:
        getattr(textbook, name)(*arguments)
        getattr(estimator, name)(*(arguments[:1] if name == "update" else arguments))
    assert_textbook(estimator, textbook)
    assert len(updates) >= 10


def ring(nodes, rng, present=1.0):
    """Every car shares the velocity of its two neighbours on either side."""
    n = len(nodes)
    target = np.repeat(np.arange(n), 4)
    source = (target + np.tile([-2, -1, 1, 2], n)) % n
    kept = rng.random(len(target)) < present
    A_self, A_other = np.zeros((4 * n, 4, 4)), np.zeros((4 * n, 4, 4))
    A_self[:, [2, 3], [2, 3]], A_other[:, [2, 3], [2, 3]] = -1.0, 1.0
    rate = rng.uniform(0.1, 1.0, 4 * n)
    edges = Edges(
        "shared", target[kept], source[kept], rate[kept], A_self[kept], A_other[kept], np.zeros((kept.sum(), 4))
    )
    return SceneGraph.of(nodes, CAR, [edges])


def test_a_large_component_is_cut_into_cells():
    rng = np.random.default_rng(0)
    textbook, estimator = Textbook(), IncrementalFilter()
    nodes = list(range(40))
    present = nodes[:30]
    prior = [("add", present, rng.normal(size=(30, 4)), random_covariance(rng, 30, 4))]
    tell(textbook, prior), tell(estimator, prior)
    for frame in range(6):
        seen = [node for node in present if rng.random() < 0.7]
        calls = [
            ("predict", discretise(ring(rng.permutation(present), rng, 0.9), 0.1 + 0.1 * rng.random())),
            ("update", Measurements(seen, rng.normal(size=(len(seen), 2)), np.eye(2, 4), 0.1 * np.eye(2))),
            ("marginalise", [present.pop(3)]),
            ("add", [nodes[30 + frame]], rng.normal(size=(1, 4)), random_covariance(rng, 1, 4)),
        ]
        present.append(nodes[30 + frame])
        tell(textbook, calls), tell(estimator, calls)
        assert_textbook(estimator, textbook)
        keys = estimator._state.tree.variables.keys
        assert 3 < len(keys) < len(present)  # neither one variable nor one a node


def test_large_and_small_components_together():
    rng = np.random.default_rng(1)
    textbook, estimator = Textbook(), IncrementalFilter()
    prior = [("add", list(range(25)), rng.normal(size=(25, 4)), random_covariance(rng, 25, 4))]
    tell(textbook, prior), tell(estimator, prior)
    for _ in range(4):
        whole = ring(np.arange(20), rng)
        graph = SceneGraph.of(np.arange(25), CAR, whole.edges)
        seen = Measurements(np.arange(0, 25, 2), rng.normal(size=(13, 2)), np.eye(2, 4), 0.1 * np.eye(2))
        calls = [("predict", discretise(graph, 0.2)), ("update", seen)]
        tell(textbook, calls), tell(estimator, calls)
        assert_textbook(estimator, textbook)


def test_one_interval_and_its_measurements_take_one_update(updates):
    rng = np.random.default_rng(2)
    estimator = IncrementalFilter()
    estimator.add(np.arange(4), rng.normal(size=(4, 4)), random_covariance(rng, 4, 4))
    for _ in range(3):
        estimator.predict(discretise(ring(np.arange(4), rng), 0.1))
        estimator.covariance(np.arange(4))
        estimator.update(Measurements(np.arange(4), rng.normal(size=(4, 2)), np.eye(2, 4), 0.1 * np.eye(2)))
        estimator.covariance(np.arange(4))
    # first the prior of one variable, then its interaction; and its detection factor
    assert updates == [2, 2, 2]


def test_measurements_of_several_kinds_take_one_update(updates):
    """States of two sizes, some with their velocities: the same as one after the other."""
    rng = np.random.default_rng(11)
    together, apart, textbook = IncrementalFilter(), IncrementalFilter(), JointKalmanFilter()
    types = (CAR, BUS, CAR, BUS)
    by_size = [([k for k, t in enumerate(types) if t is kind], kind.dim) for kind in (CAR, BUS)]
    priors = [(nodes, rng.normal(size=(2, dim)), random_covariance(rng, 2, dim)) for nodes, dim in by_size]
    for estimator in (together, apart, textbook):
        for prior in priors:
            estimator.add(*prior)
    for _ in range(3):
        interval = discretise(random_graph(rng, types, range(4), density=1.0), 0.2)
        kinds = [Measurements(nodes, rng.normal(size=(2, 2)), np.eye(2, dim), np.eye(2)) for nodes, dim in by_size]
        for estimator in (together, apart, textbook):
            estimator.predict(interval)
        before = len(updates)
        likelihood = together.update(*kinds)
        assert len(updates) == before + 1
        assert sum(apart.update(each) for each in kinds) == pytest.approx(likelihood, rel=1e-9)
        assert sum(textbook.update(each) for each in kinds) == pytest.approx(likelihood, rel=1e-9)
        for estimator in (together, apart):
            np.testing.assert_allclose(estimator.joint_mean(range(4)), textbook.joint_mean(range(4)), rtol=1e-9)
            P = textbook.joint_covariance(range(4))
            np.testing.assert_allclose(estimator.joint_covariance(range(4)), P, atol=1e-9 * P.max())
    assert len(together.graph().variables) == 8
    with pytest.raises(UnknownNodeError):
        together.update(kinds[0], Measurements([99], [[0.0, 0.0]], np.eye(2, 4), np.eye(2)))
    assert together.update() == 0.0


def test_several_intervals_without_measurements_take_no_update(updates):
    """They are chained by covariances; the tree begins anew with the next measurements."""
    rng = np.random.default_rng(2)
    estimator, expected = IncrementalFilter(), JointKalmanFilter()
    seen = Measurements(np.arange(4), rng.normal(size=(4, 2)), np.eye(2, 4), 0.1 * np.eye(2))
    prior = np.arange(4), rng.normal(size=(4, 4)), random_covariance(rng, 4, 4)
    tied = discretise(ring(np.arange(4), rng), 0.1)
    for either in (estimator, expected):
        either.add(*prior)
        either.predict(tied)
        either.update(seen)
    for _ in range(20):
        graph = ring(np.arange(4), rng)
        for either in (estimator, expected):
            either.predict(discretise(graph, 0.1))
    for either in (estimator, expected):
        either.update(seen)
    assert len(updates) == 2
    np.testing.assert_allclose(estimator.joint_mean(prior[0]), expected.joint_mean(prior[0]), rtol=1e-9)
    np.testing.assert_allclose(estimator.joint_covariance(prior[0]), expected.joint_covariance(prior[0]), rtol=1e-9)


def test_copies_go_on_independently_of_each_other():
    """The first to be corrected goes on with GTSAM's tree, others begin anew; predictions alone leave it alone.

    That is no refusal.
    """
    rng = np.random.default_rng(7)
    filters, expected = [IncrementalFilter()], [JointKalmanFilter()]
    nodes = np.arange(4)
    prior = nodes, rng.normal(size=(4, 4)), random_covariance(rng, 4, 4)
    tied = discretise(ring(nodes, rng), 0.1)
    for either in (filters[0], expected[0]):
        either.add(*prior)
        either.predict(tied)
        either.update(Measurements(nodes, np.zeros((4, 2)), np.eye(2, 4), 0.1 * np.eye(2)))
    for each in (filters, expected):
        each += [copy.copy(each[0]), copy.copy(each[0])]
    running = filters[0]._state.tree.running
    for k, (one, textbook) in enumerate(zip(filters[::-1], expected[::-1], strict=True)):
        graphs = [ring(nodes, rng) for _ in range(2 if k == 0 else 1)]
        seen = Measurements(nodes, rng.normal(size=(4, 2)), np.eye(2, 4), 0.1 * np.eye(2))
        for either in (one, textbook):
            for graph in graphs:
                either.predict(discretise(graph, 0.1))
            if k > 0:
                either.update(seen)
                either.update(seen)
        np.testing.assert_allclose(one.joint_mean(nodes), textbook.joint_mean(nodes), rtol=1e-9)
        np.testing.assert_allclose(one.joint_covariance(nodes), textbook.joint_covariance(nodes), rtol=1e-9)
        assert running.updates == (1 if k == 0 else 3)
        assert one.refusals == 0


def test_a_node_on_its_own_is_no_variable_of_the_tree(updates):
    """Until it is tied to another, and again when that has left."""
    rng = np.random.default_rng(8)
    textbook, estimator = Textbook(), IncrementalFilter()
    nodes = [1, 2, 3]
    edge = np.array([0]), np.array([1]), np.array([0.5]), -np.eye(4)[None], np.eye(4)[None], np.zeros((1, 4))
    apart, tied = SceneGraph.of(nodes, CAR), SceneGraph.of(nodes, CAR, [Edges("tie", *edge)])
    seen = Measurements(nodes, rng.normal(size=(3, 2)), np.eye(2, 4), 0.1 * np.eye(2))
    program = [(apart, 0), (tied, 2), (tied, 2), (apart, 2)]
    prior = [("add", nodes, rng.normal(size=(3, 4)), random_covariance(rng, 3, 4))]
    tell(textbook, prior), tell(estimator, prior)
    for graph, held in program:
        calls = [("predict", discretise(graph, 0.2)), ("update", seen)]
        tell(textbook, calls), tell(estimator, calls)
        assert_textbook(estimator, textbook)
        assert estimator._state.tree.held.sum() == held
    assert len(updates) == 3
    left = [("marginalise", [2]), ("predict", discretise(SceneGraph.of([1, 3], CAR), 0.2))]
    tell(textbook, left), tell(estimator, left)
    assert_textbook(estimator, textbook)
    assert not estimator._state.tree.held.any()


def test_nothing_grows_with_time():
    rng = np.random.default_rng(3)
    estimator = IncrementalFilter()
    nodes = np.arange(12)
    estimator.add(nodes, rng.normal(size=(12, 4)), random_covariance(rng, 12, 4))
    sizes = []
    for _ in range(300):
        estimator.predict(discretise(ring(nodes, rng, 0.3), 0.1))
        estimator.update(Measurements(nodes, rng.normal(size=(12, 2)), np.eye(2, 4), 0.1 * np.eye(2)))
        isam = estimator._state.tree.running.isam
        sizes.append(
            (
                isam.getFactorsUnsafe().size(),
                isam.getLinearizationPoint().size(),
                isam.getFixedVariables().size(),
                isam.size(),
            )
        )
    early, late = np.array(sizes[10:100]).max(axis=0), np.array(sizes[200:]).max(axis=0)
    assert (late <= early + 2).all()


def test_what_gtsam_refuses_is_done_without_it_and_counted(monkeypatch, caplog):
    rng = np.random.default_rng(4)
    estimator, expected = IncrementalFilter(), JointKalmanFilter()
    original, refusals = gtsam.ISAM2.update, []

    def update(isam, *arguments):
        if len(refusals) < 2:
            refusals.append(1)
            raise RuntimeError("Indeterminate linear system detected while working near variable\n7.")
        return original(isam, *arguments)

    for either in (estimator, expected):
        either.add([1, 2], np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
    graph = random_graph(rng, (CAR, CAR), [1, 2])
    seen = Measurements([1, 2], rng.normal(size=(2, 2)), np.eye(2, 4), 0.1 * np.eye(2))
    monkeypatch.setattr(gtsam.ISAM2, "update", update)
    for _ in range(4):
        for either in (estimator, expected):
            either.predict(discretise(graph, 0.3))
        assert estimator.update(seen) == pytest.approx(expected.update(seen), rel=1e-9)
        np.testing.assert_allclose(estimator.joint_mean([1, 2]), expected.joint_mean([1, 2]), atol=1e-10)
        np.testing.assert_allclose(estimator.joint_covariance([1, 2]), expected.joint_covariance([1, 2]), atol=1e-10)
    assert len(refusals) == estimator.refusals == copy.deepcopy(estimator).refusals == 2
    (warned,) = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert warned.startswith("iSAM2 begins anew at 0.300 s (refusal 1): Indeterminate linear system")


def test_little_noise_beside_large_variances_costs_no_digits():
    """Acceleration noise of 1e-10 m^2/s^3 over 10 ms: information matrices have nothing left, moments all."""
    quiet = SceneGraph.of([1, 2], CAR)
    quiet = SceneGraph([1, 2], tuple(type(CAR)("quiet", type(CAR.motion)(acceleration_noise=1e-10)) for _ in range(2)))  # type: ignore[call-arg]
    textbook, estimator = Textbook(), IncrementalFilter()
    rng = np.random.default_rng(5)
    calls = [("add", [1, 2], 1e3 * rng.normal(size=(2, 4)), np.tile(100 * np.eye(4), (2, 1, 1)))]
    for _ in range(20):
        seen = Measurements([1, 2], 1e3 + rng.normal(size=(2, 2)), np.eye(2, 4), 0.01 * np.eye(2))
        calls += [("predict", discretise(quiet, 0.01)), ("update", seen)]
    for name, *arguments in calls:
        getattr(textbook, name)(*arguments)
        getattr(estimator, name)(*arguments)
    assert_textbook(estimator, textbook)


def test_gtsam_solves_the_graph_of_the_last_interval_to_the_same_answer():
    rng = np.random.default_rng(6)
    estimator = IncrementalFilter()
    estimator.add([1, 2, 3], rng.normal(size=(3, 4)), random_covariance(rng, 3, 4))
    for _ in range(3):
        estimator.predict(discretise(random_graph(rng, (CAR,) * 3, [1, 2, 3]), 0.3))
        estimator.update(Measurements([1, 3], rng.normal(size=(2, 2)), np.eye(2, 4), 0.1 * np.eye(2)))
    estimator.marginalise([2])
    estimator.add([9], rng.normal(size=(1, 6)), random_covariance(rng, 1, 6))
    equivalent = estimator.graph()
    assert equivalent.epoch == 1
    start = gtsam.Values()
    for key in equivalent.values.keys():  # noqa: SIM118 -- gtsam.Values is no dict
        start.insert(key, np.zeros_like(equivalent.values.atVector(key)))
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), start).optimize()
    marginals = gtsam.Marginals(equivalent.native(), solved)
    for key in equivalent.variables:
        np.testing.assert_allclose(solved.atVector(key), equivalent.values.atVector(key), atol=1e-8)
    for node in estimator.nodes.tolist():
        key = key_of(OBJECT, node, 1)
        np.testing.assert_allclose(solved.atVector(key), estimator.mean([node])[0], atol=1e-8)
        assert covariance_error(estimator.covariance([node])[0], marginals.marginalCovariance(key)) < 1e-8


def test_a_snapshot_can_be_stored_and_the_original_goes_on_to_the_same_bits():
    calls = random_scenario(np.random.default_rng(9), frames=10).calls
    half = len(calls) // 2
    original, resumed = IncrementalFilter(), IncrementalFilter()
    tell(original, calls[:half])
    resumed.restore(pickle.loads(pickle.dumps(original.snapshot())))
    tell(original, calls[half:]), tell(resumed, calls[half:])
    assert resumed.time == original.time
    nodes = original.nodes
    np.testing.assert_array_equal(resumed.joint_mean(nodes), original.joint_mean(nodes))
    np.testing.assert_array_equal(resumed.joint_covariance(nodes), original.joint_covariance(nodes))
