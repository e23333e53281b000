"""Assignment, with costs of pairs, and gates."""

import itertools
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import multivariate_normal

from saga_fg.numerics import assignment
from saga_fg.numerics import geometry as module
from saga_fg.numerics.assignment import (
    CrossCovariances,
    PairCosts,
    QuadraticMatching,
    assign,
    gate,
    mahalanobis,
    pair_costs,
    tree_edges,
)
from saga_fg.numerics.geometry import near_pairs

seeds = st.integers(0, 2**32 - 1)


def covariances(rng, n):
    A = rng.normal(size=(n, 2, 2))
    return A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(2)


@given(seeds, st.integers(0, 4), st.integers(0, 4))
def test_distances_are_the_textbooks(seed, n, m):
    rng = np.random.default_rng(seed)
    position, measured, P, R = (
        rng.normal(size=(n, 2)),
        rng.normal(size=(m, 2)),
        covariances(rng, n),
        covariances(rng, m),
    )
    d2, log_det = mahalanobis(position, P, measured, R)
    assert d2.shape == log_det.shape == (n, m)
    for i, j in itertools.product(range(n), range(m)):
        innovation, S = measured[j] - position[i], P[i] + R[j]
        assert d2[i, j] == pytest.approx(innovation @ np.linalg.solve(S, innovation))
        assert log_det[i, j] == pytest.approx(np.linalg.slogdet(S)[1])


def test_the_gate_lets_its_share_through(subtests):
    for probability, dim in product([0.5, 0.9, 0.99], [2, 4]):
        with subtests.test(probability=probability, dim=dim):
            samples = (np.random.default_rng(0).normal(size=(200_000, dim)) ** 2).sum(axis=1)
            assert (samples < gate(probability, dim)).mean() == pytest.approx(probability, abs=0.004)


def total(cost, unmatched, rows, columns):
    """Gain against matching nothing."""
    return sum(
        float(cost[i, j] - np.broadcast_to(unmatched, cost.shape)[i, j]) for i, j in zip(rows, columns, strict=True)
    )


def best_by_brute_force(cost, possible, unmatched):
    n, m = cost.shape
    best = 0.0
    for k in range(1, min(n, m) + 1):
        for rows in itertools.combinations(range(n), k):
            for columns in itertools.permutations(range(m), k):
                if all(possible[i, j] for i, j in zip(rows, columns, strict=True)):
                    best = min(best, total(cost, unmatched, rows, columns))
    return best


@given(st.integers(0, 4), st.integers(0, 4), st.data())
def test_the_assignment_is_the_best_of_all(n, m, data):
    cost = data.draw(arrays(np.float64, (n, m), elements=st.floats(-20, 20)))
    possible = data.draw(arrays(np.bool_, (n, m)))
    unmatched = data.draw(st.one_of(st.floats(-5, 25), arrays(np.float64, (n, 1), elements=st.floats(-5, 25))))
    rows, columns = assign(cost, possible, unmatched)
    assert len(set(rows.tolist())) == len(rows)
    assert len(set(columns.tolist())) == len(columns)
    assert possible[rows, columns].all()
    assert total(cost, unmatched, rows, columns) == pytest.approx(
        best_by_brute_force(cost, possible, unmatched), abs=1e-9
    )


# Pairwise costs: joint likelihoods of two associations, weighed so that nothing is counted twice


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
def test_joint_likelihoods_of_two_tracks_and_the_hungarian_assignment_without_pairs(seed):
    P, R, rng = drawn(seed, n=2)
    innovation, S, costs = one_each(P, R, rng)
    joint = multivariate_normal(np.zeros(4), P + np.kron(np.eye(2), R)).logpdf(innovation.ravel())
    apart = sum(multivariate_normal(np.zeros(2), S[k]).logpdf(innovation[k]) for k in range(2))
    assert costs.cost.sum() == pytest.approx(-2 * (joint - apart), abs=1e-7)
    problem = quadratic_drawn(seed, tracks=12, detections=9, most=60, coupling=0.0)
    gain = np.zeros((37, 9))
    gain[problem.track, problem.detection] = problem.gain
    pairs = set(zip(*(rows.tolist() for rows in assign(gain, gain < 0, 0.0)), strict=True))
    chosen = solved(problem)
    assert set(zip(problem.track[chosen].tolist(), problem.detection[chosen].tolist(), strict=True)) == pairs


def test_trees_of_ties_count_every_edge_once_and_independent_tracks_none():
    P, R, rng = drawn(1, n=4, ties=[(0, 1), (1, 2), (1, 3)])
    _, S, _ = one_each(P, R, rng)
    edges, weight = weights(P, S)
    assert set(edges) == {(0, 1), (1, 2), (1, 3)}
    np.testing.assert_allclose(weight, 1.0, atol=1e-9)
    P, R, rng = drawn(3, n=4, ties=())
    assert len(one_each(P, R, rng)[2].cost) == 0
    none = np.empty(0, dtype=np.int64)
    assert len(QuadraticMatching(none, none, np.empty(0), PairCosts(none, none, np.empty(0))).solve()) == 0


