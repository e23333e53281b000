r"""Rates and kernel widths of edge rules by the likelihood of the places at which hidden objects reappear.

    theta* = argmin_theta   mean over gaps and steps of  -log t_3( p - p_theta ; 0, c (P_theta + R) )  +  prior

p_theta and P_theta are the tracker's own prediction (`saga_fg.learning.hidden_objects`) on the base motion of its
configuration. Innovations after gaps have heavy tails, hence Student's t. How wide they are is a matter of the process
noise, which serves association as well and is left as it is: the scale c of each class is the most likely one, and is
not kept. The parameters are the logarithms of rates and widths within bounds, so that rates stay positive. The
objective is minimised by L-BFGS-B with differences for derivatives: one prediction of all gaps takes a fraction of a
second, and rules may be anybody's. A Gaussian prior about the template decides where the recordings do not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize

from saga_fg.errors import InputError
from saga_fg.learning.hidden_objects import GapPrediction, HiddenObjects
from saga_fg.model import CarFollowing, IntelligentDriver, Neighbours, traffic_rules
from saga_fg.numerics import FloatArray, StrArray
from saga_fg.tracking import TrackerSettings
from saga_fg.types import VEHICLES

Rule = Any
"""An edge rule whose settings `rate` and `..._scale` are learned where they are finite."""

BOUNDS: dict[str, tuple[float, float]] = {
    "rate": (1e-3, 5.0),
    "distance_scale": (0.5, 100.0),
    "gap_scale": (3.0, 100.0),
    "lateral_scale": (0.3, 5.0),
    "heading_scale": (0.05, 3.0),
    "speed_scale": (0.1, 10.0),
    "free_speed": (5.0, 60.0),
    "headway": (0.3, 4.0),
    "standstill_gap": (0.5, 8.0),
    "acceleration": (0.1, 4.0),
    "deceleration": (0.3, 6.0),
    "time_constant": (0.3, 30.0),
}
"""Bounds of parameters; an infinite one stays infinite. Others: a tenth to ten times the template's value."""
LAWS: dict[type, tuple[str, ...]] = {
    IntelligentDriver: ("free_speed", "headway", "standstill_gap", "acceleration", "deceleration"),
    CarFollowing: ("time_constant", "headway"),
}
"""Parameters of drivers' laws that are learned; the time constant of an `IntelligentDriver` scales its rate alone."""
PRIOR = 0.4  # weight of a unit of squared difference from the template, against the mean over the gaps
TAILS = 3.0  # degrees of freedom of the innovations
PLACE_DEVIATION = 0.1  # m, of labels
FEWEST = 30  # places of a class; classes with fewer share a scale
MOVED = 0.01  # m; edges that move a prediction by less do not reach it
MAX_GAPS = 300  # a random sample to learn from; more only take longer
MIN_GAIN = 1e-3  # nats a place, of an iteration; what is left below it, the differences hardly resolve

ROAD_USERS = (*VEHICLES, "van", "tram", "cyclist")
_LED = replace(traffic_rules()[0], classes=ROAD_USERS, information_gain=False)
TEMPLATE: tuple[Rule, ...] = (
    _LED,
    replace(_LED, interaction=CarFollowing(time_constant=math.inf), rate=0.5, leaders="stationary"),
    Neighbours(
        rate=0.5,
        distance_scale=1.5,
        heading_scale=math.inf,
        speed_scale=1.0,
        max_distance=6.0,
        min_speed=0.2,
        classes=("pedestrian",),
    ),
)
"""Following a moving leader in speed and course; halting behind a stationary one; groups of people."""


@dataclass(frozen=True, eq=False)
class RuleParameters:
    """n parameters of some rules: `names` tell rule and setting of each, `start` (n,) logarithms, `bounds` of these.

    A setting of a rule's interaction is told by "interaction.NAME".
    """

    rules: tuple[Rule, ...]
    names: tuple[tuple[int, str], ...]
    start: FloatArray
    bounds: tuple[tuple[float, float], ...]

    @classmethod
    def from_rules(cls, rules: Sequence[Rule]) -> Self:
        """All rates, widths and parameters of laws that are finite and above 0, clipped to their bounds."""
        names, values, bounds = [], [], []
        for k, rule in enumerate(rules):
            own = [field.name for field in fields(rule) if field.name == "rate" or field.name.endswith("_scale")]
            found = {name: getattr(rule, name) for name in own}
            law = LAWS.get(type(rule.interaction), ())
            found |= {f"interaction.{name}": getattr(rule.interaction, name) for name in law}
            for name, value in found.items():
                if isinstance(value, float) and 0 < value < math.inf:
                    low, high = BOUNDS.get(name.removeprefix("interaction."), (value / 10, value * 10))
                    names.append((k, name))
                    values.append(min(max(value, low), high))
                    bounds.append((math.log(low), math.log(high)))
        return cls(tuple(rules), tuple(names), np.log(values), tuple(bounds))

    def valued(self, x: FloatArray) -> tuple[Rule, ...]:
        """The rules with parameters x (n,)."""
        values: list[dict[str, Any]] = [{} for _ in self.rules]
        laws: list[dict[str, Any]] = [{} for _ in self.rules]
        for (k, name), value in zip(self.names, np.exp(x), strict=True):
            of_law = name.startswith("interaction.")
            (laws if of_law else values)[k][name.removeprefix("interaction.")] = float(value)
        return tuple(
            replace(rule, interaction=replace(rule.interaction, **law) if law else rule.interaction, **changes)
            for rule, law, changes in zip(self.rules, laws, values, strict=True)
        )


