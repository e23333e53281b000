"""Rates, kernel widths and process noise of edge rules by the likelihood of objects in view.

The likelihood is that of the joint filter (`joint_view`), with all correlations between the objects: of every position,
given all before. Neither unknown velocities nor neighbours that react bias it, as they do that of places where objects
reappear (`interaction_fit`). But it is Gaussian, costs a run of the filter for each trial, and weighs the next
moment, not the next seconds. The parameters are those of `interaction_fit`, with independent normal priors about the
template, of standard deviation one in their logarithms. How many edges a node keeps, `max_degree` of neighbours, is no
number to go downhill in: the values in question are tried, and the fewest edges are taken that are as likely as any.
(In the clean view of recordings more of them do no harm. In a tracker they lead to false tracks, too.)

Interactions stay where they explain more than as many parameters would by chance: by the Bayesian information criterion

    log L(interactions) - log L(independent objects) > m / 2 log N

with m rates and widths, and N positions (Schwarz, Estimating the Dimension of a Model, Annals of Statistics 6, 1978).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from benchmarks.independent_filter import filter_independently
from benchmarks.joint_view import JointView
from saga_fg.errors import InputError
from saga_fg.learning.interaction_fit import Rule, RuleParameters
from saga_fg.model.edge_rules import Neighbours
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.labelled_objects import LabelledObjects

NOISE_BOUNDS = (1e-4, 1e2)  # m^2/s^3
EXPLAINED_BOUNDS = (0.0, 3.0)  # s


@dataclass(frozen=True)
class FittedInView:
    """rules with their values; acceleration_noise by class, m^2/s^3; explained_noise, s; loss by position."""

    rules: tuple[Rule, ...]
    acceleration_noise: dict[str, float]
    explained_noise: float
    loss: float


def fit_interactions_in_view(
    recordings: Sequence[LabelledObjects],
    position_noise: float,
    acceleration_noise: Mapping[str, float],
    template: Sequence[Rule],
    degrees: Sequence[int] = (),
    iterations: int = 15,
) -> FittedInView:
    """The most likely values of the template's rules, from how objects in view move; no rules if they explain nothing.

    position_noise      standard deviation of the positions, m
    acceleration_noise  by class, with `default`: where the search begins; each entry is a parameter
    degrees             smaller values of `max_degree` to try for the template's `Neighbours`

    Raises `InputError` for recordings in which no object is seen twice.
    """
    views = _Views(recordings, position_noise, acceleration_noise)
    own = RuleParameters.of(template)
    x = views.likeliest(own, views.start(own), iterations)
    tried = [*(RuleParameters.of(_of_degree(template, k)) for k in sorted(degrees)), own]
    logs = [views.log_likelihood(parameters, x)[0] for parameters in tried]
    fewest = next(k for k, log in enumerate(logs) if log > max(logs) - 1)  # as likely as any, to a factor of e
    chosen = tried[fewest]
    if logs[fewest] > logs[-1]:
        x = views.likeliest(chosen, x, iterations)
    alone = RuleParameters.of(())
    x_alone = views.likeliest(alone, views.start(alone), iterations)
    explained, count = views.log_likelihood(chosen, x)
    by_chance = len(chosen.start) / 2 * math.log(count)
    if explained - views.log_likelihood(alone, x_alone)[0] <= by_chance:
        chosen, x = alone, x_alone
    rules = tuple(chosen.valued(x[: len(chosen.start)]))
    return FittedInView(rules, views.noise(chosen, x), float(x[-1]), views.loss(chosen, x))


class _Views:
    """Likelihood of recordings given parameters x: those of rules, log noise of each class, explained noise."""

    def __init__(
        self, recordings: Sequence[LabelledObjects], position_noise: float, acceleration_noise: Mapping[str, float]
    ) -> None:
        self._position_noise, self._noise = position_noise, dict(acceleration_noise)
        self._recordings = []
        for trajectories in recordings:
            of_class = [self._noise.get(c, self._noise[DEFAULT]) for c in trajectories.label.tolist()]
            alone = filter_independently(trajectories, np.array(of_class), position_noise)
            self._recordings.append((trajectories, alone))

    def start(self, parameters: RuleParameters) -> FloatArray:
        noise = np.clip(np.log(list(self._noise.values())), *np.log(NOISE_BOUNDS))
        return np.concatenate([parameters.start, noise, [0.0]])

    def noise(self, parameters: RuleParameters, x: FloatArray) -> dict[str, float]:
        """Acceleration noise by class, m^2/s^3."""
        return dict(zip(self._noise, np.exp(x[len(parameters.start) : -1]).tolist(), strict=True))

    def log_likelihood(self, parameters: RuleParameters, x: FloatArray) -> tuple[float, int]:
        """Return the log-likelihood of all positions but the first of each object, and their number."""
        rules, q = parameters.valued(x[: len(parameters.start)]), self.noise(parameters, x)
        total, count = 0.0, 0
        for trajectories, alone in self._recordings:
            view = JointView(trajectories, alone, q, self._position_noise, rules, float(x[-1]))
            log, positions = view.log_likelihood()
            total, count = total + log, count + positions
        if count == 0:
            raise InputError("recordings: expected objects that are seen twice")
        return total, count

    def loss(self, parameters: RuleParameters, x: FloatArray) -> float:
        """The negative logarithm of likelihood and prior, by position."""
        log, count = self.log_likelihood(parameters, x)
        apart = x[: len(parameters.start)] - parameters.start
        return (0.5 * float(apart @ apart) - log) / count

    def likeliest(self, parameters: RuleParameters, x: FloatArray, iterations: int) -> FloatArray:
        """Downhill from x."""
        bounds = [*parameters.bounds, *[tuple(np.log(NOISE_BOUNDS))] * len(self._noise), EXPLAINED_BOUNDS]
        options = {"maxiter": iterations, "eps": 1e-3}
        found = minimize(lambda at: self.loss(parameters, at), x, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x)


def _of_degree(template: Sequence[Rule], degree: int) -> tuple[Rule, ...]:
    return tuple(replace(rule, max_degree=degree) if isinstance(rule, Neighbours) else rule for rule in template)
