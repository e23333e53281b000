"""The bounded filter: exact where its bound covers the graph, close to exact elsewhere, and never indefinite."""

import pickle

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg import Edges, InputError, SagaError, SceneGraph
from saga_fg.estimators import BoundedKalmanFilter, JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise
from tests.saga_fg.estimator_programs import TextbookEstimator, new_nodes, random_program, run
from tests.saga_fg.estimators.test_conformance import assert_equal, in_step
from tests.saga_fg.estimators.test_conformance_bad_input import BAD, measured
from tests.saga_fg.flocks import flock, prior_deviation
from tests.saga_fg.graph_keys import keys_of
from tests.saga_fg.random_graphs import BUS, CAR, CONE, random_graph

COVERING = [{"core": 1000}, {"core": 1, "hops": 1000}]


# equal to the exact filter where the bound covers the graph


@pytest.mark.parametrize("bound", COVERING)
@pytest.mark.parametrize("seed", range(6))
def test_a_bound_that_covers_the_graph_makes_it_exact(bound, seed):
    in_step(random_program(np.random.default_rng(seed), moments=7), BoundedKalmanFilter(**bound))


@pytest.mark.parametrize("seed", range(4))
def test_components_no_larger_than_a_cluster_are_exact(seed):
    """Platoons of five that keep to themselves: twelve of them, far more nodes than a cluster has."""
    rng = np.random.default_rng(seed)
    bounded, exact = BoundedKalmanFilter(hops=4, core=5), JointKalmanFilter()
    for estimator in (bounded, exact):
        new_nodes(np.random.default_rng(seed), list(range(60)), CAR).run(estimator)
    for _ in range(5):
        transition = discretise(platoons(rng, 12, 5), 0.3)
        seen = np.flatnonzero(rng.random(60) < 0.7)
        z = exact.mean(seen)[:, :2] + rng.normal(size=(len(seen), 2))
        likelihoods = []
        for estimator in (bounded, exact):
            estimator.predict(transition)
            likelihoods.append(estimator.update(Measurements(seen, z, np.eye(2, 4), 0.3 * np.eye(2))))
        assert likelihoods[0] == pytest.approx(likelihoods[1], rel=1e-9)
    assert_equal(bounded, exact)


def platoons(rng, count, size):
    """Each node follows the one before it in its platoon, and the one after it a little."""
    number = np.arange(count * size).reshape(count, size)
    target = np.concatenate([number[:, 1:].ravel(), number[:, :-1].ravel()])
    source = np.concatenate([number[:, :-1].ravel(), number[:, 1:].ravel()])
    A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(target), 1, 1))
    edges = Edges("shared velocity", target, source, rng.uniform(0.2, 1.0, len(target)), -A, A, np.zeros((len(A), 4)))
    return SceneGraph.of(np.arange(count * size), CAR, [edges])


# close to the exact filter elsewhere


def normalised_error(truth, mean, covariance):
    """(n,) NEES per degree of freedom."""
    error = truth - mean
    return (error[:, None, :] @ np.linalg.solve(covariance, error[:, :, None]))[:, 0, 0] / truth.shape[1]


@pytest.fixture(scope="module")
def side_by_side():
    """150 nodes over 25 frames, the last 17 of them: errors in sigmas, normalised errors, log-likelihoods."""
    nodes = np.arange(150)
    prior, record = flock(seed=4, n=150, frames=25)
    exact, bounded = JointKalmanFilter(), {hops: BoundedKalmanFilter(hops=hops, core=12) for hops in (1, 2, 3)}
    for estimator in (exact, *bounded.values()):
        estimator.add(nodes, prior, np.tile(np.diag(prior_deviation() ** 2), (150, 1, 1)))  # type: ignore[attr-defined]
    errors, nees, likelihoods = {h: [] for h in bounded}, {h: [] for h in (0, *bounded)}, {h: [] for h in bounded}
    for k, frame in enumerate(record):
        exact.predict(frame.transition)
        likelihood = exact.update(frame.measurements)
        mean, covariance = exact.mean(nodes), exact.covariance(nodes)
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        if k >= 8:
            nees[0].append(normalised_error(frame.truth, mean, covariance))
        for hops, estimator in bounded.items():
            estimator.predict(frame.transition)
            difference = estimator.update(frame.measurements) - likelihood
            if k >= 8:
                errors[hops].append(np.abs(estimator.mean(nodes) - mean) / sigma)
                nees[hops].append(normalised_error(frame.truth, estimator.mean(nodes), estimator.covariance(nodes)))
                likelihoods[hops].append(difference)
    return exact, bounded, errors, {hops: np.mean(values) for hops, values in nees.items()}, likelihoods


