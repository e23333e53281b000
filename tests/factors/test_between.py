"""Between and prior factors: GTSAM's residuals, and nothing that would crash it gets in."""

from __future__ import annotations

from itertools import product

import gtsam
import numpy as np
import pytest

from factors import FactorError, Robust, between_factor, noise_model, pose, pose_prior_factor


def transforms(dim: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    kind = gtsam.Pose2 if dim == 2 else gtsam.Pose3
    return [kind.Expmap(rng.normal(size=3 * (dim - 1))).matrix() for _ in range(3)]


def test_the_residual_is_that_of_the_equation(covariance, subtests):
    for dim, seed in product([2, 3], range(4)):
        with subtests.test(dim=dim, seed=seed):
            first, second, measured = transforms(dim, seed)
            P = covariance(np.random.default_rng(seed), 3 * (dim - 1))
            values = gtsam.Values()
            values.insert(9, pose("first", first))
            values.insert(2, pose("second", second))
            log = gtsam.Pose2.Logmap if dim == 2 else gtsam.Pose3.Logmap
            r = log(pose("r", np.linalg.inv(measured) @ np.linalg.inv(first) @ second))
            assert between_factor(9, 2, measured, P).error(values) == pytest.approx(0.5 * r @ np.linalg.solve(P, r))
            r = log(pose("r", np.linalg.inv(measured) @ first))
            assert pose_prior_factor(9, measured, P).error(values) == pytest.approx(0.5 * r @ np.linalg.solve(P, r))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_jacobians_are_those_of_central_differences(dim, seed, covariance):
    first, second, measured = transforms(dim, seed)
    k = 3 * (dim - 1)
    factor = between_factor(9, 2, measured, covariance(np.random.default_rng(seed), k))
    values = gtsam.Values()
    values.insert(9, pose("first", first))
    values.insert(2, pose("second", second))
    A, _ = factor.linearize(values).jacobian()
    columns = {int(key): A[:, i * k : (i + 1) * k] for i, key in enumerate(factor.keys())}
    for key in (9, 2):
        for i in range(k):
            ends = []
            for sign in (1, -1):
                step = gtsam.VectorValues()
                for other in (9, 2):
                    step.insert(other, sign * 1e-6 * np.eye(k)[i] * (other == key))
                ends.append(factor.whitenedError(values.retract(step)))  # type: ignore[attr-defined]
            np.testing.assert_allclose(columns[key][:, i], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_a_robust_loss_is_gtsams():
    values = gtsam.Values()
    values.insert(1, gtsam.Pose2())
    values.insert(2, gtsam.Pose2(10, 0, 0))
    factor = between_factor(1, 2, np.eye(3), np.eye(3), Robust("huber", 1.0))
    assert factor.error(values) == pytest.approx(10 - 0.5)


def test_what_would_crash_gtsam_is_refused(subtests):
    for arguments, message in [
        ((1, 1, np.eye(3), np.eye(3)), "occurs twice"),
        ((1, 2, np.eye(5), np.eye(3)), "3 x 3 or 4 x 4"),
        ((1, 2, 2 * np.eye(4), np.eye(6)), "rigid"),
        ((1, 2, np.eye(4) * np.nan, np.eye(6)), "finite"),
        ((1, 2, np.eye(4), np.eye(3)), "covariance: expected shape"),
        ((1, 2, np.eye(3), -np.eye(3)), "positive definite"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            between_factor(*arguments)


def test_noise_models_keep_correlations():
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(noise_model("P", P, 2).covariance(), P)
