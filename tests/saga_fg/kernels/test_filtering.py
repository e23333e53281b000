"""The joint Kalman filter where numbers are hard, and partitions of its state."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg.errors import InputError
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.estimators.partition import Partition, StateLayout, flattened, regrouped, unflattened, zeros


def played(scenario, bounds):
    """A filter after each call of a scenario, and the log-likelihoods of its updates."""
    estimator, likelihoods = JointKalmanFilter(**bounds), []
    for name, *arguments in scenario.calls:
        if name == "update":
            likelihoods.append(estimator.update(arguments[0]))
        else:
            getattr(estimator, name)(*arguments)
    return estimator, likelihoods


def test_measurements_that_are_far_better_than_what_was_known(subtests):
    """A correction that cancels is refined: the measured rows are those of the textbook."""
    for noise in [1e-3, 1e-9, 1e-14]:
        with subtests.test(noise=noise):
            estimator, z = JointKalmanFilter(), np.random.default_rng(1).normal(size=(4, 2))
            estimator.add(np.arange(5), np.zeros((5, 4)), np.tile(np.diag([1e4, 1e4, 10.0, 10.0]) + 2.0, (5, 1, 1)))
            estimator.update(Measurements([0, 1, 4, 3], z, np.eye(2, 4), noise * np.eye(2)))
            np.testing.assert_allclose(estimator.mean([0, 1, 4, 3])[:, :2], z, atol=1e-4 * noise**0.5 + 1e-9)
            measured = np.diagonal(estimator.covariance([0, 1, 4, 3]), axis1=1, axis2=2)
            np.testing.assert_allclose(measured[:, :2], noise, rtol=1e-3)
            assert (measured > 0).all()


def test_noise_lost_in_rounding_is_an_error():
    estimator = JointKalmanFilter()
    estimator.add([1], np.zeros((1, 2)), 1e20 * np.eye(2)[None])
    row = np.array([[1.0, 0.0], [1.0, 0.0]])
    measurements = Measurements([1], np.zeros((1, 2)), row, 1e-3 * np.eye(2))
    with pytest.raises(InputError, match="lost in the rounding"):
        estimator.update(measurements)


def dense(blocks, partition):
    """The whole matrix (D, D) of blocks."""
    matrix = np.zeros((partition.layout.size, partition.layout.size))
    for places, of_group in zip(partition.groups, blocks, strict=True):
        for at, block in zip(places, of_group, strict=True):
            matrix[np.ix_(at, at)] = block
    return matrix


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_partitions_and_what_is_regrouped_over_them(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 9))
    layout = StateLayout(np.arange(n), rng.choice([1, 2, 4, 6], n))
    labels = [np.unique(rng.integers(0, max(n, 1), n), return_inverse=True)[1] for _ in range(2)]
    old, new = (Partition(layout, label.astype(np.int64)) for label in labels)
    blocks = [rng.normal(size=block.shape) for block in zeros(old)]
    source = rng.integers(-1, n, n) if n else np.empty(0, dtype=np.int64)
    alike = source < 0
    alike |= layout.dims[np.maximum(source, 0)] == layout.dims
    source = np.where(alike, source, -1)
    result = regrouped(tuple(blocks), old, new, source)
    given_entries, entries = dense(tuple(blocks), old), dense(result, new)
    for i in range(n):
        for j in range(n):
            if new.label[i] != new.label[j]:
                continue
            part = entries[
                new.layout.offsets[i] : new.layout.offsets[i + 1], new.layout.offsets[j] : new.layout.offsets[j + 1]
            ]
            k, m = source[i], source[j]
            if k < 0 or m < 0 or old.label[k] != old.label[m]:
                assert not part.any()
            else:
                a, b = (slice(*old.layout.offsets[row : row + 2]) for row in (k, m))
                np.testing.assert_array_equal(part, given_entries[a, b])
    for one, other in zip(unflattened(flattened(result), new), result, strict=True):
        np.testing.assert_array_equal(one, other)