@pytest.mark.parametrize(("hops", "error", "worst"), [(1, 0.03, 1.0), (2, 0.01, 0.3), (3, 0.003, 0.1)])
def test_means_are_those_of_the_exact_filter_to_within_a_share_of_sigma(side_by_side, hops, error, worst):
    errors = np.array(side_by_side[2][hops])
    assert errors.mean() <= error
    assert errors.max() <= worst


@pytest.mark.parametrize("hops", [1, 2, 3])
def test_it_is_as_consistent_as_the_exact_filter(side_by_side, hops):
    nees = side_by_side[3]
    assert 0.9 <= nees[0] <= 1.1
    assert nees[hops] == pytest.approx(nees[0], rel=0.02)


@pytest.mark.parametrize(("hops", "off"), [(1, 2.0), (2, 0.4), (3, 0.1)])
def test_the_likelihood_of_a_frame_is_that_of_the_exact_filter(side_by_side, hops, off):
    """In 270 measured values; their likelihood is a few hundred."""
    assert np.abs(side_by_side[4][hops]).max() <= off


def test_correlations_of_neighbours_are_kept_and_those_of_strangers_zero(side_by_side):
    exact, bounded, *_ = side_by_side
    estimator = bounded[2]
    near = estimator.clusters[3]
    ours, theirs = (correlation(e.joint_covariance(near)) for e in (estimator, exact))
    strong = (np.abs(theirs) > 0.05) & (np.abs(theirs) < 1)
    assert strong.sum() > 50
    assert np.abs(ours - theirs)[strong].max() <= 0.05
    together = {(i, j) for cluster in estimator.clusters for i in cluster for j in cluster}
    i, j = next((0, j) for j in range(150) if (0, j) not in together)
    assert not estimator.joint_covariance([i, j])[:4, 4:].any()


def correlation(P):
    sigma = np.sqrt(np.diag(P))
    return P / sigma[:, None] / sigma


def test_a_crossing_crowd_does_not_let_clusters_grow():
    """Fast nodes on courses of their own: after ten seconds everybody has other neighbours."""
    nodes = np.arange(120)
    prior, record = flock(seed=2, n=120, frames=60, dt=0.2, speed=8.0)
    estimator = BoundedKalmanFilter(hops=1, core=10)
    estimator.add(nodes, prior, np.tile(np.diag(prior_deviation() ** 2), (120, 1, 1)))
    members = []
    for frame in record:
        estimator.predict(frame.transition)
        estimator.update(frame.measurements)
        members.append(sum(len(cluster) for cluster in estimator.clusters) / 120)
    assert max(len(cluster) for cluster in estimator.clusters) <= 50
    assert np.mean(members[-10:]) <= 1.3 * np.mean(members[:10])


