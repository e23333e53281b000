"""Discretisation: the classical one without edges, second order against the joint exponential, stable for any dt."""

import dataclasses
from itertools import product

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Edges, InputError, SceneGraph
from saga_fg.conformance.programs import (
    BUS,
    CAR,
    CONE,
    POLE,
    TRAM,
    random_graph,
    random_types,
)
from saga_fg.model.discretisation import Blocks, Transition, discretise
from saga_fg.model.graph_building import joint_generator
from saga_fg.model.interactions import CarFollowing, NodeTable

seeds = st.integers(0, 2**32 - 1)
intervals = st.one_of(st.floats(1e-9, 1e3), st.sampled_from([0.0, 1e-9, 1e-3, 0.1, 1.0, 1e3]))


def van_loan(G, Qc, dt):
    """exp(G dt) and int_0^dt exp(G s) Qc exp(G^T s) ds (Van Loan 1978), over steps short enough for exp(-G s)."""
    D = len(G)
    doublings = max(0, int(np.ceil(np.log2(max(1e-300, np.linalg.norm(G) * dt)))))
    h = dt / 2**doublings
    block = scipy.linalg.expm(np.block([[-G, Qc], [np.zeros((D, D)), G.T]]) * h)
    F, Q = block[D:, D:].T, block[D:, D:].T @ block[:D, D:]
    for k in range(doublings):
        F = scipy.linalg.expm(G * h * 2**k)
        Q = Q + F @ Q @ F.T
    return scipy.linalg.expm(G * dt), Q


def exact(graph, dt):
    """F, b, Q of the joint system, its neighbours' neighbours and all."""
    G, c, Qc = joint_generator(graph)
    D = len(G)
    affine = scipy.linalg.expm(np.block([[G, c[:, None]], [np.zeros((1, D + 1))]]) * dt)
    return affine[:D, :D], affine[:D, D], van_loan(G, Qc, dt)[1]


def dense(transition):
    return transition.F_matrix.toarray(), transition.b, transition.Q_matrix.toarray()


# without edges


def test_every_type_without_edges_is_the_matrix_exponential(subtests):
    for dt, node_type in product([1e-6, 0.05, 0.7, 5.0, 40.0], [CAR, BUS, TRAM, CONE, POLE]):
        with subtests.test(dt=dt, node_type=node_type):
            F, _, Q = dense(discretise(SceneGraph.of([0, 1], node_type), dt))
            F_one, Q_one = van_loan(node_type.generator, node_type.diffusion, dt)
            assert np.allclose(F, scipy.linalg.block_diag(F_one, F_one), rtol=1e-11, atol=1e-14)
            assert np.allclose(Q, scipy.linalg.block_diag(Q_one, Q_one), rtol=1e-9, atol=1e-12 * Q_one.max(initial=0))


@given(seeds, intervals)
def test_rate_zero_is_exactly_no_edges_and_noise_is_positive_semidefinite(seed, dt):
    rng = np.random.default_rng(seed)
    types = random_types(rng, 5)
    graph = random_graph(rng, types, max_rate=0.0)
    with_edges, without = dense(discretise(graph, dt)), dense(discretise(SceneGraph(graph.nodes, graph.types), dt))
    for a, b in zip(with_edges, without, strict=True):
        assert np.array_equal(a, b)
    rng = np.random.default_rng(seed)
    for blocks in discretise(random_graph(rng, random_types(rng, 5), arbitrary=False), dt).Q:
        for Q in blocks.values:
            assert np.array_equal(Q, Q.T)
            scale = np.sqrt(np.diag(Q))
            correlation = Q / np.where(scale > 0, scale, 1)[:, None] / np.where(scale > 0, scale, 1)
            assert np.linalg.eigvalsh(correlation)[0] > -1e-10


def test_no_nodes_and_intervals_that_are_none(subtests):
    transition = discretise(SceneGraph([], ()), 0.5)
    F, b, Q = dense(transition)
    assert F.shape == Q.shape == (0, 0)
    assert b.shape == (0,)
    assert joint_generator(SceneGraph([], ()))[0].shape == (0, 0)
    for dt in [-0.1, np.nan, np.inf, -np.inf, 1e13, 1e300]:
        with subtests.test(dt=dt), pytest.raises(InputError, match="dt: expected a finite number of seconds from 0"):
            discretise(SceneGraph.of([0], CAR), dt)
    empty = discretise(SceneGraph([], ()), 1.0)
    assert empty.F_matrix.shape == (0, 0)
    assert empty.nodes.tolist() == []


