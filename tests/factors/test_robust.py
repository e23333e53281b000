"""Robust losses against GTSAM's, and against their own definition."""

import gtsam
import numpy as np
import pytest

from factors import FactorError, Mixture, Robust

LOSSES = ["huber", "cauchy", "geman-mcclure", "tukey"]
DISTANCES = np.array([0.0, 0.1, 0.999, 1.7, 1.70001, 5.0, 1e3])


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("scale", [0.3, 1.7])
def test_cost_and_weight_are_gtsams(loss, scale):
    robust = Robust(loss, scale)
    model = robust.model(gtsam.noiseModel.Unit.Create(1))
    theirs = [(model.loss(s * s), model.weight(np.array([s]))) for s in DISTANCES]
    np.testing.assert_allclose(robust.cost(DISTANCES), [cost for cost, _ in theirs], rtol=1e-12)
    np.testing.assert_allclose(robust.weight(DISTANCES), [weight for _, weight in theirs], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("loss", LOSSES)
def test_weight_is_slope_over_distance(loss):
    robust = Robust(loss, 1.5)
    s = np.linspace(0.01, 6.0, 200) + 1e-4
    h = 1e-6
    slope = (robust.cost(s + h) - robust.cost(s - h)) / (2 * h)
    np.testing.assert_allclose(robust.weight(s) * s, slope, atol=1e-8)


@pytest.mark.parametrize("loss", LOSSES)
def test_small_residuals_cost_what_they_always_do(loss):
    s = np.array([1e-4, 1e-3])
    np.testing.assert_allclose(Robust(loss, 2.0).cost(s), s * s / 2, rtol=1e-5)


def test_bad_loss_is_refused(subtests):
    for loss, scale in [("l1", 1.0), ("huber", 0.0), ("huber", -1.0), ("tukey", np.nan)]:
        with subtests.test(loss=loss, scale=scale), pytest.raises(FactorError):
            Robust(loss, scale)


def test_a_mixture_holds_with_its_probability():
    s = np.linspace(0.01, 6.0, 200) + 1e-4
    for probability in (0.05, 0.5, 0.99):
        mixture, h = Mixture(probability), 1e-6
        slope = (mixture.cost(s + h) - mixture.cost(s - h)) / (2 * h)
        np.testing.assert_allclose(mixture.weight(s) * s, slope, atol=1e-8)
        assert mixture.weight(0.0) == pytest.approx(probability)
        assert mixture.weight(20.0) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(Mixture(1.0).cost(s), s * s / 2)
    assert not Mixture(0.0).weight(s).any()
    each = Mixture([0.2, 0.9])
    np.testing.assert_allclose(each.weight([1.0, 1.0]), [Mixture(p).weight(1.0) for p in (0.2, 0.9)])
    for bad in (-0.1, 1.1, np.nan):
        with pytest.raises(FactorError, match="probability"):
            Mixture(bad)
