"""Training of edge networks through the differentiable prediction of gaps, with JAX on the CPU (extra [learn]).

One `EdgeNetwork` each for following, shared course and shared velocity, trained together by Adam (Kingma and Ba, ICLR
2015) on the likelihood of `gap_prediction`, with the process noise of each class and the explained noise. Rates stay
between 0 and `max_rate` by construction. Inference needs NumPy alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from saga_fg.errors import InputError, MissingExtraError
from saga_fg.learning.gap_prediction import Coupling, negative_log_likelihood, predict_gaps
from saga_fg.learning.gaps import GapSample
from saga_fg.learning.interaction_fit import FittedInteractions, acting_classes, thinned
from saga_fg.model.edge_features import EdgeFeatures
from saga_fg.model.edge_network import FEATURES, EdgeNetwork
from saga_fg.model.interactions import CarFollowing, SharedCourse, SharedVelocity
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.by_class import DEFAULT

HIDDEN = 8  # entries of a message
EPOCHS = 150
LEARNING_RATE = 0.03
DECAY = 1e-3  # weight of the squared weights in the loss
Weights = dict[str, Any]


def network_template(classes: tuple[str, ...], hidden: int = HIDDEN, seed: int = 0) -> tuple[EdgeNetwork, ...]:
    """Untrained networks between objects of some classes, whose rates are low."""
    rng = np.random.default_rng(seed)
    found = []
    for interaction, ahead_only in (
        (CarFollowing(time_constant=math.inf), True),
        (SharedCourse(), True),
        (SharedVelocity(), False),
    ):
        weights = {
            "edge_weights": rng.normal(0, 1 / math.sqrt(FEATURES), (hidden, FEATURES)),
            "edge_bias": np.zeros(hidden),
            "node_weights": rng.normal(0, 1 / math.sqrt(hidden), (hidden, hidden)),
            "output_weights": rng.normal(0, 0.3, 2 * hidden),
            "output_bias": np.float64(-3.0),
        }
        found.append(_with(EdgeNetwork(interaction, ahead_only=ahead_only, classes=classes), weights))
    return tuple(found)


def fit_networks(
    sample: GapSample,
    position_noise: float,
    acceleration_noise: Mapping[str, float],
    template: Sequence[EdgeNetwork] | None = None,
    epochs: int = EPOCHS,
) -> FittedInteractions:
    """The networks that make the reappearances most likely; see `fit_interactions` for the arguments.

    Raises `MissingExtraError` without JAX, `InputError` for a sample without gaps.
    """
    if len(sample) == 0:
        raise InputError("sample: expected at least one object that is followed for long enough")
    jax, jnp = _jax()
    sample = thinned(sample)
    classes = tuple(np.unique(sample.label).tolist())
    networks = network_template(classes) if template is None else tuple(template)
    class_of = np.searchsorted(np.array(classes), sample.label)
    noise = [acceleration_noise.get(c, acceleration_noise[DEFAULT]) for c in classes]
    with jax.enable_x64(True):
        start = {
            "weights": [{k: jnp.asarray(v) for k, v in network.weights().items()} for network in networks],
            "log_noise": jnp.log(jnp.asarray(noise)),
            "explained": jnp.asarray(-2.0),
        }
        value_and_gradient = jax.jit(jax.value_and_grad(network_loss(networks, sample, class_of, position_noise, jax)))
        found, loss = _adam(value_and_gradient, start, epochs, jax)
        weights = jax.tree.map(np.asarray, found["weights"])
        q, explained = np.exp(np.asarray(found["log_noise"])), float(jax.nn.softplus(found["explained"]))
    own = {label: float(value) for label, value in zip(classes, q, strict=True)}
    rules = tuple(_with(network, values) for network, values in zip(networks, weights, strict=True))
    return FittedInteractions(rules, {**own, DEFAULT: float(np.exp(np.log(q).mean()))}, min(explained, 3.0), loss)


def network_loss(
    networks: Sequence[EdgeNetwork], sample: GapSample, class_of: Any, position_noise: float, jax: Any
) -> Any:
    """The loss as a function of {"weights", "log_noise", "explained"} that JAX can differentiate."""
    jnp = jax.numpy
    able = [acting_classes(network.classes, sample) for network in networks]

    def loss(parameters: dict[str, Any]) -> Any:
        q = jnp.exp(parameters["log_noise"])[class_of]

        def couple(features: EdgeFeatures, seen: Any) -> list[Coupling]:
            parts = zip(networks, parameters["weights"], able, strict=True)
            return [
                Coupling(net.interaction, net.candidate_rates(weights, features, mask & (seen > 0), jnp))
                for net, weights, mask in parts
            ]

        prediction = predict_gaps(sample, couple, q, jax.nn.softplus(parameters["explained"]), jnp)
        size = sum((w**2).sum() for values in parameters["weights"] for k, w in values.items() if "weights" in k)
        return negative_log_likelihood(sample, prediction, position_noise, jnp) + DECAY * size

    return loss


def _adam(value_and_gradient: Any, start: Any, epochs: int, jax: Any) -> tuple[Any, float]:
    """The parameters after some epochs, and the loss of the last."""
    x, loss = start, math.nan
    m = jax.tree.map(lambda a: 0.0 * a, start)
    v = m
    for t in range(1, epochs + 1):
        value, gradient = value_and_gradient(x)
        loss = float(value)
        m = jax.tree.map(lambda a, g: 0.9 * a + 0.1 * g, m, gradient)
        v = jax.tree.map(lambda a, g: 0.99 * a + 0.01 * g * g, v, gradient)
        m_scale, v_scale = 1 / (1 - 0.9**t), 1 / (1 - 0.99**t)
        x = jax.tree.map(
            lambda a, p, s, mk=m_scale, vk=v_scale: a - LEARNING_RATE * p * mk / ((s * vk) ** 0.5 + 1e-8), x, m, v
        )
    return x, loss


def _with(network: EdgeNetwork, weights: Mapping[str, Any]) -> EdgeNetwork:

    def rows(value: FloatArray) -> Any:
        return tuple(map(tuple, value.tolist())) if np.ndim(value) == 2 else tuple(value.tolist())

    return replace(
        network,
        output_bias=float(weights["output_bias"]),
        **{name: rows(np.asarray(value)) for name, value in weights.items() if name != "output_bias"},
    )


def _jax() -> tuple[Any, Any]:
    try:
        import jax
        import jax.numpy as jnp
    except ImportError as error:
        raise MissingExtraError("training a network needs JAX: pip install 'saga-fg[learn]'") from error
    return jax, jnp
