"""The window of a running graph: its epochs with what came at each, and the graph of all objects over it.

A measurement of the past takes the filter back to the epoch before it: the interval that contains its time is
discretised anew over both parts, with the edges as they were recorded, and all that came since comes again. That is
exact wherever the filter is, and asks nothing of a solver but to begin from an earlier state.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.estimators.batch import linear_solution
from saga_fg.estimators.filtering import Dynamics
from saga_fg.estimators.independent import IndependentObjects
from saga_fg.estimators.partition import BlockGaussian, Partition, StateLayout
from saga_fg.estimators.smoother import SmoothedState
from saga_fg.graph import SceneFactorGraph, node_key
from saga_fg.model import Transition
from saga_fg.numerics import BoolArray, FloatArray, checked

SAME_TIME = 1e-9  # s
LEFT = "marginalise"  # the call by which nodes leave


@dataclass(frozen=True, eq=False)
class Call:
    """A call that changed the filter: a method with its arguments."""

    method: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class WindowEpoch:
    """An epoch of the window: its number in the graph, its time, s; keys of the objects' variables there, by id.

    calls        that came at this epoch, in their order
    state        of the filter after them; with the transition to the next epoch, None for the newest
    """

    number: int
    time: float
    keys: Mapping[int, int]
    calls: tuple[Call, ...] = ()
    state: Any = None
    transition: Transition | None = None


@dataclass(frozen=True, eq=False)
class GraphWindow:
    """The epochs, oldest first."""

    epochs: tuple[WindowEpoch, ...]

    @property
    def newest(self) -> WindowEpoch:
        """The present epoch."""
        return self.epochs[-1]

    @property
    def start(self) -> float:
        """Time of the oldest epoch, s."""
        return self.epochs[0].time

    def called(self, method: str, *arguments: Any) -> GraphWindow:
        """Note a call."""
        newest = self.newest
        return GraphWindow((*self.epochs[:-1], replace(newest, calls=(*newest.calls, Call(method, arguments)))))

    @property
    def without_states(self) -> GraphWindow:
        """The epochs without the states in which they were left, each of which would hold all earlier ones."""
        return GraphWindow(tuple(replace(one, state=None) for one in self.epochs))

    def with_states(self, window: GraphWindow) -> GraphWindow:
        """The epochs that are in another window, too, with the states that they have there."""
        states = {one.number: one.state for one in window.epochs}
        return GraphWindow(tuple(replace(one, state=states[one.number]) for one in self.epochs if one.number in states))

    def left(self, state: Any, transition: Transition) -> GraphWindow:
        """Note the state in which the newest epoch is left, and the transition from there."""
        return GraphWindow((*self.epochs[:-1], replace(self.newest, state=state, transition=transition)))

    def begun(self, epoch: WindowEpoch, since: float) -> GraphWindow:
        """Begin the next epoch; since: what is older is forgotten but for the last, s."""
        first = max((k for k, one in enumerate(self.epochs) if one.time <= since + SAME_TIME), default=0)
        return GraphWindow((*self.epochs[first:], epoch))

    def with_keys(self, taken: Mapping[int, Mapping[int, int]]) -> GraphWindow:
        """Note the variables of objects, by id, by the number of their epoch."""
        return GraphWindow(tuple(replace(one, keys={**one.keys, **taken.get(one.number, {})}) for one in self.epochs))

    def without(self, nodes: set[int]) -> GraphWindow:
        """Forget the variables of objects."""
        epochs = (replace(one, keys={n: key for n, key in one.keys.items() if n not in nodes}) for one in self.epochs)
        return GraphWindow(tuple(epochs))

    def place(self, time: float, start: float) -> int:
        """The newest epoch that is not after `time`. Raises `InputError` for one before `start` or after the newest."""
        time, newest = float(checked("time", time, ())), self.newest.time
        if time > newest + SAME_TIME:
            raise InputError(f"time: {time:.6f} s is after the newest epoch, {newest:.6f} s; predict first")
        if time < start - SAME_TIME:
            raise InputError(f"time: {time:.6f} s is before what is remembered, which begins at {start:.6f} s")
        return max(k for k, epoch in enumerate(self.epochs) if epoch.time <= time + SAME_TIME)

    def there(self, nodes: ArrayLike, k: int) -> BoolArray:
        """(m,) which nodes have been there since the end of epoch k."""
        ids, state = np.asarray(nodes), self.epochs[k].state
        gone = [call.arguments[0] for epoch in self.epochs[k + 1 :] for call in epoch.calls if call.method == LEFT]
        found = ~np.isin(ids, np.concatenate([np.empty(0, dtype=np.int64), *map(np.atleast_1d, gone)]))
        return found if state is None else found & np.isin(ids, state.layout.nodes)


@dataclass(frozen=True, eq=False)
class GraphState:
    """The filter as a value, which can be pickled; see `saga_fg.estimators.graph_filter` for its parts."""

    graph: SceneFactorGraph
    layout: StateLayout
    keys: Mapping[int, int]
    independent: IndependentObjects
    window: GraphWindow
    labels: Mapping[int, str]
    auxiliary: tuple[int, ...]
    predictions: int
    posterior: BlockGaussian | None
    before: tuple[BlockGaussian, Dynamics] | None = None  # see there; without nodes in iSAM2 not needed


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
