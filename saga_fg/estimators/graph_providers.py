"""Objects in the running graph: births, interactions over an interval, and linear measurements, as factor providers.

prior        || x_i - m ||_P                             `Births`
interaction  || x_i' - sum_j F_ij x_j - b_i ||_{Q_i}     `Interactions`, one n-ary factor a node and interval
detection    || z - H x_i ||_R                           `LinearDetections`
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factors import detection_factors, gaussian_factors, prior_factors
from saga_fg.arrays import FloatArray, IntArray
from saga_fg.estimators.factor_graph import motion_factors
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.motion import Motion
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.sighting import Observations
from saga_fg.graph.keys import OBJECT
from saga_fg.graph.parts import NewVariable
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.transition import Transition


@dataclass(frozen=True, eq=False)
class Births:
    """New objects, independent of all others: ids (k,), means (k, d), covariances (k, d, d); labels by id."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray
    labels: Mapping[int, str] = field(default_factory=dict)
    name: str = "births"

    def factors(self, view: GraphView) -> Additions:
        ids = np.asarray(self.nodes).tolist()
        born = [
            NewVariable(OBJECT, i, mean, label=self.labels.get(i, "")) for i, mean in zip(ids, self.means, strict=True)
        ]
        if not ids:
            return Additions()
        return Additions(born, prior_factors([view.key(OBJECT, i) for i in ids], self.means, self.covariances))


@dataclass(frozen=True, eq=False)
class Interactions:
    """Objects of the epoch before move by a transition over those that stay."""

    transition: Transition
    name: str = "interactions"

    def factors(self, view: GraphView) -> Additions:
        transition = self.transition
        nodes = transition.nodes.tolist()
        if not nodes:
            return Additions()
        before = view.before(OBJECT)
        layout = Layout(nodes, transition.graph.dims)
        mean = np.concatenate([view.state(before[node].key) for node in nodes])
        motion = Motion(transition)
        dynamics = motion.dynamics(layout, mean)
        moved = dynamics.moved(mean) + dynamics.b
        states = np.split(moved, transition.offsets[1:-1])
        new = [NewVariable(OBJECT, n, x, label=before[n].label) for n, x in zip(nodes, states, strict=True)]
        now = {node: view.key(OBJECT, node) for node in nodes}
        earlier = {node: before[node].key for node in nodes}
        native, nonlinear = motion_factors(motion, layout, mean, earlier, now)
        return Additions(new, [*native, *nonlinear])


@dataclass(frozen=True, eq=False)
class LinearDetections:
    """Measurements of objects at this epoch."""

    measurements: Measurements | Observations
    name: str = "detections"

    def factors(self, view: GraphView) -> Additions:
        m = self.measurements
        keys = np.array([[view.key(OBJECT, node)] for node in m.nodes.tolist()], dtype=np.uint64).reshape(-1, 1)
        if isinstance(m, Observations):
            return Additions(factors=[detection_factors(keys[:, 0], m.model, m.z, m.R)])
        return Additions(factors=gaussian_factors(keys, [m.H], m.z, m.R))
