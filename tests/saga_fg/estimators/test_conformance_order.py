"""Every estimator is indifferent to order, to coupling where there is none, and to a snapshot between."""

import numpy as np
import pytest

from saga_fg import Edges, SceneGraph
from saga_fg.conformance.programs import Add, Marginalise, Predict, Update, random_program, run
from saga_fg.estimators import GraphFilter, Measurements
from saga_fg.model.discretisation import discretise


def permuted(operation, rng):
    """Return the operation with its nodes in another order."""
    if isinstance(operation, Add):
        order = rng.permutation(len(operation.nodes))
        return Add(operation.nodes[order], operation.means[order], operation.covariances[order])
    if isinstance(operation, Marginalise):
        return Marginalise(rng.permutation(operation.nodes))
    if isinstance(operation, Update):
        m = operation.measurements
        order = rng.permutation(len(m))
        return Update(Measurements(m.nodes[order], m.z[order], m.H[order], m.R[order]))
    graph = operation.transition.graph
    order = rng.permutation(len(graph))
    place = np.argsort(order)
    groups = tuple(
        Edges(g.interaction, place[g.target], place[g.source], g.rate, g.A_self, g.A_other, g.b) for g in graph.edges
    )
    types = tuple(graph.types[k] for k in order)
    return Predict(discretise(SceneGraph(graph.nodes[order], types, groups), operation.transition.dt))


@pytest.mark.parametrize("seed", range(2))
def test_the_order_in_which_nodes_are_told_does_not_matter(make, seed):
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=6)
    one, likelihoods = run(program, make())
    other, same_likelihoods = run([permuted(operation, rng) for operation in program], make())
    nodes = one.nodes
    assert sorted(other.nodes.tolist()) == sorted(nodes.tolist())
    assert same_likelihoods == pytest.approx(likelihoods, rel=1e-9, nan_ok=True)
    P = one.joint_covariance(nodes)
    assert np.linalg.norm(other.joint_covariance(nodes) - P) <= 1e-9 * np.linalg.norm(P)
    assert np.abs(other.joint_mean(nodes) - one.joint_mean(nodes)).max() <= 1e-9 * np.sqrt(np.diag(P)).max()


@pytest.mark.parametrize("seed", range(2))
def test_rate_zero_is_independent_filters_exactly(make, seed):
    """Together or each alone: the same digits, and no correlation between any two.

    iSAM2 solves when it is told something, so that others change how often; its digits are the same to rounding.
    """
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=6, max_rate=0.0)
    together, _ = run(program, make())
    rounding = 1e-11 if isinstance(together, GraphFilter) else 0.0
    for node in together.nodes.tolist():
        alone, _ = run([part for part in (only(operation, node) for operation in program) if part], make())
        assert np.allclose(alone.mean([node]), together.mean([node]), rtol=rounding, atol=rounding)
        assert np.allclose(alone.covariance([node]), together.covariance([node]), rtol=rounding, atol=rounding)
    P = together.joint_covariance(together.nodes)
    blocks = np.zeros_like(P)
    start = 0
    for node in together.nodes.tolist():
        own = together.covariance([node])[0]
        blocks[start : start + len(own), start : start + len(own)] = own
        start += len(own)
    assert np.array_equal(P, blocks)


def only(operation, node):
    """Return the part of an operation on one node; None if it has none."""
    if isinstance(operation, Predict):
        graph = operation.transition.graph  # type: ignore[attr-defined]
        rows = np.flatnonzero(graph.nodes == node)
        if len(rows) == 0:
            return None
        return Predict(discretise(SceneGraph([node], (graph.types[rows[0]],)), operation.transition.dt))  # type: ignore[attr-defined]
    if isinstance(operation, Update):
        m = operation.measurements
        rows = np.flatnonzero(m.nodes == node)
        return Update(Measurements(m.nodes[rows], m.z[rows], m.H[rows], m.R[rows])) if len(rows) else None
    rows = np.flatnonzero(np.asarray(operation.nodes) == node)
    if len(rows) == 0:
        return None
    if isinstance(operation, Marginalise):
        return Marginalise(np.array([node]))
    return Add(operation.nodes[rows], operation.means[rows], operation.covariances[rows])


def test_continuing_from_a_snapshot_is_bit_identical(make):
    estimator = make()
    program = random_program(np.random.default_rng(21), moments=9)
    middle = len(program) // 2
    run(program[:middle], estimator)
    state = estimator.snapshot()
    before = estimator.joint_mean(estimator.nodes), estimator.joint_covariance(estimator.nodes)
    run(program[middle:], estimator)
    first = estimator.nodes, estimator.joint_mean(estimator.nodes), estimator.joint_covariance(estimator.nodes)
    for again in (estimator, make()):
        again.restore(state)
        assert np.array_equal(again.joint_mean(again.nodes), before[0])
        assert np.array_equal(again.joint_covariance(again.nodes), before[1])
        run(program[middle:], again)
        second = again.nodes, again.joint_mean(again.nodes), again.joint_covariance(again.nodes)
        for a, b in zip(first, second, strict=True):
            assert np.array_equal(a, b)