def test_a_detection_is_not_paired_with_itself_and_pairs_are_named_once():
    P, R, _ = drawn(4, n=2)
    track, detection = np.array([0, 1, 1, 0]), np.array([5, 5, 6, 6])
    S = blocks(P)[track, track] + R
    costs = pair_costs(track, detection, np.zeros((4, 2)), S, between(P))
    pairs = {tuple(sorted(pair)) for pair in zip(costs.first.tolist(), costs.second.tolist(), strict=True)}
    assert pairs == {(0, 2), (1, 3)}
    assert len(costs.first) == 2


# The quadratic matching: as good as trying everything, and the Hungarian algorithm's where pairs cost nothing


def quadratic_drawn(seed, tracks=5, detections=5, most=10, coupling=2.0):
    """A problem of up to `most` candidates, in any order, with costs between some pairs of them."""
    rng = np.random.default_rng(seed)
    every = rng.permutation(list(itertools.product(range(tracks), range(detections))))
    track, detection = every[: rng.integers(1, most + 1)].T
    first, second = np.triu_indices(len(track), 1)
    tied = (track[first] != track[second]) & (detection[first] != detection[second])
    tied &= rng.random(len(first)) < rng.random()
    cost = coupling * rng.normal(size=int(tied.sum()))
    gain = rng.normal(rng.normal(), 2.0, len(track))
    return QuadraticMatching(3 * track, detection, gain, PairCosts(first[tied], second[tied], cost))


def allowed(problem, chosen):
    return all(len(set(x[chosen].tolist())) == chosen.sum() for x in (problem.track, problem.detection))


def least_cost(problem):
    choices = (np.array(bits, dtype=bool) for bits in itertools.product((False, True), repeat=len(problem.gain)))
    return min(problem.cost(chosen) for chosen in choices if allowed(problem, chosen))


def solved(problem):
    chosen = np.zeros(len(problem.gain), dtype=bool)
    chosen[problem.solve()] = True
    assert allowed(problem, chosen)
    return chosen


@pytest.mark.parametrize("coupling", [0.1, 2.0, 8.0])
@given(seed=st.integers(0, 2**32 - 1))
def test_no_choice_costs_less(coupling, seed):
    problem = quadratic_drawn(seed, coupling=coupling)
    assert problem.cost(solved(problem)) == pytest.approx(least_cost(problem), abs=1e-9)


def test_a_large_component_is_no_worse_than_the_hungarian_assignment(monkeypatch):
    monkeypatch.setattr(assignment, "LARGEST_FRONTIER", 500)
    for seed in range(5):
        problem = quadratic_drawn(seed, tracks=30, detections=30, most=200)
        gain = np.zeros((3 * 30, 30))
        gain[problem.track, problem.detection] = problem.gain
        linear = np.zeros(len(problem.gain), dtype=bool)
        rows, columns = assign(gain, gain < 0, 0.0)
        for k, pair in enumerate(zip(problem.track.tolist(), problem.detection.tolist(), strict=True)):
            linear[k] = pair in set(zip(rows.tolist(), columns.tolist(), strict=True))
        assert problem.cost(solved(problem)) <= problem.cost(linear) + 1e-9


# Pairs within reach: the tree finds what comparing all distances finds


def by_distances(a, b, reach, further):
    distance = np.hypot(*np.moveaxis(a[:, None] - b, -1, 0))
    return np.nonzero(distance <= reach[:, None] + further)


@pytest.fixture(params=[0, 10**9], ids=["tree", "kernel"])
def most_compared(request, monkeypatch):
    monkeypatch.setattr(module, "MAX_COMPARED", request.param)


@pytest.mark.usefixtures("most_compared")
def test_pairs_are_those_of_all_distances_in_order_and_of_nothing_none(subtests):
    for seed in range(5):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            a, b = rng.uniform(-50, 50, (80, 2)), rng.uniform(-50, 50, (60, 2))
            reach, further = rng.lognormal(1, 1.5, 80), rng.uniform(0, 2, 60)
            found = near_pairs(a, b, reach, further)
            np.testing.assert_array_equal(found, by_distances(a, b, reach, further))
            assert len(found[0]) > 20
    a, b = np.array([[0.0, 0.0], [1e9, 0.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [5.0, 5.0]])
    i, j = near_pairs(a, b, np.array([np.nan, np.inf, 1.0]), np.array([0.0, np.nan]))
    assert (i.tolist(), j.tolist()) == ([1, 2], [0, 0])
    for n, m in [(0, 0), (0, 3), (3, 0)]:
        with subtests.test(n=n, m=m):
            i, j = near_pairs(np.zeros((n, 2)), np.zeros((m, 2)), np.ones(n))
            assert len(i) == len(j) == 0


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-3, 1.0, 1e5]))
def test_a_place_is_near_itself(seed, reach):
    places = np.random.default_rng(seed).normal(scale=1e4, size=(310, 2))
    i, j = near_pairs(places, places, np.full(len(places), reach))
    assert set(zip(range(310), range(310), strict=True)) <= set(zip(i.tolist(), j.tolist(), strict=True))


def test_reaches_may_be_whole_numbers():
    a = np.array([[0.0, 0.0], [10.0, 0.0]])
    rows, columns = near_pairs(a, a[:1] + 1.0, np.full(2, 2), 0)
    assert rows.tolist() == [0]
    assert columns.tolist() == [0]
