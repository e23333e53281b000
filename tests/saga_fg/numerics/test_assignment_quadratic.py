"""The quadratic matching: as good as trying everything, and the Hungarian algorithm's where pairs cost nothing."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg.numerics import assignment
from saga_fg.numerics.assignment import PairCosts, QuadraticMatching, assign


def drawn(seed, tracks=5, detections=5, most=10, coupling=2.0):
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
    problem = drawn(seed, coupling=coupling)
    assert problem.cost(solved(problem)) == pytest.approx(least_cost(problem), abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_without_costs_of_pairs_it_is_the_hungarian_assignment(seed):
    problem = drawn(seed, tracks=12, detections=9, most=60, coupling=0.0)
    gain = np.zeros((37, 9))
    gain[problem.track, problem.detection] = problem.gain
    pairs = set(zip(*(rows.tolist() for rows in assign(gain, gain < 0, 0.0)), strict=True))
    chosen = solved(problem)
    assert set(zip(problem.track[chosen].tolist(), problem.detection[chosen].tolist(), strict=True)) == pairs


def test_a_large_component_is_no_worse_than_the_hungarian_assignment(monkeypatch):
    monkeypatch.setattr(assignment, "LARGEST_FRONTIER", 500)
    for seed in range(5):
        problem = drawn(seed, tracks=30, detections=30, most=200)
        gain = np.zeros((3 * 30, 30))
        gain[problem.track, problem.detection] = problem.gain
        linear = np.zeros(len(problem.gain), dtype=bool)
        rows, columns = assign(gain, gain < 0, 0.0)
        for k, pair in enumerate(zip(problem.track.tolist(), problem.detection.tolist(), strict=True)):
            linear[k] = pair in set(zip(rows.tolist(), columns.tolist(), strict=True))
        assert problem.cost(solved(problem)) <= problem.cost(linear) + 1e-9


def test_nothing_to_choose_from():
    none = np.empty(0, dtype=np.int64)
    assert len(QuadraticMatching(none, none, np.empty(0), PairCosts(none, none, np.empty(0))).solve()) == 0
