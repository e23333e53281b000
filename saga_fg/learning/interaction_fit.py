"""Rates, kernel widths and process noise of edge rules by the likelihood of innovations after gaps.

The parameters are the logarithms of rates and widths within fixed bounds, so that rates stay positive and the dynamics
stable, the logarithm of each class's acceleration noise, and the explained noise. The objective (`gap_prediction`) is
maximised by L-BFGS-B with differences for derivatives; a weak Gaussian prior about the template decides where the
recordings do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize

from saga_fg.errors import InputError
from saga_fg.learning.gap_prediction import Coupling, GapPrediction, negative_log_likelihood, predict_gaps
from saga_fg.learning.gaps import GapSample
from saga_fg.model.edge_features import EdgeFeatures
from saga_fg.model.edge_network import EdgeNetwork
from saga_fg.model.edge_rules import VEHICLES, Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.nonlinear_interactions import AccelerationLaw
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.by_class import DEFAULT, class_numbers

Rule = Following | Neighbours
BOUNDS: Mapping[str, tuple[float, float]] = {
    "rate": (1e-3, 5.0),
    "distance_scale": (0.5, 100.0),
    "gap_scale": (3.0, 100.0),
    "lateral_scale": (0.3, 5.0),
    "heading_scale": (0.05, 3.0),
    "speed_scale": (0.1, 10.0),
}
"""Bounds of the rates and widths of rules; an infinite width stays infinite."""
NOISE_BOUNDS = (1e-4, 1e2)  # m^2/s^3
EXPLAINED_BOUNDS = (0.0, 3.0)  # s
PRIOR = 2e-2  # weight of a unit of squared difference from the template, against the mean over the gaps
FEWEST_GAPS = 30  # a class with fewer shares the noise of all that have fewer
MOST_GAPS = 500  # a random sample to learn from; more only take longer

ROAD_USERS = (*VEHICLES, "van", "tram", "cyclist")
_LED = Following(SharedVelocity(), rate=2.0, gap_scale=16.0, lateral_scale=1.2, classes=ROAD_USERS, leaders="moving")
TEMPLATE: tuple[Rule, ...] = (
    _LED,
    replace(_LED, interaction=CarFollowing(time_constant=math.inf), rate=0.2, leaders="stationary"),
    Neighbours(
        rate=1.0,
        distance_scale=25.0,
        heading_scale=math.inf,
        speed_scale=1.0,
        max_distance=50.0,
        max_degree=8,
        parked=True,
        classes=ROAD_USERS,
    ),
    Neighbours(
        rate=0.1,
        distance_scale=1.5,
        heading_scale=math.inf,
        speed_scale=0.5,
        max_distance=6.0,
        min_speed=0.2,
        classes=("pedestrian",),
    ),
)
"""Following a moving leader in speed and course; halting behind a stationary one; parked objects, which share errors of
the pose; groups of people."""


@dataclass(frozen=True, eq=False)
class RuleParameters:
    """n parameters of some rules: `names` tell rule and setting of each, `start` (n,) logarithms, `bounds` of these."""

    rules: tuple[Rule, ...]
    names: tuple[tuple[int, str], ...]
    start: FloatArray
    bounds: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, rules: Sequence[Rule]) -> Self:
        """All rates and widths that are finite, clipped to their bounds."""
        names = tuple(
            (k, name) for k, rule in enumerate(rules) for name in BOUNDS if math.isfinite(getattr(rule, name, math.inf))
        )
        bounds = tuple((math.log(BOUNDS[name][0]), math.log(BOUNDS[name][1])) for _, name in names)
        values = [math.log(max(getattr(rules[k], name), 1e-9)) for k, name in names]
        return cls(tuple(rules), names, np.clip(values, *np.array(bounds).reshape(-1, 2).T), bounds)

    def valued(self, x: FloatArray) -> list[Rule]:
        """The rules with parameters x (n,)."""
        values: list[dict[str, Any]] = [{} for _ in self.rules]
        for (k, name), value in zip(self.names, np.exp(x), strict=True):
            values[k][name] = float(value)
        return [replace(rule, **changes) for rule, changes in zip(self.rules, values, strict=True)]


@dataclass(frozen=True)
class FittedInteractions:
    """rules with their values; acceleration_noise by class, m^2/s^3; explained_noise, s; loss per moment."""

    rules: tuple[Following | Neighbours | EdgeNetwork, ...]
    acceleration_noise: dict[str, float]
    explained_noise: float
    loss: float


def couple_rules(
    rules: Sequence[Rule | EdgeNetwork], sample: GapSample
) -> Callable[[EdgeFeatures, FloatArray], list[Coupling]]:
    """The rates of rules for the neighbours of a sample, as `predict_gaps` takes them."""
    able = [acting_classes(rule.classes, sample) for rule in rules]

    def couple(features: EdgeFeatures, seen: FloatArray) -> list[Coupling]:
        found = []
        for rule, mask in zip(rules, able, strict=True):
            if isinstance(rule, EdgeNetwork):
                found.append(
                    Coupling(rule.interaction, rule.candidate_rates(rule.weights(), features, mask & (seen > 0)))
                )
                continue
            if isinstance(rule.interaction, AccelerationLaw):
                raise InputError("edges: expected linear interactions to be learned, got nonlinear ones")
            there = mask & (seen > 0)
            rate = np.where(there, rule.strength(features), 0.0)
            if isinstance(rule, Following):
                remoteness = np.where(there & rule.in_lane(features), rule.remoteness(features), np.inf)
                rate = np.where(remoteness <= remoteness.min(axis=1, keepdims=True), rate, 0.0)
            found.append(Coupling(rule.interaction, rate))
        return found

    return couple


def predict_with(sample: GapSample, fitted: FittedInteractions) -> GapPrediction:
    """Coast through gaps with fitted interactions."""
    noise = class_numbers(fitted.acceleration_noise, float, sample.label)
    return predict_gaps(sample, couple_rules(fitted.rules, sample), noise, fitted.explained_noise)


def fit_interactions(
    sample: GapSample,
    position_noise: float,
    acceleration_noise: Mapping[str, float],
    template: Sequence[Rule] = TEMPLATE,
    iterations: int = 15,
) -> FittedInteractions:
    """The most likely values of the template's rules, from gaps in recordings.

    position_noise      standard deviation of the measured positions, m
    acceleration_noise  by class, with `default`: where the search begins

    Rules whose classes do not occur are left out. Raises `InputError` for a sample without gaps.
    """
    if len(sample) == 0:
        raise InputError("sample: expected at least one object that is followed for long enough")
    sample = thinned(sample)
    rules = [rule for rule in template if acting_classes(rule.classes, sample).any()]
    parameters = RuleParameters.of(rules)
    m = len(parameters.start)
    labels, count = np.unique(sample.label, return_counts=True)
    own = [str(label) for label in labels[count >= FEWEST_GAPS]]
    classes = [*own, DEFAULT]
    class_of = np.array([classes.index(c) if c in own else len(own) for c in sample.label.tolist()])
    noise = [acceleration_noise.get(c, acceleration_noise[DEFAULT]) for c in classes]
    bounds = [*parameters.bounds, *[tuple(np.log(NOISE_BOUNDS))] * len(classes), EXPLAINED_BOUNDS]
    start = np.clip(np.concatenate([parameters.start, np.log(noise), [0.0]]), *np.array(bounds).T)

    def loss(x: FloatArray) -> float:
        q = np.exp(x[m:-1])[class_of]
        prediction = predict_gaps(sample, couple_rules(parameters.valued(x[:m]), sample), q, x[-1])
        prior = PRIOR * ((x[:m] - start[:m]) ** 2).sum()
        return float(negative_log_likelihood(sample, prediction, position_noise) + prior)

    found = minimize(loss, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations, "eps": 1e-3})
    q = np.exp(found.x[m:-1])
    return FittedInteractions(
        tuple(parameters.valued(found.x[:m])),
        {label: float(value) for label, value in zip(classes, q, strict=True)},
        float(found.x[-1]),
        float(found.fun),
    )


def acting_classes(classes: tuple[str, ...], sample: GapSample) -> BoolArray:
    """(W, M) whether both ends of an edge are of these classes."""
    return np.asarray(np.isin(sample.label, classes)[:, None] & np.isin(sample.other_label, classes))


def thinned(sample: GapSample) -> GapSample:
    """At most `MOST_GAPS` gaps, a reproducible choice."""
    return sample.sampled(MOST_GAPS, seed=0)
