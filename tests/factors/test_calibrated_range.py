"""Ranges of an uncalibrated device: Jacobians, the plain range factor as a special case, what is refused."""

import gtsam
import numpy as np
import pytest

from factors import FactorError, PlanarPose, Robust, Vector, calibrated_range_factors, range_factor
from factors.manifolds import central_differences

SEEDS = range(4)


def example(seed, calibration=None):
    rng = np.random.default_rng(seed)
    keys = rng.permutation(20)[:3].tolist()
    states = [gtsam.Pose2(*rng.normal(0, 9, 2), rng.uniform(-3, 3)), rng.normal(0, 9, 2)]
    states.append(rng.normal(0, 0.1, 2) if calibration is None else np.asarray(calibration))
    values = gtsam.Values()
    for key, state in zip(keys, states, strict=True):
        values.insert(key, state)
    return keys, states, values


@pytest.mark.parametrize("seed", SEEDS)
def test_jacobians_are_those_of_central_differences(seed):
    keys, states, _ = example(seed)
    factors = calibrated_range_factors([keys], [7.0], 0.25)
    kinds = (PlanarPose(), Vector(2), Vector(2))

    def residual(*moved):
        return factors.residual(*(kind.array(state)[None] for kind, state in zip(kinds, moved, strict=True)))[0]  # type: ignore[attr-defined]

    expected = central_differences(residual, states, kinds)
    stacked = [kind.array(state)[None] for kind, state in zip(kinds, states, strict=True)]  # type: ignore[attr-defined]
    for got, wanted in zip(factors.jacobians(*stacked), expected, strict=True):
        np.testing.assert_allclose(got[0], wanted, atol=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_without_scale_and_offset_it_is_the_plain_range(seed):
    keys, _, values = example(seed, calibration=[0.0, 0.0])
    plain = range_factor(keys[0], keys[1], 7.0, 0.25, planar=True)
    assert calibrated_range_factors([keys], [7.0], 0.25).error(values) == pytest.approx(plain.error(values))


def test_a_perfect_range_costs_nothing():
    keys, (pose, beacon, _), values = example(0, calibration=[0.07, 0.2])
    distance = 1.07 * np.hypot(*(beacon - pose.translation())) + 0.2
    assert calibrated_range_factors([keys], [distance], 0.25, Robust("cauchy", 2.0)).error(values) < 1e-18


def test_a_pose_at_its_beacon_is_explained():
    keys, (pose, *_), values = example(0)
    values.update(keys[1], pose.translation())
    with pytest.raises(FactorError, match="at its beacon"):
        calibrated_range_factors([keys], [1.0], 0.25).linearise(values)