@dataclass(frozen=True)
class FittedInteractions:
    """Fitted rules.

    rules  with their fitted values
    loss   mean negative log-likelihood of a known place, without constants, plus the penalty of the prior; NaN if the
           rules reach no gap
    """

    rules: tuple[Rule, ...]
    loss: float


def fit_interactions(
    sample: HiddenObjects,
    settings: TrackerSettings,
    template: Sequence[Rule] = TEMPLATE,
    iterations: int = 8,
    prior: float = PRIOR,
    most: int = MAX_GAPS,
) -> FittedInteractions:
    """The most likely values of the template's rules, from gaps in recordings.

    settings   of the tracker, with its base motion; template: where the search begins
    prior      weight of the template; gaps of one recording tell much the same, so it is not small
    most       gaps that are learned from, a random sample

    Rules whose classes do not occur are left out. Rules that reach no gap stay as they are, with a loss of NaN. Raises
    `InputError` for a sample without gaps.
    """
    if len(sample) == 0:
        raise InputError("sample: expected at least one object that is followed for long enough")
    occurring = set(np.unique(sample.label).tolist())
    parameters = RuleParameters.from_rules([rule for rule in template if occurring & set(rule.classes)])
    start = parameters.start
    sample = reached(sample, settings, parameters).sampled(most, seed=0)
    if len(sample) == 0:
        return FittedInteractions(parameters.rules, math.nan)

    def loss(x: FloatArray) -> float:
        prediction = sample.predict(settings, parameters.valued(x))
        return negative_log_likelihood(sample, prediction) + prior * float(((x - start) ** 2).sum())

    options = {"maxiter": iterations, "eps": 1e-3, "ftol": MIN_GAIN}
    found = minimize(loss, start, method="L-BFGS-B", bounds=parameters.bounds, options=options)
    return FittedInteractions(parameters.valued(found.x), float(found.fun))


def reached(sample: HiddenObjects, settings: TrackerSettings, parameters: RuleParameters) -> HiddenObjects:
    """The gaps in which edges act where rates and widths are at their upper bounds; others say nothing about them."""
    widest = parameters.valued(np.array([high for _, high in parameters.bounds]))
    alone, acted = (sample.predict(settings, rules).position for rules in ((), widest))
    return sample.select(np.flatnonzero((np.abs(acted - alone) > MOVED).any(axis=(1, 2))))


def negative_log_likelihood(sample: HiddenObjects, prediction: GapPrediction) -> float:
    """Mean over all known places at the ends of all steps, without constants, at the likeliest scale of each class."""
    known = sample.known
    e, S = (sample.place - prediction.position)[known], prediction.P[known] + PLACE_DEVIATION**2 * np.eye(2)
    square = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[:, :, None])[..., 0])
    label = np.broadcast_to(sample.label[:, None], known.shape)[known]
    scale = _scales(square, label)
    loss = 0.5 * np.log(np.linalg.det(S)) + np.log(scale) + (TAILS + 2) / 2 * np.log1p(square / (scale * TAILS))
    return float(loss.mean())


def _scales(square: FloatArray, label: StrArray) -> FloatArray:
    """The likeliest scale (n,) of the covariance by class, for squared distances (n,), by fixed-point iteration."""
    classes, of_class, count = np.unique(label, return_inverse=True, return_counts=True)
    group = np.where(count >= FEWEST, np.arange(len(classes)), len(classes))[of_class]
    total = np.maximum(np.bincount(group, minlength=len(classes) + 1), 1)
    c = np.ones(len(classes) + 1)
    for _ in range(20):
        weighted = (TAILS + 2) * square / (TAILS + square / c[group])
        c = np.maximum(np.bincount(group, weighted, minlength=len(c)) / total / 2, 1e-6)
    return np.asarray(c[group])
