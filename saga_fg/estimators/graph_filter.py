"""The running graph as an estimator: interaction factors between the states of objects, solved by iSAM2.

    predict   an epoch more: variables, and an interaction factor for each node
    update    detection factors on the newest epoch, or on an earlier one, where they were made late
    lag       epochs older than this are marginalised; 0 keeps the last interval alone, which is the filter

Each component of the graph is solved by what it needs. Objects that nothing ties to others are eliminated all at once,
in closed form (`saga_fg.estimators.graph_window`). Objects that interactions tie, and those with a nonlinear factor, a
robust one or one of a user's provider, are variables of `gtsam.ISAM2` (`saga_fg.estimators.solvers`), and
what is reported of them is read from its tree. An object passes from the one to the other when a first factor ties it,
and back when no correlation with others is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from factors.gaussian import Elimination
from saga_fg.errors import InputError, UnknownNodeError, require_type
from saga_fg.estimators.estimator import Estimator
from saga_fg.estimators.filtering import Dynamics, Measured, Measurements, Observations, predict
from saga_fg.estimators.graph_window import (
    SAME_TIME,
    GraphState,
    GraphWindow,
    IndependentObjects,
    IndependentVariables,
    WholeGraph,
    WindowEpoch,
    uncoupled,
    whole_graph,
)
from saga_fg.estimators.interval_dynamics import (
    IntervalDynamics,
    by_covariance,
    lossy,
    merged,
    replace_by_prior,
    with_noise,
)
from saga_fg.estimators.object_factors import DetectionFactors, Interactions
from saga_fg.estimators.partition import BlockGaussian, StateLayout, checked_prior, not_smaller
from saga_fg.estimators.smoother import SmoothedState
from saga_fg.estimators.solvers import IncrementalSmoother
from saga_fg.graph import MAP_NODE, OBJECT, WIDE, FactorProvider, SceneFactorGraph, node_key, predictors
from saga_fg.model import Transition
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked, shallow_copy
from saga_fg.types import Frame

_RELEASE_EVERY = 10  # predictions between looks for objects whose correlation with others has decayed


class GraphFilter(Estimator):
    """The joint state of all nodes in a running graph. See `saga_fg.estimators.Estimator` for the methods.

    providers  of users' factors, asked by `ask_providers` once a frame
    lag        s; how long epochs stay in the graph. The last interval stays in any case, so that nonlinear motion is
               linearised where measurements put it

    Estimates are those of the newest states, at any lag; `smoothed` has all epochs. A node whose state an interval
    leaves unchanged keeps its variable. Components whose noise is so small that factors would lose digits are predicted
    by covariances; their window begins anew there.

    The covariance of nodes that are `unsettled` is not smaller than the one predicted over the last interval, see
    `saga_fg.estimators.partition`: what was measured meanwhile counts for their place alone.
    """

    snapshots_hold_models = True

    def __init__(self, providers: Sequence[FactorProvider] = (), lag: float = 0.0) -> None:
        self.providers, self.lag = tuple(providers), float(checked("lag", lag, ()))
        self._smoother = IncrementalSmoother(lag=lag)
        self._smoother.step(0.0)
        self._layout = StateLayout()
        self._keys: Mapping[int, int] = {}  # of the nodes that are variables of iSAM2
        self._independent = IndependentObjects.begun(0, 0.0, BlockGaussian.empty())  # the others
        self._window = GraphWindow((WindowEpoch(0, 0.0, {}),))
        self._labels: Mapping[int, str] = {}
        self._auxiliary: tuple[int, ...] = ()  # variables beside the nodes, of the epoch when providers were last asked
        self._predictions = 0
        self._before: tuple[BlockGaussian, Dynamics] | None = None  # the state before the last interval, its dynamics
        self._posterior: BlockGaussian | None = None  # until the graph changes
        self._tied: BlockGaussian | None = None  # the part of it that iSAM2 has
        self._stale: frozenset[int] = frozenset()  # nodes whose components have changed in iSAM2 since

    def __copy__(self) -> GraphFilter:
        """A filter that goes its own way; it builds an iSAM2 of its own when it needs one."""
        return self._copied(taking_over=False)

    def handed_over(self) -> GraphFilter:
        """A filter that goes on with the present iSAM2; this one builds another when it is needed."""
        return self._copied(taking_over=True)

    def _copied(self, taking_over: bool) -> GraphFilter:
        twin = shallow_copy(self)
        twin._smoother = self._smoother.copied(taking_over)
        return twin

    @property
    def nodes(self) -> IntArray:
        return self._layout.nodes

    @property
    def time(self) -> float:
        return self._smoother.time

    @property
    def start(self) -> float:
        """Time before which measurements are refused, s: the begin of the window, at lag 0 the present."""
        return self._window.start if self.lag else self.time

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        """Set the frame that providers see, and the origin (2,) of the states' positions in the world, m."""
        self._note("set_frame", frame, origin)
        self._smoother.origin, self._smoother.frame = origin, frame
        graph = self._smoother.graph()
        if graph.epoch == 0 and not graph.variables:
            with self._changing():
                self._extend(predictors(self.providers))

    def ask_providers(self) -> None:
        """Let the users' providers add their factors."""
        with self._changing():
            variables, present = self._smoother.graph().variables, set(self._keys.values())
            left = [key for key in self._window.newest.keys.values() if key in variables and key not in present]
            self._smoother.marginalise(left)
            self._extend(self.providers)
            self._auxiliary = self._auxiliary_now()
            self._note("ask_providers")

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Let some providers add their factors at the present epoch."""
        with self._changing():
            self._extend(providers)
            self._note("extend", providers)

    @property
    def others(self) -> list[int]:
        """Keys of the variables beside the nodes: poses, landmarks."""
        every = self._smoother.graph().variables
        return [key for key, one in every.items() if one.epoch is None or one.kind not in (OBJECT, MAP_NODE)]

    @property
    def auxiliary(self) -> SceneFactorGraph:
        """The part of the graph that iSAM2 solves: all variables beside the nodes are in it."""
        return self._smoother.graph()

    def covariance_with(self, keys: Sequence[int], nodes: ArrayLike) -> FloatArray:
        """Joint covariance of other variables and some nodes, in the order given."""
        ids = np.asarray(nodes)
        rows, every = self._layout.rows(ids), self._smoother.graph().variables
        sizes = [*(every[key].dim for key in keys), *self._layout.dims[rows].tolist()]
        start = np.cumsum([0, *sizes])
        mine = [*keys, *(self._keys.get(node) for node in ids.tolist())]
        tied = [k for k, key in enumerate(mine) if key is not None]
        P = np.zeros((start[-1], start[-1]))
        at = np.concatenate([np.arange(start[k], start[k + 1]) for k in tied])
        P[np.ix_(at, at)] = self._smoother.joint_covariance([key for key in mine if key is not None])
        for k in set(range(len(mine))) - set(tied):
            span = slice(start[k], start[k + 1])
            P[span, span] = self.posterior().joint(rows[[k - len(keys)]])
        return P

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._layout.extended(nodes, mean.shape[1])
        with self._changing():
            added = layout.nodes[len(self._layout) :]
            self._layout = layout
            self._independent = self._independent.added(added, mean, covariance)
            self._labels = {**self._labels, **(labels or {})}
            self._note("add", nodes, means, covariances, labels)

    def predict(self, transition: Transition) -> None:
        require_type("transition", transition, Transition)
        interval, layout, x = IntervalDynamics(transition), self._layout, self.posterior()
        dynamics = interval.linearised(layout, x.mean)
        still = dynamics.unchanged
        if transition.dt == 0 and still.all():
            return
        state = replace(self._state(), window=self._window.without_states) if self.lag else None
        with self._changing():
            number, time = self._smoother.graph().epoch + 1, self.time + transition.dt
            time = max(time, float(np.nextafter(self.time, np.inf)))
            self._predictions += 1
            coupled = interval.coupled(dynamics)
            if self.lag or self.providers:
                if self._predictions % _RELEASE_EVERY == 0:
                    self._release_independent()
            else:
                x = x.decoupled()
                label = dynamics.joined(x.partition).label
                coupled = np.isin(label, label[coupled])
                widest = np.bincount(label[coupled], weights=layout.dims[coupled]).max(initial=0)
                self._begin_anew(x, "cholesky" if widest > WIDE else "qr")
            self._tie(layout.nodes[coupled])
            self._begin_epoch(x, transition, dynamics, number, time)
            since = time - self.lag
            if self.lag:
                self._window = self._window.left(state, transition)
            self._window = self._window.begun(WindowEpoch(number, time, dict(self._keys)), since)
            history = since + SAME_TIME if self.lag or self.providers else None
            self._independent = self._independent.predicted(dynamics, number, time, history)
            self._before = x, dynamics

    def update(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None = None,
    ) -> float:
        """Take in measurements, several kinds of them by one solution, made at `time`, s, None for now.

        Those made late are put in their place, and all that came since comes again, providers' factors as well, which
        are asked for again. Returns NaN.
        """
        kinds = list(measurements) if isinstance(measurements, Sequence) else [measurements]
        for one in kinds:
            require_type("measurements", one, Measured)
            one.rows(self._layout)
        k = None if time is None else self._window.place(time, self.start)
        kinds = [one for one in kinds if len(one)]
        if not kinds:
            return 0.0
        with self._changing():
            if time is not None and k is not None and time < self.time - SAME_TIME:
                self._update_past(kinds, k, time)
            else:
                self._update_now(kinds)
                self._note("update", kinds)
        return math.nan

    def remembered(self, nodes: ArrayLike, time: float) -> BoolArray:
        """(k,) whether measurements of nodes at `time`, s, can still be put there."""
        if time < self.start - SAME_TIME:
            return np.zeros(len(np.asarray(nodes)), dtype=bool)
        return self._window.there(nodes, self._window.place(min(time, self.time), self.start))

    def marginalise(self, nodes: ArrayLike) -> None:
        """Nodes that disappear have no state at the next epoch; their information on their neighbours stays."""
        rows = self._layout.rows(nodes)
        if len(set(rows.tolist())) < len(rows):
            raise InputError("nodes: expected each node once")
        leaving = self._layout.nodes[rows]
        with self._changing():
            alone = np.array([node for node in leaving.tolist() if node not in self._keys], dtype=np.int64)
            self._layout, self._independent = self._layout.without(rows), self._independent.without(alone)
            gone = set(leaving.tolist())
            if self._tied is not None:
                self._tied_gaussian()
                known = self._tied.layout.nodes
                self._tied = self._tied.without(np.flatnonzero(np.isin(known, leaving)))
            self._keys = {node: key for node, key in self._keys.items() if node not in gone}
            self._labels = {node: label for node, label in self._labels.items() if node not in gone}
            self._note("marginalise", nodes)

    def posterior(self) -> BlockGaussian:
        """The joint Gaussian of all nodes."""
        if self._posterior is None:
            x = merged(self._layout, self._independent.x, self._tied_gaussian())
            if self._before is not None and len(unsettled := self.unsettled):
                x = not_smaller(x, predict(*self._before), unsettled)
            self._posterior = x
        return self._posterior

    @property
    def unsettled(self) -> IntArray:
        """Nodes with a variable, of any epoch that is kept, which has not settled."""
        self._tied_gaussian()  # by the present solution
        moving, keys = self._smoother.unsettled, (self._keys, *(epoch.keys for epoch in self._window.epochs))
        every = self._layout.nodes.tolist() if moving else []
        return np.array([n for n in every if any(of.get(n) in moving for of in keys)], dtype=np.int64)

    def graph(self) -> SceneFactorGraph:
        """The running graph, with the variables and factors of the objects that nothing ties to others."""
        return self._whole().graph

    def smoothed(self) -> tuple[SmoothedState, ...]:
        """Every epoch within the lag, oldest first, of the nodes that are there now: given all measurements.

        A node is in those epochs only in which the graph has its variable.
        """
        return self._whole().smoothed(self._layout, self.start)

    def _whole(self) -> WholeGraph:
        return whole_graph(self._smoother.graph(), self._independent, self._window, self._labels)

    def snapshot(self) -> GraphState:
        """The whole state as a value, which can be pickled. iSAM2 begins anew from it: both go on to the same bits."""
        state = self._state()
        self.restore(state)
        return state

    def restore(self, state: GraphState) -> None:
        """Continue from a snapshot."""
        require_type("state", state, GraphState)
        if state.posterior is not None:
            state.posterior.check_shapes()
        self._smoother.restore(state.graph)
        self._layout, self._keys, self._independent = state.layout, state.keys, state.independent
        self._window, self._labels = state.window, state.labels
        self._auxiliary, self._predictions, self._before = state.auxiliary, state.predictions, state.before
        self._posterior, self._tied, self._stale = state.posterior, None, frozenset()

    def _state(self) -> GraphState:
        before = self._before if self._keys else None
        whole = self._smoother.graph(), self._layout, self._keys, self._independent, self._window, self._labels
        return GraphState(*whole, self._auxiliary, self._predictions, self._posterior, before)

    def _note(self, method: str, *arguments: Any) -> None:
        """Note a call, to come again after a late measurement."""
        if self.lag:
            self._window = self._window.called(method, *arguments)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Change the state, or leave it as it was where that fails."""
        before, smoother = dict(vars(self)), self._smoother
        self._smoother, self._posterior = smoother.copied(taking_over=True), None
        try:
            yield
        except BaseException:
            vars(self).update(before)
            raise

    def _extend(self, providers: Sequence[FactorProvider]) -> None:
        offered = IndependentVariables(self._independent, self._labels)
        self._smoother.extend(providers, offered)
        self._tied = None
        self._took_over(offered.taken)

    def _tie(self, nodes: IntArray) -> None:
        """Make variables of iSAM2 of those nodes that are none yet; the next solution takes them in."""
        new = self._independent.components_of(nodes)
        if len(new) == 0:
            return
        known = self._smoother.graph().variables
        back = [
            key
            for node in new.tolist()
            for epoch in self._window.epochs
            if (key := node_key(node, epoch.number)) in known
        ]
        if back:  # of nodes that had left at this epoch
            self._smoother.marginalise(back)
            self._smoother.extend([])
        offered = IndependentVariables(self._independent, self._labels)
        self._smoother.change(lambda graph: offered.tie(graph, new))
        self._tied = None
        self._took_over(offered.taken)

    def _took_over(self, taken: Mapping[int, Mapping[int, int]]) -> None:
        """Note which independent objects have become variables: keys by id, by the number of the epoch."""
        if not taken:
            return
        self._window = self._window.with_keys(taken)
        now = taken[self._window.newest.number]
        self._keys = {**self._keys, **now}
        self._independent = self._independent.without(np.array(list(now), dtype=np.int64))

    def _begin_anew(self, x: BlockGaussian, elimination: Elimination) -> None:
        """Begin the graph anew from what is known: the filter's posterior is the prior of the next interval."""
        newest = self._window.newest
        self._smoother.clear(elimination)
        self._independent = IndependentObjects.begun(newest.number, newest.time, x)
        self._keys, self._tied = {}, None
        self._window = self._window.without(set(x.layout.nodes.tolist()))

    def _release_independent(self) -> None:
        """Take those objects out of iSAM2 that are no longer correlated with anything there."""
        if not self._keys:
            return
        graph = self._smoother.graph()
        x = self._joint(key for key in self.others if key in graph.variables)
        free = uncoupled(graph, x, self._keys)
        if free:
            self._smoother.marginalise(key for keys in free.values() for key in keys)
            alone = x.only(np.array(list(free), dtype=np.int64)).decoupled()
            self._independent = self._independent.with_released(self._layout, alone)
            self._keys = {node: key for node, key in self._keys.items() if node not in free}
            self._window, self._tied = self._window.without(set(free)), None

    def _begin_epoch(
        self, x: BlockGaussian, transition: Transition, dynamics: Dynamics, number: int, time: float
    ) -> None:
        """Begin the epoch in iSAM2, with the interaction factors of its nodes; x: of all nodes before it."""
        tied, still = np.array([node in self._keys for node in x.layout.nodes.tolist()], dtype=bool), dynamics.unchanged
        carried_over = set(x.layout.nodes[still & tied].tolist())
        keys = {n: key if n in carried_over else node_key(n, number) for n, key in self._keys.items()}
        unused = tied & still
        change = None
        if tied.any():
            rows = np.flatnonzero(tied)
            x = x.without(np.flatnonzero(~tied))
            of_tied = dynamics.of_nodes(x.layout)
            chosen = lossy(x, of_tied, still[rows], self._smoother.graph().elimination)
            if chosen.any():
                change = self._predict_by_covariance(x, of_tied, chosen, keys)
            unused[rows] |= chosen
            if unused.any():
                transition = with_noise(transition, np.isin(transition.nodes, self._layout.nodes[unused]))
        moved = Interactions(transition, self._keys, carried_over)
        begun = [moved, *predictors(self.providers)]
        offered = IndependentVariables(self._independent, self._labels) if self.providers else None
        since, kept = min(self.time, time - self.lag), {*self._keys.values(), *keys.values(), *self._auxiliary}
        self._smoother.begin(time, begun, [self._keys[node] for node in carried_over], change, offered)
        self._smoother.forget(kept, since)  # its tree has just been eliminated in the order of time
        self._keys, self._tied = keys, None
        self._auxiliary += self._auxiliary_now()

    def _auxiliary_now(self) -> tuple[int, ...]:
        """Variables of the present epoch beside the nodes."""
        graph, nodes = self._smoother.graph(), set(self._keys.values())
        return tuple(k for k, one in graph.variables.items() if one.epoch == graph.epoch and k not in nodes)

    def _predict_by_covariance(
        self, x: BlockGaussian, dynamics: Dynamics, chosen: BoolArray, keys: Mapping[int, int]
    ) -> Callable[[SceneFactorGraph], None]:
        """Return the change of the graph that predicts the components of the `chosen` nodes (n,) of `x` by covariances.

        The variables beside the nodes are part of their components.
        """
        every = self._smoother.graph().variables
        auxiliary = {key: key for key, one in every.items() if one.epoch is None or key in self._auxiliary}
        if auxiliary:
            self._smoother.extend([])  # with the nodes that have just become variables
            x = self._joint(auxiliary)
        others = np.arange(len(dynamics.layout), len(x.layout))
        moved = by_covariance(x, dynamics.with_static(x.layout, others), chosen)
        earlier, now = ({**auxiliary, **nodes} for nodes in (self._keys, keys))
        return lambda graph: replace_by_prior(graph, moved, earlier, now)

    def _tied_gaussian(self) -> BlockGaussian:
        """The joint Gaussian of the nodes that are variables of iSAM2; what has not changed is not read again."""
        known, stale = self._tied, self._stale
        if known is None:
            self._tied = self._joint() if self._keys else BlockGaussian.empty()
        elif stale:
            label = known.partition.label
            changed = np.isin(label, label[known.layout.rows(sorted(stale))])
            layout = known.layout.select(changed)
            now = self._smoother.joint_gaussian(layout, [self._keys[node] for node in layout.nodes.tolist()])
            self._tied = merged(known.layout, known.without(np.flatnonzero(changed)), now)
        self._stale = frozenset()
        return self._tied or BlockGaussian.empty()

    def _joint(self, auxiliary: Iterable[int] = ()) -> BlockGaussian:
        """The joint Gaussian of iSAM2's nodes, then of other variables, by increments from the base."""
        every = self._smoother.graph().variables
        layout = self._layout.select(np.array([node in self._keys for node in self._layout.nodes.tolist()], dtype=bool))
        for key in auxiliary:
            layout = layout.extended([key], every[key].dim)
        return self._smoother.joint_gaussian(layout, [self._keys.get(node, node) for node in layout.nodes.tolist()])

    def _update_now(self, kinds: Sequence[Measurements | Observations]) -> None:
        """Take in measurements of the present epoch."""
        self._tie(np.concatenate([np.empty(0, dtype=np.int64), *(one.nodes for one in kinds if not one.linear)]))
        held: list[Measurements | Observations] = []
        for one in kinds:
            tied = np.array([node in self._keys for node in one.nodes.tolist()])
            if tied.any():
                held.append(one if tied.all() else one.only(tied))
            if not tied.all():
                assert isinstance(one, Measurements)
                self._independent = self._independent.updated(one.only(~tied))
        if held:
            alike = self._tied is not None and not self._smoother.nonlinear
            self._smoother.extend([DetectionFactors(one, self._keys) for one in held])
            nodes = {node for one in held for node in one.nodes.tolist()}
            self._tied, self._stale = (self._tied, self._stale | nodes) if alike else (None, frozenset())

    def _update_past(self, kinds: Sequence[Measurements | Observations], k: int, time: float) -> None:
        """Go back to epoch k, take in measurements made at `time`, and go on again."""
        epochs = self._window.epochs[k:]
        for one in kinds:
            if not (there := self._window.there(one.nodes, k)).all():
                raise UnknownNodeError(f"node {one.nodes[~there][0]} is not remembered at {time:.6f} s")
        now, transition = (self._smoother.frame, self._smoother.origin), epochs[0].transition
        assert transition is not None
        state = epochs[0].state
        self.restore(replace(state, window=state.window.with_states(self._window)))
        if time > epochs[0].time + SAME_TIME:
            first, rest = IntervalDynamics(transition).split(time - epochs[0].time)
            self.predict(first.transition)
            transition = rest.transition
        self.update(kinds)
        for epoch in epochs[1:]:
            assert transition is not None
            self.predict(transition)
            for call in epoch.calls:
                getattr(self, call.method)(*call.arguments)
            transition = epoch.transition
        self._smoother.frame, self._smoother.origin = now
