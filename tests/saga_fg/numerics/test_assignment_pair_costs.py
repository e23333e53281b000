"""Pairwise costs: joint likelihoods of two associations, weighed so that nothing is counted twice."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from saga_fg.numerics.assignment import CrossCovariances, pair_costs, tree_edges


def drawn(seed, n=3, common=2.0, own=1.0, noise=0.3, ties=None):
    """n tracks, of which `ties` (all, if left out) share a displacement: joint covariance (2n, 2n) of the positions."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2 * n, 2 * n))
    shared = np.zeros((2 * n, 2 * n))
    for i, j in itertools.combinations(range(n), 2) if ties is None else ties:
        step = np.zeros((2 * n, 2))
        step[2 * i : 2 * i + 2] = step[2 * j : 2 * j + 2] = common * rng.normal(size=(2, 2))
        shared += step @ step.T
    P = shared + own * np.kron(np.eye(n), np.ones((2, 2))) * (A @ A.T) + own * np.eye(2 * n)
    return P, noise**2 * np.eye(2), rng


def blocks(P):
    n = len(P) // 2
    return P.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)


def between(P):
    first, second = np.triu_indices(len(P) // 2, 1)
    return CrossCovariances(first, second, blocks(P)[first, second])


def weights(P, S):
    """The edges of trees, and how often they are in one, of tracks with a candidate each."""
    (first, second, _), weight = tree_edges(np.arange(len(S)), np.linalg.inv(np.linalg.cholesky(S)), between(P))
    return list(zip(first.tolist(), second.tolist(), strict=True)), weight


def one_each(P, R, rng):
    """Every track has its own detection: innovations (n, 2) and what `pair_costs` says of them."""
    n = len(P) // 2
    innovation = rng.multivariate_normal(np.zeros(2 * n), P + np.kron(np.eye(n), R)).reshape(n, 2)
    S = blocks(P)[np.arange(n), np.arange(n)] + R
    return innovation, S, pair_costs(np.arange(n), np.arange(n), innovation, S, between(P))


@given(seed=st.integers(0, 2**32 - 1))
def test_of_two_tracks_it_is_the_joint_likelihood_over_the_product_of_the_two(seed):
    P, R, rng = drawn(seed, n=2)
    innovation, S, costs = one_each(P, R, rng)
    joint = multivariate_normal(np.zeros(4), P + np.kron(np.eye(2), R)).logpdf(innovation.ravel())
    apart = sum(multivariate_normal(np.zeros(2), S[k]).logpdf(innovation[k]) for k in range(2))
    assert costs.cost.sum() == pytest.approx(-2 * (joint - apart), abs=1e-7)


def test_on_a_tree_of_ties_every_edge_counts_once():
    P, R, rng = drawn(1, n=4, ties=[(0, 1), (1, 2), (1, 3)])
    _, S, _ = one_each(P, R, rng)
    edges, weight = weights(P, S)
    assert set(edges) == {(0, 1), (1, 2), (1, 3)}
    np.testing.assert_allclose(weight, 1.0, atol=1e-9)


@pytest.mark.parametrize("n", [3, 5])
def test_of_objects_that_move_as_one_the_weights_add_up_to_a_tree(n):
    P = np.kron(np.ones((n, n)), 4.0 * np.eye(2)) + 0.1 * np.eye(2 * n)
    S = np.tile(4.2 * np.eye(2), (n, 1, 1))
    _, weight = weights(P, S)
    np.testing.assert_allclose(weight, 2 / n)
    assert weight.sum() == pytest.approx(n - 1)


def test_independent_tracks_say_nothing_of_each_other():
    P, R, rng = drawn(3, n=4, ties=())
    assert len(one_each(P, R, rng)[2].cost) == 0


def test_a_detection_is_not_paired_with_itself_and_pairs_are_named_once():
    P, R, _ = drawn(4, n=2)
    track, detection = np.array([0, 1, 1, 0]), np.array([5, 5, 6, 6])
    S = blocks(P)[track, track] + R
    costs = pair_costs(track, detection, np.zeros((4, 2)), S, between(P))
    pairs = {tuple(sorted(pair)) for pair in zip(costs.first.tolist(), costs.second.tolist(), strict=True)}
    assert pairs == {(0, 2), (1, 3)}
    assert len(costs.first) == 2
