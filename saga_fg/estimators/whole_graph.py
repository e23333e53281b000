"""The graph of all objects of a filter, those that nothing ties to others as well, and its smoothed epochs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.graph_window import SAME_TIME, GraphWindow
from saga_fg.estimators.independent import IndependentObjects
from saga_fg.estimators.partition import Partition, StateLayout
from saga_fg.estimators.smoother import SmoothedState
from saga_fg.estimators.solution import linear_solution
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import node_key
from saga_fg.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class WholeGraph:
    """The graph of all objects, and the epochs of its window, oldest first: time, s, and keys of variables by id."""

    graph: SceneFactorGraph
    keys: Sequence[tuple[float, Mapping[int, int]]]

    def epochs(self, present: StateLayout, start: float) -> Iterator[tuple[float, StateLayout, list[int], FloatArray]]:
        """Time, layout, keys and mean of every epoch from `start`, s, on, of the `present` nodes that it has."""
        variables = self.graph.variables
        for time, keys in self.keys:
            if time >= start - SAME_TIME:
                there = np.array([keys.get(node) in variables for node in present.nodes.tolist()], dtype=bool)
                layout = present.select(there)
                here = [keys[node] for node in layout.nodes.tolist()]
                yield time, layout, here, np.concatenate([np.empty(0), *(self.graph.state(key) for key in here)])

    def smoothed(self, present: StateLayout, start: float) -> tuple[SmoothedState, ...]:
        """The states of these epochs given all measurements."""
        solution, result = linear_solution(self.graph), list[SmoothedState]()
        for time, layout, here, mean in self.epochs(present, start):
            joint = Partition(layout, np.zeros(len(layout), dtype=np.int64))
            blocks = (solution.covariance(here)[None],) if here else ()
            result.append(SmoothedState(time, BlockGaussian(joint, mean, blocks)))
        return tuple(result)


def whole_graph(
    graph: SceneFactorGraph, independent: IndependentObjects, window: GraphWindow, labels: Mapping[int, str]
) -> WholeGraph:
    """Add the independent objects to a graph of the others; labels: classes by id."""
    nodes = independent.layout.nodes
    keys: dict[int, Mapping[int, int]] = {epoch.number: epoch.keys for epoch in window.epochs}
    if len(nodes):
        graph = graph.copy()
        old = {
            node_key(node, epoch.number)
            for node in nodes.tolist()
            for epoch in independent.epochs[independent.since(node) :]
        }
        graph.marginalise(old & graph.variables.keys())  # of nodes of the same ids that have left
        added = independent.add_to(graph, nodes, labels)
        step, base, values = linear_solution(graph).step, graph.base, graph.values
        for key in {key for own in added for key in own.values()}:  # the others are where iSAM2 has them
            values.update(key, base.atVector(key) + step.at(key))
        graph.moved_to(values)
        for epoch, own in zip(independent.epochs, added, strict=True):
            keys[epoch.number] = {**keys.get(epoch.number, {}), **own}
    return WholeGraph(graph, [(epoch.time, keys[epoch.number]) for epoch in window.epochs])
