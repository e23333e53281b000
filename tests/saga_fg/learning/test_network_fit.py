"""Training of edge networks with JAX."""

import dataclasses

import numpy as np
import pytest

from saga_fg.learning import GapSettings, filter_independently, gap_errors, predict_gaps, sample_gaps
from saga_fg.learning.interaction_fit import predict_with
from saga_fg.learning.network_fit import fit_networks, network_loss, network_template
from saga_fg.model.edge_features import EdgeEnds, edge_features
from saga_fg.model.edge_network import edge_rates, messages
from tests.saga_fg.following_pairs import following_pairs

jax = pytest.importorskip("jax", reason="the extra [learn] is not installed")
ravel_pytree = pytest.importorskip("jax.flatten_util").ravel_pytree


def sample_of(pairs=2, moments=60, seed=0, longest=1.0):
    trajectories = following_pairs(pairs, moments, seed)
    filtered = filter_independently(trajectories, np.full(len(trajectories.label), 1.5), 0.005)
    return sample_gaps(trajectories, filtered, ("car",), GapSettings(longest=longest, neighbours=3))


def test_numpy_computes_the_rates_that_jax_does():
    rng = np.random.default_rng(0)

    def ends(*shape):
        moved = rng.integers(0, 2, shape).astype(float)
        return EdgeEnds(rng.normal(0, 20, (*shape, 2)), rng.normal(0, 5, (*shape, 2)), rng.normal(0, 3, shape), moved)

    target, source = ends(6, 1), ends(6, 4)
    weights = network_template(("car",), seed=1)[0].weights()

    def rates(xp):
        message = messages(weights, edge_features(target, source, xp), xp)
        return np.asarray(edge_rates(weights, message, message.mean(axis=1)[:, None], 3.0, xp))

    with jax.enable_x64(True):
        np.testing.assert_allclose(rates(np), rates(jax.numpy), atol=1e-6)
    np.testing.assert_allclose(rates(np), rates(jax.numpy), atol=1e-3)


def test_the_gradient_is_that_of_finite_differences():
    sample = sample_of(longest=0.5)
    sample = sample.select(np.arange(min(len(sample), 6)))
    networks = network_template(("car",), hidden=2, seed=2)
    with jax.enable_x64(True):
        loss = network_loss(networks, sample, np.zeros(len(sample), dtype=int), 0.01, jax)
        loss_and_slope = jax.jit(jax.value_and_grad(loss))
        start = {
            "weights": [{k: jax.numpy.asarray(v) for k, v in network.weights().items()} for network in networks],
            "log_noise": jax.numpy.zeros(1),
            "explained": jax.numpy.asarray(-1.0),
        }
        _, gradient = loss_and_slope(start)
        flat, rebuild = ravel_pytree(start)
        slope, _ = ravel_pytree(gradient)
        direction = np.random.default_rng(0).normal(size=len(flat))
        h = 1e-6
        ahead, behind = (float(loss_and_slope(rebuild(flat + sign * h * direction))[0]) for sign in (1, -1))
        assert float(slope @ direction) == pytest.approx((ahead - behind) / (2 * h), rel=1e-4)


def test_a_trained_network_predicts_other_recordings_better():
    train, other = (sample_of(4, 100, seed, longest=0.5) for seed in (1, 2))
    template = network_template(("car",), hidden=3)[:1]
    fitted = fit_networks(train, 0.005, {"default": 0.3}, template, epochs=30)
    network = fitted.rules[0]
    assert dataclasses.replace(network) == network  # plain numbers: comparable, and fit for a file
    learned = gap_errors(other, predict_with(other, fitted))[:, -1]
    alone = gap_errors(other, predict_gaps(other, lambda _features, _seen: [], 0.3, 0.0))[:, -1]
    assert np.nanmean(learned) < 0.95 * np.nanmean(alone)
