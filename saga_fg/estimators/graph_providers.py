"""Objects in the running graph: births, interactions over an interval, and linear measurements, as factor providers.

prior        || x_i - m ||_P                             `Births`
interaction  || x_i' - sum_j F_ij x_j - b_i ||_{Q_i}     `Interactions`, one n-ary factor a node and interval
detection    || z - H x_i ||_R                           `DetectionFactors`
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from factors import detection_factors, gaussian_factors, prior_factors
from saga_fg.estimators.factor_graph import interval_factors
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.measurements import Observations
from saga_fg.estimators.protocol import Measurements
from saga_fg.graph.keys import node_key, node_kind
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Births:
    """New objects, independent of all others: ids (k,), means (k, d), covariances (k, d, d); labels by id."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray
    labels: Mapping[int, str] = field(default_factory=dict)
    name: str = "births"
    internal: ClassVar[bool] = True

    def factors(self, view: GraphView) -> Additions:
        ids = np.asarray(self.nodes).tolist()
        if not ids:
            return Additions()
        born = [
            NewVariable(*node_kind(i), mean, label=self.labels.get(i, ""))
            for i, mean in zip(ids, self.means, strict=True)
        ]
        return Additions(born, prior_factors([node_key(i, view.epoch) for i in ids], self.means, self.covariances))


@dataclass(frozen=True, eq=False)
class Interactions:
    """Objects move by a transition over those that stay.

    earlier    by id, the keys of their variables, by default those of the epoch before
    carried_over   ids of those whose variables stay as they are
    """

    transition: Transition
    earlier: Mapping[int, int] | None = None
    carried_over: Collection[int] = ()
    name: str = "interactions"
    internal: ClassVar[bool] = True

    def factors(self, view: GraphView) -> Additions:
        transition = self.transition
        nodes = transition.nodes.tolist()
        if not nodes:
            return Additions()
        earlier = self.earlier or {node: node_key(node, view.epoch - 1) for node in nodes}
        now = {node: node_key(node, view.epoch) for node in nodes}
        layout = Layout(nodes, transition.graph.dims)
        mean = np.concatenate([view.state(earlier[node]) for node in nodes])
        interval = IntervalDynamics(transition)
        dynamics = interval.linearised(layout, mean)
        moved = dynamics.moved(mean) + dynamics.b
        states = np.split(moved, transition.offsets[1:-1])
        new = [
            NewVariable(*node_kind(n), x, label=view.variables[earlier[n]].label)
            for n, x in zip(nodes, states, strict=True)
            if n not in self.carried_over
        ]
        native, nonlinear = interval_factors(interval, layout, mean, dict(earlier), now)
        still = {now[node] for node in self.carried_over}
        return Additions(new, [*(one for one in native if one.keys()[0] not in still), *nonlinear])


@dataclass(frozen=True, eq=False)
class DetectionFactors:
    """Measurements of objects; keys: of their variables by id, by default those of this epoch."""

    measurements: Measurements | Observations
    keys: Mapping[int, int] | None = None
    name: str = "detections"
    internal: ClassVar[bool] = True

    def factors(self, view: GraphView) -> Additions:
        m = self.measurements
        now = self.keys or {node: node_key(node, view.epoch) for node in m.nodes.tolist()}
        keys = np.array([[now[node]] for node in m.nodes.tolist()], dtype=np.uint64).reshape(-1, 1)
        if isinstance(m, Observations):
            return Additions(factors=[detection_factors(keys[:, 0], m.model, m.z, m.R)])
        return Additions(factors=gaussian_factors(keys, [m.H], m.z, m.R))