# with edges, against the exponential of the joint generator


@given(seeds)
def test_dt_zero_is_standing_still(seed):
    rng = np.random.default_rng(seed)
    F, b, Q = dense(discretise(random_graph(rng, random_types(rng, 6)), 0.0))
    assert np.array_equal(F, np.eye(len(F)))
    assert not b.any()
    assert not Q.any()


@pytest.mark.parametrize("seed", range(8))
def test_half_the_interval_is_a_quarter_of_the_error(seed):
    """The mean map F x + b against exp(G dt): first order in the coupling, so that the error is O(dt^2)."""
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, random_types(rng, 6))
    error_F, error_b, error_Q = [], [], []
    for dt in (0.02, 0.01, 0.005):
        for errors, ours, reference in zip(
            (error_F, error_b, error_Q), dense(discretise(graph, dt)), exact(graph, dt), strict=True
        ):
            errors.append(np.linalg.norm(ours - reference))
    for errors in (error_F, error_b):
        assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
        assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)
    assert error_Q[0] / error_Q[1] > 3.8
    assert error_Q[1] / error_Q[2] > 3.8


@given(seeds, st.floats(0.01, 20))
def test_leaders_that_nothing_acts_on_make_the_step_exact(seed, dt):
    """The step leaves out the edges on the neighbours; without any, nothing is left out."""
    rng = np.random.default_rng(seed)
    types = random_types(rng, 6)
    full = random_graph(rng, types)
    groups = []
    for g in full.edges:
        keep = (g.target < 3) & (g.source >= 3)
        groups.append(
            Edges(
                g.interaction, g.target[keep], g.source[keep], g.rate[keep], g.A_self[keep], g.A_other[keep], g.b[keep]
            )
        )
    graph = SceneGraph(full.nodes, types, tuple(groups))
    F, b, _ = dense(discretise(graph, dt))
    F_exact, b_exact, _ = exact(graph, dt)
    assert np.allclose(F, F_exact, rtol=1e-9, atol=1e-9 * max(1, np.abs(F_exact).max()))
    assert np.allclose(b, b_exact, rtol=1e-9, atol=1e-9 * max(1, np.abs(b_exact).max()))


@given(seeds, st.floats(0.01, 3))
def test_the_diagonal_is_exact_along_a_nodes_own_share(seed, dt):
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, random_types(rng, 5))
    F, _, Q = dense(discretise(graph, dt))
    G, _, _ = joint_generator(graph)
    offsets = np.concatenate([[0], np.cumsum(graph.dims)])
    for k, node_type in enumerate(graph.types):
        own = slice(offsets[k], offsets[k + 1])
        F_own, Q_own = van_loan(G[own, own], node_type.diffusion, dt)
        assert np.allclose(F[own, own], F_own, rtol=1e-9, atol=1e-11)
        assert np.allclose(Q[own, own], Q_own, rtol=1e-8, atol=1e-10 * max(1e-9, np.abs(Q_own).max()))


# structure


@given(seeds, st.floats(1e-3, 10))
def test_the_step_is_as_sparse_as_the_graph(seed, dt):
    rng = np.random.default_rng(seed)
    types = random_types(rng, 7)
    graph = random_graph(rng, types, density=0.2)
    transition = discretise(graph, dt)
    pairs = [(int(i), int(j)) for blocks in transition.F for i, j in zip(blocks.target, blocks.source, strict=True)]
    edges = {(int(i), int(j)) for group in graph.edges for i, j in zip(group.target, group.source, strict=True)}
    assert len(pairs) == len(set(pairs)), "a pair occurs twice"
    assert set(pairs) == edges | {(k, k) for k in range(len(types))}
    noisy = [(int(i), int(j)) for blocks in transition.Q for i, j in zip(blocks.target, blocks.source, strict=True)]
    assert sorted(noisy) == [(k, k) for k in range(len(types))]


