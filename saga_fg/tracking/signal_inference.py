r"""Colours of lights inferred from traffic: the first vehicle before each stop line drives by its light.

    L_k <- L_k + r ( a_k T dv - (a_k T)^2 / 2 ) / V,    V = max( P + q T - P', q T )
    L_k <- max( L_k - max L, log h ),    p_k <- p_k exp( change of L_k ) / sum

is Bayes' rule with the likelihoods N(dv; a_k T, V) of the states k of the light. dv is the change of the vehicle's
estimated speed along its lane between two detections T seconds apart, P and P' the variances of the two estimates, so
that V is that of dv (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
section 5.4), and r the probability that the track exists. a_k is the acceleration that the edge rules expect, at the
estimate at the first of the two: in red and amber that of `RedLight`, in green that of `GreenLight`; drivers who wait
have not reacted yet in the state `starting`. The exponent is linear in dv, so that the noise of the estimated speeds
does not add up over the frames.

A share h of the drivers does not comply with the light: they turn at red, or cannot leave at green. So no vehicle
says more than a factor 1 / h. All lines of a light gain by what is inferred, and by colours that are reported as well.
Hidden vehicles tell nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.interactions import NodeTable
from saga_fg.model.road.starting import GreenLight
from saga_fg.model.road.stop_lines import coming_vehicles
from saga_fg.model.road.stopping import RedLight, halting
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.types.signal import STATES, SignalSettings

LONGEST = 1.0  # s between two detections of a vehicle

Rule = TypeVar("Rule")


@dataclass(frozen=True, eq=False)
class FirstVehicles(Columns):
    """First vehicles before lines as last detected.

    id, line (n,) of the tracks and of the nodes of the lines; time (n,) s; speed (n,) along direction (n, 2), m/s;
    variance (n,) of the speed; expected (n, 4) accelerations in each state of the light, m/s^2; weight (n,)
    probability that the track exists; log_likelihood (n, 4) L
    """

    id: IntArray
    line: IntArray
    time: FloatArray
    speed: FloatArray
    direction: FloatArray
    variance: FloatArray
    expected: FloatArray
    weight: FloatArray
    log_likelihood: FloatArray

    @classmethod
    def none(cls) -> FirstVehicles:
        """No vehicle."""
        ids, times, states = np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, len(STATES)))
        return cls(ids, ids, times, times, np.empty((0, 2)), times, states, times, states)

    def later(self, nodes: NodeTable, rules: Sequence[EdgeRule], detected: BoolArray, time: float) -> FirstVehicles:
        """First vehicles of a node table: tracks (its first rows) `detected` at `time`, and others seen just before."""
        stop, go = _first(rules, RedLight), _first(rules, GreenLight)
        if stop is None:
            return self
        first = stop.able(coming_vehicles(nodes, stop.classes, stop.max_distance).first())
        first = first.select(first.target < len(detected))
        first = first.select(detected[first.target])
        v, ids, line = first.speed, nodes.id[first.target], nodes.id[first.source]
        ramp, braking = stop.brakes(nodes, first)
        free = np.zeros_like(v) if go is None else go.acceleration(v)
        closed = ramp * braking + (1 - ramp) * free
        waiting = np.where(halting(v, first.front), 0.0, free)
        exists = np.ones(len(nodes)) if nodes.existence is None else nodes.existence
        same = (ids[:, None] == self.id) & (line[:, None] == self.line)
        log_likelihood = np.where(same.any(axis=1)[:, None], same.astype(np.float64) @ self.log_likelihood, 0.0)
        expected = np.column_stack([closed, closed, waiting, free])
        variance = nodes.velocity_variance[first.target]
        then = np.full(len(v), time)
        now = FirstVehicles(
            ids, line, then, v, first.approach.direction, variance, expected, exists[first.target], log_likelihood
        )
        kept = self.select(~np.isin(self.id, nodes.id[: len(detected)][detected]) & (self.time > time - LONGEST))
        return kept.append(now)

    def updated(
        self, ids: IntArray, velocity: FloatArray, variance: FloatArray, time: float, settings: SignalSettings
    ) -> FirstVehicles:
        """With what tracks `ids` (k,) tell that were detected at `time`: velocity (k, 2), variance (k,) of its
        components."""
        mine, row = np.nonzero((self.id[:, None] == ids) & (time > self.time)[:, None])
        dv = np.einsum("ni,ni->n", velocity[row], self.direction[mine]) - self.speed[mine]
        T, own = time - self.time[mine], settings.driver_noise * (time - self.time[mine])
        V = np.maximum(self.variance[mine] + own - variance[row], own)
        change = self.expected[mine] * T[:, None]
        log_likelihood = self.log_likelihood.copy()
        log_likelihood[mine] += (self.weight[mine] / V)[:, None] * change * (dv[:, None] - change / 2)
        log_likelihood -= log_likelihood.max(axis=1, keepdims=True, initial=-np.inf) if len(log_likelihood) else 0.0
        return replace(self, log_likelihood=np.maximum(log_likelihood, np.log(settings.non_compliance)))


def _first(rules: Sequence[EdgeRule], kind: type[Rule]) -> Rule | None:
    """The first rule of a kind, None without one; further rules of the kind do not count for the inference."""
    return next((rule for rule in rules if isinstance(rule, kind)), None)
