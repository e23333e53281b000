"""The tracker's filter as a running graph, in which factors of users' own take part.

The calls of an estimator become providers of an `IncrementalSmoother` of lag 0: what is added is a birth, a prediction
an epoch with its interaction factors, an update detections. Between them users' providers are asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.graph_providers import Births, Interactions, LinearDetections
from saga_fg.estimators.incremental_graph import IncrementalSmoother
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.protocol import Measurements, require_kind
from saga_fg.estimators.sighting import Observations
from saga_fg.graph.keys import OBJECT, key_of
from saga_fg.graph.providers import FactorProvider
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.transition import Transition


class GraphFilter:
    """The joint state of all tracks in a running graph. See `saga_fg.estimators.protocol.Estimator` for the methods.

    providers  asked by `ask`, once a frame
    """

    def __init__(self, providers: Sequence[FactorProvider]) -> None:
        self.providers = tuple(providers)
        self._smoother = IncrementalSmoother()
        self._smoother.step(0.0)
        self._layout = Layout()
        self._posterior: BlockGaussian | None = None  # until the graph changes

    def __copy__(self) -> GraphFilter:
        twin = GraphFilter(self.providers)
        twin._smoother, twin._layout, twin._posterior = self._smoother.handed_over(), self._layout, self._posterior
        return twin

    @property
    def nodes(self) -> IntArray:
        return self._layout.nodes

    @property
    def time(self) -> float:
        return self._smoother.time

    def ask(self, origin: FloatArray) -> None:
        """Let the users' providers add their factors; origin (2,): of the states' positions in the world, m."""
        self._smoother.origin = origin
        self._changed().extend(self.providers)

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._layout.extended(nodes, mean.shape[1])
        added = layout.nodes[len(self._layout) :]
        if (added < 0).any():
            raise InputError("providers: expected no road map, its nodes are not in the running graph of the tracker")
        self._changed().extend([Births(added, mean, covariance, labels or {})])
        self._layout, self._posterior = layout, None

    def predict(self, transition: Transition) -> None:
        require_kind("transition", transition, Transition)
        self._changed().step(self.time + transition.dt, [Interactions(transition)])

    def update(self, measurements: Measurements | Observations) -> None:
        require_kind("measurements", measurements, Measurements, Observations)
        if len(measurements):
            self._layout.rows(measurements.nodes)
            self._changed().extend([LinearDetections(measurements)])

    def marginalise(self, nodes: ArrayLike) -> None:
        """Nodes that disappear have no state at the next epoch; what they told of their neighbours stays."""
        self._layout = self._layout.without(self._layout.rows(nodes))
        self._posterior = None

    def mean(self, nodes: ArrayLike) -> FloatArray:
        keys = self._keys(nodes)
        return np.stack([self._state(key) for key in keys]) if keys else np.empty((0, 0))

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        rows = self._layout.rows(nodes)
        self._layout.spans(rows)
        return self.posterior().covariances(rows)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        return np.concatenate([np.empty(0), *(self._state(key) for key in self._keys(nodes))])

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        return self.posterior().joint(self._layout.rows(nodes))

    def posterior(self) -> BlockGaussian:
        """The joint Gaussian of all nodes, as one component: all together cost little more than one alone."""
        if self._posterior is None:
            nodes = self._layout.nodes
            partition = Partition(self._layout, np.zeros(len(nodes), dtype=np.int64))
            blocks = (self._smoother.joint_covariance(self._keys(nodes))[None],) if len(nodes) else ()
            self._posterior = BlockGaussian(partition, self.joint_mean(nodes), blocks)
        return self._posterior

    def graph(self) -> SceneFactorGraph:
        """The running graph itself."""
        return self._smoother.graph()

    def snapshot(self) -> tuple[SceneFactorGraph, Layout]:
        """The graph and its nodes as values, which can be pickled."""
        return self._smoother.snapshot(), self._layout

    def restore(self, state: tuple[SceneFactorGraph, Layout]) -> None:
        """Continue from a snapshot."""
        require_kind("state", state, tuple)
        graph, self._layout = state
        self._changed().restore(graph)

    def _changed(self) -> IncrementalSmoother:
        self._posterior = None
        return self._smoother

    def _keys(self, nodes: ArrayLike) -> list[int]:
        self._layout.rows(nodes)
        epoch = self._smoother.graph().epoch
        return [key_of(OBJECT, node, epoch) for node in np.asarray(nodes).tolist()]

    def _state(self, key: int) -> FloatArray:
        return np.asarray(self._smoother.state(key))