@given(seeds, st.floats(0.01, 5))
def test_scaled_diffusion_is_scaled_noise(seed, dt):
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, random_types(rng, 5))
    scale = rng.uniform(0.1, 3, 5)
    scaled = SceneGraph(graph.nodes, graph.types, graph.edges, scale)
    F, b, Q = dense(discretise(graph, dt))
    F_scaled, b_scaled, Q_scaled = dense(discretise(scaled, dt))
    by_component = np.repeat(scale, graph.dims)
    assert np.allclose(F_scaled, F, rtol=1e-12, atol=1e-13)
    assert np.allclose(b_scaled, b, rtol=1e-12, atol=1e-13)
    assert np.allclose(Q_scaled, by_component[:, None] * Q, rtol=1e-10, atol=1e-14)
    assert np.allclose(
        joint_generator(scaled)[2], by_component[:, None] * joint_generator(graph)[2], rtol=1e-12, atol=0
    )


# laws of the shipped interactions


def queue(n, heading, rate, gap=15.0, **law):
    """n cars in a line, each following the one ahead, in formation; and their joint state."""
    u = np.array([np.cos(heading), np.sin(heading)])
    position = -gap * np.arange(n)[:, None] * u
    velocity = np.tile(10.0 * u, (n, 1))
    label = np.array(["car"] * n)
    nodes = NodeTable(
        np.arange(n), label, (CAR,) * n, position, velocity, np.full(n, heading), np.full(n, 4.0), np.ones(n)
    )
    target = np.arange(1, n)
    interaction = CarFollowing(**law)
    edges = Edges("car-following", target, target - 1, rate, *interaction.triples(nodes, target, target - 1))
    return SceneGraph(nodes.id, nodes.types, (edges,)), np.concatenate([position, velocity], axis=1).ravel(), u


def test_a_queue_in_formation_stays_in_formation(subtests):
    for dt, headway in product([0.1, 1.0, 7.0, 100.0, 1000.0], [0.0, 1.0]):
        with subtests.test(dt=dt, headway=headway):
            graph, x, u = queue(6, 0.7, [0.1, 0.5, 1.0, 3.0, 20.0], headway=headway)
            transition = discretise(graph, dt)
            moved = (transition.F_matrix @ x + transition.b).reshape(6, 4)
            expected = x.reshape(6, 4) + np.concatenate([np.tile(10.0 * dt * u, (6, 1)), np.zeros((6, 2))], axis=1)
            assert np.allclose(moved, expected, rtol=1e-9, atol=1e-9 * max(1, dt))


# Transitions are checked where they are made, by hand or from a graph

GRAPH = SceneGraph([4, 9, 2], (CAR, BUS, CONE))
TRANSITION = discretise(GRAPH, 0.5)


def blocks(row, values):
    return Blocks(np.array([row]), np.array([row]), np.asarray(values, dtype=float)[None])


def test_parts_that_do_not_fit_are_refused(subtests):
    for parts, message in [
        ({"b": np.zeros(11)}, r"transition over 0.5 s: b: expected 12 entries, got shape \(11,\)"),
        ({"b": np.full(12, np.nan)}, "transition over 0.5 s: b: expected finite numbers"),
        ({"F": (blocks(0, np.eye(6)),)}, "F: blocks of size 6 x 6 do not fit the states of their nodes"),
        ({"F": (blocks(0, np.full((4, 4), np.nan)),)}, "F: expected finite numbers"),
        ({"Q": TRANSITION.Q[:-1]}, "Q: expected one block for each of 3 nodes"),
        ({"Q": TRANSITION.Q + TRANSITION.Q[:1]}, "Q: expected one block for each of 3 nodes"),
        ({"Q": (blocks(0, np.full((4, 4), np.inf)), *TRANSITION.Q[1:])}, "Q: expected finite numbers"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            dataclasses.replace(TRANSITION, **parts)


def test_dynamics_that_explode_within_the_interval_are_refused():
    edges = Edges("repulsion", [0], [1], [1.0], [5.0 * np.eye(4)], np.zeros((1, 4, 4)), np.ones((1, 4)))
    graph = SceneGraph.of([1, 2], CAR, [edges])
    assert isinstance(discretise(graph, 1.0), Transition)
    with pytest.raises(InputError, match=r"transition over 1000 s: .*: expected finite numbers"):
        discretise(graph, 1000.0)
