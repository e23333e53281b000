"""The objects that nothing ties to others as providers see them: variables that enter the graph when a factor does."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property

import numpy as np

from factors import Vector
from saga_fg.estimators.independent import IndependentObjects
from saga_fg.graph.keys import VariableKind, node_key, node_kind
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import GraphVariable
from saga_fg.numerics.arrays import FloatArray, IntArray


class IndependentVariables:
    """Independent objects, by the keys that their variables have in a graph. See `saga_fg.graph.providers`.

    taken: those that have entered the graph, keys by id, by the number of the epoch
    """

    def __init__(self, objects: IndependentObjects, labels: Mapping[int, str]) -> None:
        self._objects, self._labels, self._epochs = objects, labels, objects.epochs
        self.taken: dict[int, dict[int, int]] = {}
        self._gone = set[int]()

    @cached_property
    def _places(self) -> dict[int, tuple[int, int]]:
        """Epoch of the window and id of each, by key."""
        here = self._objects.layout.nodes
        return {
            node_key(node, epoch.number): (k, node)
            for k, epoch in enumerate(self._epochs)
            for node in here[np.isin(here, epoch.x.layout.nodes)].tolist()
            if node not in self._gone
        }

    @cached_property
    def variables(self) -> Mapping[int, GraphVariable]:
        """All of them by key."""
        types = [
            dict(zip(one.x.layout.nodes.tolist(), one.x.layout.dims.tolist(), strict=True)) for one in self._epochs
        ]
        vectors = {dim: Vector(dim) for every in types for dim in every.values()}
        found = {}
        for key, (k, node) in self._places.items():
            (kind, number), epoch = node_kind(node), self._epochs[k]
            label = self._labels.get(node) or kind.name
            found[key] = GraphVariable(key, kind, number, epoch.number, epoch.time, vectors[types[k][node]], label)
        return found

    def of(self, kind: VariableKind, epoch: int) -> dict[int, GraphVariable]:
        """The variables of a kind and an epoch, by id."""
        return {one.id: one for one in self.variables.values() if one.kind == kind and one.epoch == epoch}

    def state(self, key: int) -> FloatArray:
        """Value of one of them."""
        k, node = self._places[key]
        x = self._epochs[k].x
        return np.array(x.mean[x.layout.places(x.layout.rows([node]))])

    def covariance(self, key: int) -> FloatArray:
        """Its marginal covariance (d, d)."""
        k, node = self._places[key]
        x = self._epochs[k].x
        return x.joint(x.layout.rows([node]))

    def add_to(self, graph: SceneFactorGraph, keys: Collection[int]) -> None:
        """Put those among `keys` into the graph, with their factors."""
        nodes = sorted({self._places[key][1] for key in keys if key in self._places})
        if nodes:
            self.tie(graph, np.array(nodes, dtype=np.int64))

    def tie(self, graph: SceneFactorGraph, nodes: IntArray) -> None:
        """Put some objects, and those that are correlated with them, into the graph, with their factors."""
        nodes = np.setdiff1d(self._objects.components_of(nodes), list(self._gone))
        for epoch, keys in zip(self._epochs, self._objects.add_to(graph, nodes, self._labels), strict=True):
            self.taken.setdefault(epoch.number, {}).update(keys)
        for cached in ("variables", "_places"):
            self.__dict__.pop(cached, None)
        self._gone |= set(nodes.tolist())
