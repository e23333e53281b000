"""The covariances mean what they say: NEES on data drawn from the model itself.

    NEES = (x - m)^T P^-1 (x - m)   is chi-square with as many degrees of freedom as x has components

Of every run one step is evaluated, so that all values are independent and their sum is chi-square too (Bar-Shalom, Li,
Kirubarajan 2001, section 5.4.2).
"""

import numpy as np
import pytest
from scipy.stats import chi2

from saga_fg import Edges, SceneGraph
from saga_fg.conformance.programs import BUS, CAR, interaction_edges, node_table
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import CarFollowing, SharedVelocity

RUNS = 200
TYPES = (CAR, CAR, BUS, CAR, BUS, CAR)


def drawn_graph(rng):
    """Edges and their rates, sampled anew for every interval."""
    nodes = node_table(rng, TYPES)
    edges = [
        *interaction_edges(rng, nodes, SharedVelocity(), 0.4, 3.0),
        *interaction_edges(rng, nodes, CarFollowing(headway=0.3), 0.2, 3.0),
    ]
    return SceneGraph(nodes.id, nodes.types, tuple(edges))


def misjudged(graph, factor):
    """The graph with all rates multiplied."""
    groups = tuple(
        Edges(g.interaction, g.target, g.source, factor * g.rate, g.A_self, g.A_other, g.b) for g in graph.edges
    )
    return SceneGraph(graph.nodes, graph.types, groups)


def root(P):
    """A with A A^T = P, of a matrix that may be singular to within rounding."""
    values, vectors = np.linalg.eigh(P)
    return vectors * np.sqrt(np.maximum(values, 0))


def error_squared(rng, factor, steps=4):
    """NEES at the end of a run whose truth obeys the model, in a filter whose rates are off by `factor`."""
    estimator, truth = JointKalmanFilter(), []
    for node, node_type in enumerate(TYPES):
        mean, deviation = rng.normal(size=node_type.dim) * 5, np.full(node_type.dim, 2.0)
        estimator.add([node], mean[None], np.diag(deviation**2)[None])
        truth.append(mean + deviation * rng.normal(size=node_type.dim))
    x = np.concatenate(truth)
    offsets = np.concatenate([[0], np.cumsum([t.dim for t in TYPES])])
    for _ in range(steps):
        graph, dt = drawn_graph(rng), float(rng.uniform(0.1, 0.8))
        transition = discretise(graph, dt)
        estimator.predict(discretise(misjudged(graph, factor), dt))
        x = transition.F_matrix @ x + transition.b + root(transition.Q_matrix.toarray()) @ rng.normal(size=len(x))
        for kind in (CAR, BUS):
            seen = [node for node, t in enumerate(TYPES) if t is kind and rng.random() < 0.6]
            if seen:
                at = offsets[seen][:, None] + np.arange(2)
                z = x[at] + 0.3 * rng.normal(size=at.shape)
                estimator.update(Measurements(seen, z, np.eye(2, kind.dim), 0.09 * np.eye(2)))
    nodes = np.arange(len(TYPES))
    error = x - estimator.joint_mean(nodes)
    return float(error @ np.linalg.solve(estimator.joint_covariance(nodes), error))


def mean_nees(factor):
    """Over all runs, per degree of freedom; and the band in which 99.9 % of such means lie."""
    freedom = RUNS * sum(t.dim for t in TYPES)
    total = sum(error_squared(np.random.default_rng(run), factor) for run in range(RUNS))
    return total / freedom, chi2.ppf([0.0005, 0.9995], freedom) / freedom


def test_on_data_of_the_model_the_filter_is_consistent():
    value, (low, high) = mean_nees(factor=1.0)
    assert low <= value <= high


@pytest.mark.parametrize("factor", [0.0, 1.5])
def test_with_rates_that_are_wrong_it_is_not(factor):
    """Neglecting the interactions, or taking them for half as strong again, is noticed."""
    value, (low, high) = mean_nees(factor)
    assert not low <= value <= high
