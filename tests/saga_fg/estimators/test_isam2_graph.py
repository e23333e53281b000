"""`graph()` of the incremental filter: the last interval, whatever happens at its end."""

import copy
import pickle

import gtsam
import numpy as np
import pytest

from saga_fg import Edges, SceneGraph
from saga_fg.errors import InputError
from saga_fg.estimators import GraphFilter, IncrementalFilter, JointKalmanFilter, Measurements
from saga_fg.graph import OBJECT
from saga_fg.model.discretisation import discretise
from tests.saga_fg.estimator_scenario import covariance_error, random_covariance
from tests.saga_fg.random_graphs import CAR, POLE, random_graph


def running(rng, leaving=(), estimator=None):
    """After two intervals with measurements; some nodes leave at the end."""
    estimator = IncrementalFilter() if estimator is None else estimator
    estimator.add(range(4), rng.normal(size=(4, 4)), random_covariance(rng, 4, 4))
    for _ in range(2):
        estimator.predict(discretise(random_graph(rng, (CAR,) * 4, range(4), density=0.7), 0.3))
        estimator.update(Measurements([0, 1, 3], rng.normal(size=(3, 2)), np.eye(2, 4), 0.1 * np.eye(2)))
    estimator.marginalise(leaving)
    return estimator


def content(graph):
    """Epoch and time, and every factor with its variables."""
    every = [(one.provider, one.kind, [(v.id, v.epoch) for v in one.variables]) for one in graph.factors()]
    return graph.epoch, graph.time, sorted(every)


def assert_same_estimates(estimator, graph):
    """GTSAM's marginals of the variables of the present epoch are the filter's estimates."""
    now, marginals = graph.of(OBJECT, graph.epoch), gtsam.Marginals(graph.native(), graph.values)
    assert sorted(now.keys() & {*estimator.nodes.tolist()}) == sorted(estimator.nodes.tolist())
    for node in estimator.nodes.tolist():
        key = now[node].key
        np.testing.assert_allclose(graph.values.atVector(key), estimator.mean([node])[0], atol=1e-8)
        assert covariance_error(estimator.covariance([node])[0], marginals.marginalCovariance(key)) < 1e-8


@pytest.mark.parametrize("stored", [lambda one: None, pickle.dumps, copy.deepcopy], ids=["snapshot", "pickle", "copy"])
def test_a_snapshot_leaves_the_graph_as_it_is(stored):
    estimator = running(np.random.default_rng(0), leaving=[2])
    before = content(estimator.graph())
    state = estimator.snapshot()
    stored(estimator)
    resumed = IncrementalFilter()
    resumed.restore(state)
    for one in (estimator, resumed):
        assert content(one.graph()) == before
        assert_same_estimates(one, one.graph())


@pytest.mark.parametrize("twin", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))], ids=["copy", "pickle"])
def test_a_filter_can_be_copied_deeply_and_goes_on_to_the_same_bits(twin):
    rng = np.random.default_rng(1)
    original = running(rng, leaving=[1])
    other = twin(original)
    interval = discretise(random_graph(rng, (CAR,) * 3, [0, 2, 3], density=1.0), 0.1)
    for one in (original, other):
        one.predict(interval)
        one.update(Measurements([2], [[1.0, 2.0]], np.eye(2, 4), np.eye(2)))
    np.testing.assert_array_equal(original.joint_mean([0, 2, 3]), other.joint_mean([0, 2, 3]))
    np.testing.assert_array_equal(original.joint_covariance([0, 2, 3]), other.joint_covariance([0, 2, 3]))


def test_an_interval_of_no_time_leaves_the_graph_as_it_is():
    rng = np.random.default_rng(2)
    estimator = running(rng)
    before = content(estimator.graph())
    estimator.predict(discretise(random_graph(rng, (CAR,) * 4, range(4), density=0.7), 0.0))
    assert content(estimator.graph()) == before
    assert_same_estimates(estimator, estimator.graph())


def test_a_node_that_is_removed_and_added_at_one_time_has_two_variables_in_the_graph():
    rng = np.random.default_rng(3)
    estimator = running(rng)
    factors = len([*estimator.graph().factors()])
    for _ in range(2):
        estimator.marginalise([1])
        estimator.add([1], rng.normal(size=(1, 4)), random_covariance(rng, 1, 4))
        factors += 1
        graph = estimator.graph()
        assert len([*graph.factors()]) == factors, "the last interval is still there"
        assert_same_estimates(estimator, graph)
    estimator.predict(discretise(random_graph(rng, (CAR,) * 4, range(4), density=0.7), 0.2))
    assert estimator.graph().epoch == 1
    assert_same_estimates(estimator, estimator.graph())


def test_a_node_without_noise_that_edges_act_on_is_named():
    """The interaction has no factor; estimates need none."""
    estimator, expected = IncrementalFilter(), JointKalmanFilter()
    pull = Edges("pull", [0], [1], [0.5], A_self=[-np.eye(2)], A_other=[np.eye(2, 4)], b=[np.zeros(2)])
    interval = discretise(SceneGraph([7, 8], (POLE, CAR), (pull,)), 0.2)
    seen = Measurements([8], [[1.0, 0.0]], np.eye(2, 4), np.eye(2))
    for either in (estimator, expected):
        either.add([7], np.zeros((1, 2)), np.eye(2)[None])
        either.add([8], np.zeros((1, 4)), np.eye(4)[None])
        either.predict(interval)
        either.update(seen)
    np.testing.assert_allclose(estimator.joint_mean([7, 8]), expected.joint_mean([7, 8]), atol=1e-12)
    np.testing.assert_allclose(estimator.joint_covariance([7, 8]), expected.joint_covariance([7, 8]), atol=1e-12)
    with pytest.raises(InputError, match="graph: node 7: expected process noise in all directions"):
        estimator.graph()


class TreeWithoutDigits:
    """An iSAM2 whose joint marginals fail, as where pivots of the tree have rounded to zero, or are not finite."""

    def __init__(self, isam, failure):
        self.isam, self.failure = isam, failure

    def __getattr__(self, name):
        return getattr(self.isam, name)

    def jointMarginalCovariance(self, keys):
        if isinstance(self.failure, Exception):
            raise self.failure
        return self

    def fullMatrix(self):
        return self.failure


@pytest.mark.parametrize("failure", [RuntimeError("indeterminate"), np.full((4, 4), np.nan)], ids=["error", "nan"])
def test_where_the_tree_has_too_few_digits_the_posterior_is_eliminated_anew(failure):
    estimator = running(np.random.default_rng(4), estimator=GraphFilter())
    expected = estimator.joint_covariance(range(4))
    twin = running(np.random.default_rng(4), estimator=GraphFilter())
    engine = twin._smoother._ready()
    engine.isam = TreeWithoutDigits(engine.isam, failure)
    np.testing.assert_allclose(twin.joint_covariance(range(4)), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
