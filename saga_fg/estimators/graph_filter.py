"""The tracker's filter as a running graph, in which factors of users' own take part.

The calls of an estimator become providers of an `IncrementalSmoother` of lag 0: what is added is a birth, a prediction
an epoch with its interaction factors, an update detections. Between them users' providers are asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.graph_providers import Births, Interactions, LinearDetections
from saga_fg.estimators.incremental_graph import IncrementalSmoother
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.partition import Partition
from saga_fg.estimators.protocol import Measurements, require_kind
from saga_fg.frame import Frame
from saga_fg.graph.keys import MAP_NODE, OBJECT, node_key
from saga_fg.graph.providers import FactorProvider, beginnings
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.transition import Transition


class GraphFilter:
    """The joint state of all tracks in a running graph. See `saga_fg.estimators.protocol.Estimator` for the methods.

    providers  asked by `ask`, once a frame
    lag        s; how long epochs stay in the graph, at least until they have been asked once at the next one

    What is told and reported is the newest state, at any lag.
    """

    def __init__(self, providers: Sequence[FactorProvider] = (), lag: float = 0.0) -> None:
        self.providers, self._lag = tuple(providers), lag
        self._smoother = IncrementalSmoother(lag=lag)
        self._smoother.step(0.0)
        self._beside: tuple[int, ...] = ()  # variables beside the nodes, of the epoch when providers were last asked
        self._layout = Layout()
        self._posterior: BlockGaussian | None = None  # until the graph changes

    def __copy__(self) -> GraphFilter:
        twin = GraphFilter(self.providers, self._lag)
        twin._smoother, twin._layout, twin._posterior = self._smoother.handed_over(), self._layout, self._posterior
        twin._beside = self._beside
        return twin

    @property
    def nodes(self) -> IntArray:
        return self._layout.nodes

    @property
    def time(self) -> float:
        return self._smoother.time

    def hear(self, frame: Frame | None, origin: FloatArray) -> None:
        """What providers are told from now on; origin (2,): of the states' positions in the world, m."""
        self._smoother.origin, self._smoother.frame = origin, frame
        graph = self._smoother.graph()
        if graph.epoch == 0 and not graph.variables:
            self.extend(beginnings(self.providers))

    def ask(self) -> None:
        """Let the users' providers add their factors."""
        smoother = self._changed()
        smoother.extend(self.providers)
        smoother.forget()
        graph, nodes = smoother.graph(), set(self._keys(self.nodes))
        self._beside = tuple(k for k, one in graph.variables.items() if one.epoch == graph.epoch and k not in nodes)

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Let some providers add their factors at the present epoch."""
        self._changed().extend(providers)

    @property
    def others(self) -> list[int]:
        """Keys of the variables beside the nodes: poses, landmarks."""
        every = self._smoother.graph().variables
        return [key for key, one in every.items() if one.epoch is None or one.kind not in (OBJECT, MAP_NODE)]

    def covariance_with(self, keys: Sequence[int], nodes: ArrayLike) -> FloatArray:
        """Joint covariance of other variables and some nodes, in the order given."""
        return self._smoother.joint_covariance([*keys, *self._keys(nodes)])

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._layout.extended(nodes, mean.shape[1])
        added = layout.nodes[len(self._layout) :]
        smoother = self._changed()
        smoother.marginalise(key for key in self._keys_of(added) if key in smoother.graph().variables)  # gone and back
        smoother.extend([Births(added, mean, covariance, labels or {})])
        self._layout, self._posterior = layout, None

    def predict(self, transition: Transition) -> None:
        Dynamics.of(transition, self._layout)  # or an error
        smoother = self._changed()
        smoother.forget(self._beside)
        smoother.begin(self.time + transition.dt, [Interactions(transition), *beginnings(self.providers)])

    def update(self, measurements: Measurements) -> None:
        require_kind("measurements", measurements, Measurements)
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
        return self._keys_of(nodes)

    def _keys_of(self, nodes: ArrayLike) -> list[int]:
        epoch = self._smoother.graph().epoch
        return [node_key(node, epoch) for node in np.asarray(nodes).tolist()]

    def _state(self, key: int) -> FloatArray:
        return np.asarray(self._smoother.state(key))
