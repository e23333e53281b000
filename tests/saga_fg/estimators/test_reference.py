"""The textbook against something plainer still: one Gaussian over the states of all times, conditioned at once.

Stacked over all times, x = M w with w = (initial states, process noises) independent, so that x ~ N(m, M W M^T) and
z = H x + v give the posterior of the whole trajectory, and the likelihood of all measurements, by one formula each.
"""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from saga_fg.estimators import Gaussian, kalman_predict, kalman_update, rts_smooth


class Step(NamedTuple):
    """One step: x <- F x + b + q with F (D_k+1, D_k), new nodes in the rows of zeros; then z = H x + v."""

    F: np.ndarray
    b: np.ndarray
    Q: np.ndarray
    z: np.ndarray
    H: np.ndarray
    R: np.ndarray


def covariance(rng, n, scale=1.0):
    A = rng.normal(size=(n, n))
    return scale * (A @ A.T + 0.3 * np.eye(n))


def problem(rng, steps=5):
    """Two-component nodes that come and go; measurements of random combinations, sometimes none."""
    alive, recorded = 2, []
    for k in range(steps):
        dead = int(rng.integers(0, 2)) if k and alive > 1 else 0
        new = int(rng.integers(0, 2)) if k else alive
        stay = alive - dead if k else 0
        before, after = 2 * alive if k else 0, 2 * (stay + new)
        F, b, Q = np.zeros((after, before)), np.zeros(after), np.zeros((after, after))
        old = 2 * stay
        F[:old, :old] = np.eye(old) + 0.3 * rng.normal(size=(old, old))
        F[:old, old:] = 0.3 * rng.normal(size=(old, before - old)) if k else 0  # who leaves has pulled once more
        b[:] = rng.normal(size=after)
        Q[:old, :old] = covariance(rng, old, 0.2)
        for row in range(old, after, 2):
            Q[row : row + 2, row : row + 2] = covariance(rng, 2, 3.0)
        m = int(rng.integers(0, 4))
        H, R = rng.normal(size=(m, after)), covariance(rng, m, 0.5)
        recorded.append(Step(F, b, Q, rng.normal(size=m), H, R))
        alive = stay + new
    return recorded


def all_at_once(steps):
    """Posterior of the stacked states, their offsets, and the log-likelihood of all measurements."""
    offsets = np.concatenate([[0], np.cumsum([len(s.b) for s in steps])])
    D = offsets[-1]
    mean, P = np.zeros(D), np.zeros((D, D))
    for k, s in enumerate(steps):
        now, before = slice(offsets[k], offsets[k + 1]), slice(offsets[k - 1] if k else 0, offsets[k])
        past = slice(0, offsets[k])
        mean[now] = s.F @ mean[before] + s.b
        P[now, past] = s.F @ P[before, past]
        P[past, now] = P[now, past].T
        P[now, now] = s.F @ P[before, before] @ s.F.T + s.Q
    H = np.zeros((sum(len(s.z) for s in steps), D))
    R = np.zeros((len(H), len(H)))
    row = 0
    for k, s in enumerate(steps):
        rows = slice(row, row + len(s.z))
        H[rows, offsets[k] : offsets[k + 1]], R[rows, rows] = s.H, s.R
        row += len(s.z)
    z = np.concatenate([s.z for s in steps])
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T if len(z) else np.zeros((D, 0))
    likelihood = multivariate_normal.logpdf(z, H @ mean, S) if len(z) else 0.0
    return mean + K @ (z - H @ mean), P - K @ H @ P, offsets, likelihood


def by_the_book(steps):
    x = Gaussian(np.empty(0), np.empty((0, 0)))
    filtered, predicted, total = [], [], 0.0
    for s in steps:
        prior = kalman_predict(x, s.F, s.b, s.Q)
        x, likelihood = kalman_update(prior, s.z, s.H, s.R)
        predicted.append(prior)
        filtered.append(x)
        total += likelihood
    return filtered, rts_smooth(filtered, predicted[1:], [s.F for s in steps[1:]]), total


@given(st.integers(0, 2**32 - 1))
def test_filter_smoother_and_likelihood_are_those_of_the_whole_trajectory(seed):
    steps = problem(np.random.default_rng(seed))
    mean, P, offsets, likelihood = all_at_once(steps)
    filtered, smoothed, total = by_the_book(steps)
    assert total == pytest.approx(likelihood, rel=1e-9, abs=1e-9)
    assert len(smoothed) == len(steps)
    for k, x in enumerate(smoothed):
        now = slice(offsets[k], offsets[k + 1])
        assert np.allclose(x.mean, mean[now], rtol=1e-7, atol=1e-8)
        assert np.allclose(x.covariance, P[now, now], rtol=1e-7, atol=1e-8)
        up_to_now, _, start, _ = all_at_once(steps[: k + 1])
        assert np.allclose(filtered[k].mean, up_to_now[start[k] :], rtol=1e-7, atol=1e-8)


def test_the_problems_have_new_and_leaving_nodes():
    shapes = {s.F.shape for seed in range(20) for s in problem(np.random.default_rng(seed))[1:]}
    assert any(rows > columns for rows, columns in shapes)
    assert any(rows < columns for rows, columns in shapes)


def test_a_scalar_by_hand_and_one_moment():
    """Prior N(1, 4), z = 3 with variance 4: the posterior is halfway, its variance half."""
    x, likelihood = kalman_update(Gaussian(np.ones(1), 4 * np.eye(1)), np.array([3.0]), np.eye(1), 4 * np.eye(1))
    assert x.mean == pytest.approx([2.0])
    assert x.covariance == pytest.approx(2 * np.eye(1))
    assert likelihood == pytest.approx(-0.5 * (4 / 8 + np.log(8) + np.log(2 * np.pi)))
    moved = kalman_predict(x, np.array([[2.0]]), np.array([-1.0]), 0.5 * np.eye(1))
    assert (moved.mean[0], moved.covariance[0, 0]) == pytest.approx((3.0, 8.5))
    x = Gaussian(np.ones(2), np.eye(2))
    assert rts_smooth([x], [], []) == [x]
