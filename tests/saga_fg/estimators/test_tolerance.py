"""The joint filter with a tolerance: weak ties are inputs, what hardly correlates is apart, strong ties stay."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg import Edges, InputError, SceneGraph
from saga_fg.conformance.programs import CAR
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise


def chain(rates):
    """Node k + 1 takes over the velocity of node k at rates[k], 1/s."""
    n, m = len(rates) + 1, len(rates)
    A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (m, 1, 1))
    edges = Edges("shared velocity", np.arange(1, n), np.arange(m), np.array(rates), -A, A, np.zeros((m, 4)))
    return SceneGraph.of(np.arange(n), CAR, [edges])


def filters(n, tolerance):
    rng = np.random.default_rng(n)
    means = rng.normal(scale=5.0, size=(n, 4))
    found = JointKalmanFilter(), JointKalmanFilter(tolerance=tolerance)
    for estimator in found:
        estimator.add(np.arange(n), means, np.tile(np.diag([0.3, 0.3, 1.0, 1.0]), (n, 1, 1)))
    return found


def size_of_components(estimator):
    return np.bincount(estimator.posterior().partition.label).tolist()


def test_a_weak_tie_is_an_input_with_its_mean_and_its_noise():
    exact, close = filters(2, 0.02)
    transition = discretise(chain([0.05]), 0.1)
    for estimator in (exact, close):
        estimator.predict(transition)
    assert size_of_components(exact) == [2]
    assert size_of_components(close) == [1, 1]
    np.testing.assert_allclose(close.mean([0, 1]), exact.mean([0, 1]), atol=1e-12)
    np.testing.assert_allclose(close.covariance([0, 1]), exact.covariance([0, 1]), atol=1e-12)


def test_a_strong_tie_is_kept_whole():
    exact, close = filters(2, 0.02)
    for estimator in (exact, close):
        estimator.predict(discretise(chain([2.0]), 0.5))
    np.testing.assert_allclose(close.joint_covariance([0, 1]), exact.joint_covariance([0, 1]), atol=1e-12)


@pytest.mark.parametrize(("tolerance", "apart"), [(0.005, False), (0.02, True), (0.05, True)])
def test_long_runs_stay_near_the_exact_filter_and_their_covariances_hold(tolerance, apart):
    """Ties of many strengths come and go; errors are a few times the tolerance, in standard deviations."""
    rng, n = np.random.default_rng(3), 24
    exact, close = filters(n, tolerance)
    errors = []
    for _ in range(40):
        rates = np.where(rng.random(n - 1) < 0.5, rng.uniform(0.0, 0.3, n - 1), 0.0)
        transition = discretise(chain(rates), 0.2)
        seen = np.flatnonzero(rng.random(n) < 0.8)
        z = exact.mean(seen)[:, :2] + rng.normal(scale=0.3, size=(len(seen), 2))
        for estimator in (exact, close):
            estimator.predict(transition)
            estimator.update(Measurements(seen, z, np.eye(2, 4), 0.1 * np.eye(2)))
        P = close.covariance(np.arange(n))
        assert (np.linalg.eigvalsh(P) > 0).all()
        sigma = np.sqrt(np.diagonal(exact.covariance(np.arange(n)), axis1=1, axis2=2))
        errors.append((close.mean(np.arange(n)) - exact.mean(np.arange(n))) / sigma)
    assert np.sqrt(np.mean(np.square(errors))) < 2 * tolerance
    assert (len(size_of_components(close)) > len(size_of_components(exact))) == apart


def test_a_tolerance_that_is_no_correlation_is_refused(subtests):
    for bad in [-0.1, 1.0, np.nan]:
        with subtests.test(bad=bad), pytest.raises(InputError, match="tolerance"):
            JointKalmanFilter(tolerance=bad)


def test_components_keep_to_their_size_and_the_strongest_ties():
    """Of a chain of six every second tie is weaker: pairs go by the others."""
    close = JointKalmanFilter(max_component=2)
    close.add(np.arange(6), np.zeros((6, 4)), np.tile(np.eye(4), (6, 1, 1)))
    close.predict(discretise(chain([2.0, 0.5, 2.0, 0.5, 2.0]), 0.2))
    P = close.joint_covariance(np.arange(6)).reshape(6, 4, 6, 4)
    tied = np.abs(P).max(axis=(1, 3)) > 0
    np.testing.assert_array_equal(tied, np.kron(np.eye(3), np.ones((2, 2))))


def test_room_for_all_is_exact():
    rng, n = np.random.default_rng(5), 12
    exact, close = JointKalmanFilter(), JointKalmanFilter(max_component=n)
    for estimator in (exact, close):
        estimator.add(np.arange(n), np.zeros((n, 4)), np.tile(np.eye(4), (n, 1, 1)))
    for _ in range(8):
        transition = discretise(chain(rng.uniform(0.0, 2.0, n - 1)), 0.2)
        z = rng.normal(size=(n, 2))
        for estimator in (exact, close):
            estimator.predict(transition)
            estimator.update(Measurements(np.arange(n), z, np.eye(2, 4), 0.1 * np.eye(2)))
    np.testing.assert_allclose(close.joint_covariance(np.arange(n)), exact.joint_covariance(np.arange(n)), atol=1e-10)
    np.testing.assert_allclose(close.joint_mean(np.arange(n)), exact.joint_mean(np.arange(n)), atol=1e-10)