# positive definite, whatever happens


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 2), st.integers(1, 4), st.integers(0, 2), st.floats(0.05, 0.6))
def test_covariances_are_positive_definite(seed, hops, core, patience, density):
    """New and leaving nodes, misses, states of several sizes, graphs that change entirely from step to step."""
    rng = np.random.default_rng(seed)
    estimator = BoundedKalmanFilter(hops=hops, core=core, patience=patience)
    for operation in random_program(rng, moments=6, density=density, max_rate=2.0):
        operation.run(estimator)
        nodes = rng.permutation(estimator.nodes.tolist())
        if len(nodes) == 0:
            continue
        alone = {node: estimator.covariance([node])[0] for node in nodes.tolist()}
        for some in (nodes, nodes[: len(nodes) // 2], *estimator.clusters):
            P = estimator.joint_covariance(some)
            assert np.allclose(P, P.T, rtol=0, atol=1e-12 * np.abs(P).max(initial=0))
            assert (np.linalg.eigvalsh(correlation(P)) > 0).all()
            start = 0
            for node in some:  # type: ignore[attr-defined]
                own = alone[int(node)]
                at = slice(start, start + len(own))
                assert np.allclose(P[at, at], own, rtol=1e-9, atol=1e-12 * np.abs(own).max())
                start = at.stop


def test_random_programs_stay_near_the_textbook():
    """However small the clusters, and with graphs that change entirely: on average a part of a sigma."""
    errors = []
    for seed in range(12):
        estimator, textbook = BoundedKalmanFilter(hops=1, core=2), TextbookEstimator()
        program = random_program(np.random.default_rng(seed), moments=8, density=0.1, max_rate=0.5)
        for operation in program:
            operation.run(textbook)
            operation.run(estimator)
        assert sorted(estimator.nodes.tolist()) == sorted(textbook.nodes.tolist())
        for node in estimator.nodes.tolist():
            sigma = np.sqrt(np.diag(textbook.covariance([node])[0]))
            errors.append(np.abs(estimator.mean([node])[0] - textbook.mean([node])[0]) / sigma)
    assert np.mean(np.concatenate(errors)) <= 0.1


# the rest of the protocol


def crowd(seed=0, n=14):
    """A filter with several overlapping clusters of cars, buses and cones."""
    rng = np.random.default_rng(seed)
    estimator = BoundedKalmanFilter(hops=1, core=3)
    types = tuple((CAR, BUS, CAR, CONE)[k % 4] for k in range(n))
    for node, node_type in enumerate(types):
        new_nodes(rng, [node], node_type).run(estimator)
    for _ in range(3):
        estimator.predict(discretise(random_graph(rng, types, density=0.12), 0.3))
        estimator.update(measured([0, 2, 4]))
        estimator.update(measured([1, 5], d=6))
    return estimator, types


def test_clusters_overlap_in_the_crowd():
    estimator, _ = crowd()
    assert len(estimator.clusters) > 2
    assert sum(len(cluster) for cluster in estimator.clusters) > 14


@pytest.mark.parametrize("name", [name for name in BAD if "mixed" not in name and "predict" not in name])
def test_bad_input_changes_nothing(name):
    """The bad input of the conformance suite, which has one cluster, with several clusters."""
    call, _ = BAD[name]
    estimator = BoundedKalmanFilter(hops=1, core=2)
    rng = np.random.default_rng(0)
    new_nodes(rng, [4, 7, 9, 15, 16], CAR).run(estimator)
    new_nodes(rng, [8], BUS).run(estimator)
    types = (CAR, CAR, CAR, CAR, CAR, BUS)
    estimator.predict(discretise(random_graph(rng, types, [4, 7, 9, 15, 16, 8], 0.3), 0.4))
    state = estimator.snapshot()
    with pytest.raises(SagaError):
        call(estimator)
    assert vars(estimator.snapshot()) == vars(state)


def test_bad_transitions_change_nothing():
    estimator, types = crowd()
    state = estimator.snapshot()
    graph = random_graph(np.random.default_rng(1), types[:-1], density=0.1)
    with pytest.raises(InputError, match="expected 14 nodes, got 13"):
        estimator.predict(discretise(graph, 0.1))
    assert vars(estimator.snapshot()) == vars(state)


@pytest.mark.parametrize(
    ("bound", "message"),
    [({"hops": 0}, "hops"), ({"core": 0}, "core"), ({"patience": -1}, "patience"), ({"hops": 1.5}, "hops")],
)
def test_bounds_are_checked(bound, message):
    with pytest.raises(InputError, match=f"{message}: expected a whole number >= "):
        BoundedKalmanFilter(**bound)


def test_continuing_from_a_snapshot_is_bit_identical():
    program = random_program(np.random.default_rng(8), moments=9, density=0.15)
    middle = len(program) // 2
    first = BoundedKalmanFilter(hops=1, core=2)
    run(program[:middle], first)
    again = BoundedKalmanFilter(hops=1, core=2)
    again.restore(pickle.loads(pickle.dumps(first.snapshot())))
    for estimator in (first, again):
        run(program[middle:], estimator)
    assert first.time == again.time
    assert first.clusters == again.clusters
    assert np.array_equal(first.joint_mean(first.nodes), again.joint_mean(again.nodes))
    assert np.array_equal(first.joint_covariance(first.nodes), again.joint_covariance(again.nodes))


def test_what_a_node_told_of_a_neighbour_in_another_cluster_stays_when_it_leaves():
    chain = flock(seed=1, n=12, frames=1, neighbours=2)[1][0].transition
    left = []
    for told in (True, False):
        estimator = BoundedKalmanFilter(hops=1, core=1)
        new_nodes(np.random.default_rng(1), list(range(12)), CAR).run(estimator)
        estimator.predict(chain)
        if told:
            estimator.update(Measurements([0], np.ones((1, 4)), np.eye(4), 0.01 * np.eye(4)))
        neighbours = sorted({i for cluster in estimator.clusters if 0 in cluster for i in cluster} - {0})
        estimator.marginalise([0])
        left.append(np.trace(estimator.joint_covariance(neighbours)))
    assert left[0] < left[1] - 1e-3


def test_its_graph_has_its_means_and_marginal_covariances():
    estimator, _ = crowd()
    answer = estimator.graph()
    step = answer.native().linearize(answer.values).optimize()
    marginals = gtsam.Marginals(answer.native(), answer.values)
    for node, key in keys_of(answer, 0).items():
        assert np.abs(step.at(key)).max() <= 1e-9, "the values are the minimum"
        assert np.allclose(answer.values.atVector(key), estimator.mean([node])[0])
        assert np.allclose(marginals.marginalCovariance(key), estimator.covariance([node])[0], rtol=1e-8, atol=1e-10)
