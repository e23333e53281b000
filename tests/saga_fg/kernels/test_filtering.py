"""The joint Kalman filter by kernels and by NumPy: the same numbers, whatever happens to it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from saga_fg.errors import InputError
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.partition import Partition, flattened, regrouped, unflattened, zeros
from saga_fg.kernels.compilation import only_numpy
from tests.saga_fg.estimator_scenario import random_scenario


def played(scenario, bounds):
    """A filter after each call of a scenario, and the log-likelihoods of its updates."""
    estimator, likelihoods = JointKalmanFilter(**bounds), []
    for name, *arguments in scenario.calls:
        if name == "update":
            likelihoods.append(estimator.update(arguments[0]))
        else:
            getattr(estimator, name)(*arguments)
    return estimator, likelihoods


@given(
    st.integers(0, 10_000),
    st.sampled_from([{}, {"tolerance": 0.02}, {"tolerance": 0.1}, {"most": 3}, {"tolerance": 0.01, "most": 1}]),
)
@settings(max_examples=40, deadline=None)
def test_a_scenario_of_mixed_nodes(seed, bounds):
    scenario = random_scenario(np.random.default_rng(seed), frames=6)
    compiled, by_kernels = played(scenario, bounds)
    with only_numpy():
        plain, by_numpy = played(scenario, bounds)
    nodes = plain.nodes
    assert compiled.nodes.tolist() == nodes.tolist()
    np.testing.assert_allclose(by_kernels, by_numpy, rtol=1e-8, atol=1e-8)
    x, y = compiled.posterior(), plain.posterior()
    assert x.partition.label.tolist() == y.partition.label.tolist()
    scale = np.sqrt(np.diag(plain.joint_covariance(nodes)))
    assert (np.abs(x.mean - y.mean) <= 1e-9 * (1 + scale)).all()
    apart = np.abs(compiled.joint_covariance(nodes) - plain.joint_covariance(nodes))
    assert (apart <= 1e-9 * scale[:, None] * scale).all()


@pytest.mark.parametrize("noise", [1e-3, 1e-9, 1e-14])
def test_measurements_that_are_far_better_than_what_was_known(noise):
    """A correction that cancels is refined alike."""
    rng, found = np.random.default_rng(1), []
    P = np.tile(np.diag([1e4, 1e4, 10.0, 10.0]) + 2.0, (5, 1, 1))
    z = rng.normal(size=(4, 2))
    for numpy_alone in (False, True):
        estimator = JointKalmanFilter()
        estimator.add(np.arange(5), np.zeros((5, 4)), P)
        measurements = Measurements([0, 1, 4, 3], z, np.eye(2, 4), noise * np.eye(2))
        if numpy_alone:
            with only_numpy():
                estimator.update(measurements)
        else:
            estimator.update(measurements)
        found.append(estimator)
    one, other = found
    scale = np.sqrt(np.diagonal(other.covariance(np.arange(5)), axis1=1, axis2=2))
    assert (np.abs(one.mean(np.arange(5)) - other.mean(np.arange(5))) < 1e-4 * scale + 1e-9).all()
    assert (np.diagonal(one.covariance(np.arange(5)), axis1=1, axis2=2) > 0).all()


def test_noise_lost_in_rounding_is_the_same_error():
    estimator = JointKalmanFilter()
    estimator.add([1], np.zeros((1, 2)), 1e20 * np.eye(2)[None])
    row = np.array([[1.0, 0.0], [1.0, 0.0]])
    measurements = Measurements([1], np.zeros((1, 2)), row, 1e-3 * np.eye(2))
    with pytest.raises(InputError, match="lost in the rounding"):
        estimator.update(measurements)
    with only_numpy(), pytest.raises(InputError, match="lost in the rounding"):
        estimator.update(measurements)


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
    with only_numpy():
        plain_old, plain_new = (Partition(layout, label.astype(np.int64)) for label in labels)
        expected = regrouped(tuple(blocks), plain_old, plain_new, source)
        for mine, theirs in ((old, plain_old), (new, plain_new)):
            assert mine.group.tolist() == theirs.group.tolist()
            assert mine.row.tolist() == theirs.row.tolist()
            assert mine.offset.tolist() == theirs.offset.tolist()
            assert [places.tolist() for places in mine.groups] == [places.tolist() for places in theirs.groups]
    assert len(result) == len(expected)
    for one, other in zip(result, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(unflattened(flattened(result), new), result, strict=True):
        np.testing.assert_array_equal(one, other)
