"""The window of a running graph: its epochs with what came at each, and the graph of all objects over it.

Objects that nothing ties to others are one batch, in closed form. Over the epochs of a window,

    x_i' = F_ii x_i + b_i + q_i,    z = H x_i + v        P = blockdiag( P_1, ..., P_n )

where those whose correlation has not faded yet are one block together. Eliminating the chain of such objects in the
order of time is the Kalman filter, whose kernels do it here for all at once (`saga_fg.estimators.filtering`). What
would be their factors are arrays; those of an object that is tied to others, or that somebody looks at, are made then,
over all of its epochs in the window.

A measurement of the past takes the filter back to the epoch before it: the interval that contains its time is
discretised anew over both parts, with the edges as they were recorded, and all that came since comes again. That is
exact wherever the filter is, and asks nothing of a solver but to begin from an earlier state.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factors import GaussianFactors, Vector, gaussian_factors
from saga_fg.errors import InputError
from saga_fg.estimators.filtering import Dynamics, Measurements, corrected, noise_ratio, predict
from saga_fg.estimators.interval_dynamics import LARGEST_RATIO, merged
from saga_fg.estimators.object_factors import component_priors, measurement_factors
from saga_fg.estimators.partition import UNCORRELATED, BlockGaussian, Partition, StateLayout
from saga_fg.estimators.smoother import SmoothedState
from saga_fg.estimators.solvers import linear_solution
from saga_fg.graph import GraphVariable, NewVariable, SceneFactorGraph, VariableKind, node_key, node_kind
from saga_fg.model import Transition
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked


@dataclass(frozen=True, eq=False)
class IndependentEpoch:
    """An epoch of the window: its number in the graph, its time, s, and the objects' Gaussian after `measurements`.

    new       ids of the objects that begin here
    dynamics  to the next epoch, of the objects that go on; None for the newest epoch
    """

    number: int
    time: float
    x: BlockGaussian
    new: frozenset[int] = frozenset()
    measurements: tuple[Measurements, ...] = ()
    dynamics: Dynamics | None = None


@dataclass(frozen=True, eq=False)
class IndependentObjects:
    """The window, oldest epoch first. Earlier epochs may have objects that have left, or been tied, since."""

    epochs: tuple[IndependentEpoch, ...]

    @staticmethod
    def begun(number: int, time: float, x: BlockGaussian) -> IndependentObjects:
        """Objects at one epoch."""
        return IndependentObjects((IndependentEpoch(number, time, x, frozenset(x.layout.nodes.tolist())),))

    @property
    def x(self) -> BlockGaussian:
        """The Gaussian of the objects at the newest epoch."""
        return self.epochs[-1].x

    @property
    def layout(self) -> StateLayout:
        """The objects at the newest epoch."""
        return self.epochs[-1].x.layout

    def added(self, nodes: IntArray, means: FloatArray, covariances: FloatArray) -> IndependentObjects:
        """Add objects behind those that are there."""
        last = self.epochs[-1]
        x = last.x.extended(last.x.layout.extended(nodes, means.shape[1]), means, covariances)
        return self._with_newest(replace(last, x=x, new=last.new | set(nodes.tolist())))

    def with_released(self, layout: StateLayout, x: BlockGaussian) -> IndependentObjects:
        """Add objects that have been tied to others until now; layout: of all nodes, which has the order."""
        last, nodes = self.epochs[-1], set(x.layout.nodes.tolist())
        mine = np.isin(layout.nodes, np.concatenate([last.x.layout.nodes, x.layout.nodes]))
        joint = merged(layout.select(mine), last.x, x)
        return self._with_newest(replace(last, x=joint, new=last.new | nodes))

    def components_of(self, nodes: IntArray) -> IntArray:
        """The objects among `nodes`, and all that are correlated with one of them."""
        x = self.x
        label = x.partition.label
        return x.layout.nodes[np.isin(label, label[np.isin(x.layout.nodes, nodes)])]

    def without(self, nodes: IntArray) -> IndependentObjects:
        """Objects that leave, or that are tied to others from now on."""
        last = self.epochs[-1]
        return self._with_newest(replace(last, x=last.x.without(last.x.layout.rows(nodes))))

    def predicted(self, dynamics: Dynamics, number: int, time: float, since: float | None) -> IndependentObjects:
        """Begin the next epoch; dynamics: of all nodes; since: time from which epochs are kept, s, None for none."""
        last = self.epochs[-1]
        own = dynamics.of_nodes(last.x.layout, alone=True)
        newest = IndependentEpoch(number, time, predict(last.x, own) if len(last.x.layout) else last.x)
        if since is None:
            return IndependentObjects((newest,))
        first = max((k for k, epoch in enumerate(self.epochs) if epoch.time <= since), default=0)
        return IndependentObjects((*self.epochs[first:-1], replace(last, dynamics=own), newest))

    def updated(self, measured: Measurements) -> IndependentObjects:
        """Take in measurements made now."""
        last = self.epochs[-1]
        x, _ = corrected(last.x, measured.linearised(last.x.layout, last.x.mean))
        return self._with_newest(replace(last, x=x, measurements=(*last.measurements, measured)))

    def since(self, node: int) -> int:
        """The place of the first epoch of the window from which on an object has been there."""
        return next((k for k in reversed(range(len(self.epochs))) if node in self.epochs[k].new), 0)

    def add_to(self, graph: SceneFactorGraph, nodes: IntArray, labels: Mapping[int, str]) -> list[dict[int, int]]:
        """Add variables and factors of some objects to a graph, over their epochs in the window.

        Returns the keys of their variables by id, for each epoch. What is known at an object's first epoch is its
        prior; it is a later one where the noise of an interval is too small for a factor. An object that rests keeps
        its variable.
        """
        newest, label = len(self.epochs) - 1, self.x.partition.label
        tied = self.layout.nodes[np.bincount(label)[label] > 1] if len(label) else self.layout.nodes
        first = {node: self.since(node) for node in nodes.tolist()} | dict.fromkeys(
            np.intersect1d(nodes, tied).tolist(), newest
        )
        for k, epoch in enumerate(self.epochs[1:], 1):
            here = np.array([node for node, begin in first.items() if begin < k], dtype=np.int64)
            first |= dict.fromkeys(_without_factor(self.epochs[k - 1].dynamics, epoch.x.only(here)), k)
        every: list[dict[int, int]] = []
        keys: dict[int, int] = {}
        for k, epoch in enumerate(self.epochs):
            earlier, dynamics = keys, self.epochs[k - 1].dynamics if k else None
            here = np.array([node for node, begin in first.items() if begin <= k], dtype=np.int64)
            resting = dynamics.layout.nodes[dynamics.unchanged] if dynamics else np.empty(0, dtype=np.int64)
            kept = {node: earlier[node] for node in resting.tolist() if node in earlier}
            keys = {node: kept.get(node, node_key(node, epoch.number)) for node in here.tolist()}
            moved = epoch.x.only(np.setdiff1d(here, list(kept)))
            new = [
                NewVariable(*node_kind(node), state, label=labels.get(node, ""))
                for node, state in zip(
                    moved.layout.nodes.tolist(), np.split(moved.mean, moved.layout.offsets[1:]), strict=False
                )
            ]
            graph.add_variables("new objects", new, (epoch.number, epoch.time))
            begun = np.array([node for node in here.tolist() if node not in earlier], dtype=np.int64)
            graph.add_factors("new objects", list(component_priors(epoch.x.only(begun), keys)))
            if dynamics is not None and earlier:
                going = np.array(list(earlier), dtype=np.int64)
                factors = list(_motion_factors(dynamics, np.setdiff1d(going, list(kept)), earlier, keys))
                graph.add_factors("interactions", factors, (epoch.number, int(going[0])))
                for one in epoch.measurements:
                    seen = one.only(np.isin(one.nodes, going))
                    graph.add_factors("detections", measurement_factors(keys, seen))
            every.append(keys)
        number = self.epochs[-1].number
        here_too = {node_key(node, number): key for node, key in keys.items() if key != node_key(node, number)}
        graph.carried_over = {**graph.carried_over, **here_too}
        return every

    def _with_newest(self, epoch: IndependentEpoch) -> IndependentObjects:
        return IndependentObjects((*self.epochs[:-1], epoch))


def _without_factor(dynamics: Dynamics | None, x: BlockGaussian) -> list[int]:
    """Ids of the nodes of `x` that move in the interval before with too little noise for a factor."""
    if dynamics is None or len(x.layout) == 0:
        return []
    own = dynamics.of_nodes(x.layout, alone=True)
    ratio = np.full(len(x.layout), np.inf)
    for Q in own.Q:
        ratio[Q.target] = noise_ratio(x.covariances(Q.target), Q.values)
    none = (ratio > LARGEST_RATIO["qr"]) & ~own.unchanged
    return list(x.layout.nodes[none].tolist())


def _motion_factors(
    dynamics: Dynamics, nodes: IntArray, earlier: Mapping[int, int], keys: Mapping[int, int]
) -> Iterator[GaussianFactors]:
    """|| x_i' - F_ii x_i - b_i ||_{Q_i} of some nodes."""
    own = dynamics.of_nodes(dynamics.layout.select(np.isin(dynamics.layout.nodes, nodes)), alone=True)
    for F in own.F:
        rows, ids = F.target, own.layout.nodes[F.target].tolist()
        noise = np.zeros((len(own.layout), *F.values.shape[1:]))
        for Q in own.Q:
            if Q.values.shape[1:] == noise.shape[1:]:
                noise[Q.target] = Q.values
        names = np.array([[keys[node], earlier[node]] for node in ids], dtype=np.uint64)
        identity = np.broadcast_to(np.eye(F.values.shape[1]), F.values.shape)
        yield gaussian_factors(names, [identity, -F.values], own.b[own.layout.spans(rows)], noise[rows])


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


def uncoupled(graph: SceneFactorGraph, x: BlockGaussian, nodes: Collection[int]) -> dict[int, set[int]]:
    """Find the `nodes` that are no longer correlated with anything in a graph, with the keys of their variables.

    x: the joint Gaussian of what the graph has at its newest epoch
    """
    parts = x.uncorrelated(UNCORRELATED).label
    alone = np.flatnonzero(np.bincount(parts)[parts] == 1)
    own = {node: set[int]() for node in x.layout.nodes[alone].tolist() if node in nodes}
    named = {node_kind(node): node for node in own}
    for key, one in graph.variables.items():
        if (node := named.get((one.kind, one.id))) is not None:
            own[node].add(key)
    return {node: keys for node, keys in own.items() if graph.independent(keys)}


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
