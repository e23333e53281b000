"""SAGA-KF itself: one Kalman filter over the joint state, extended by the factors of providers.

The joint state is that of all nodes of the scene graph (Sani et al., ICPR 2024).

    predict   m <- F m + b              P <- F P F^T + Q                    F block-sparse, Q block-diagonal
    update    S = H P H^T + R = L L^T   W = L^-1 H P    m <- m + W^T L^-1 (z - H m)    P <- P - W^T W

Interactions correlate the nodes of a connected graph, and no others: the covariance is kept as one dense block for each
component of nodes that have become correlated, and components of equal size are worked on together. A node that is
measured so rarely, or left its neighbours so long ago, that its correlation has decayed below rounding is split off.

Providers' factors in the Kalman filter: an extended Kalman filter on the newest variables of the running graph.

Once a frame the providers are asked, and what they give is linearised where the variables are then, robust losses
weighted there,

    || A delta - b ||      delta: increments of variables

and go with the prior of the components that they tie, || L^-1 delta ||, P = L L^T, into one triangle by QR, || R x - d
||: their posterior is N(R^-1 d, R^-1 R^-T). New variables have no prior but these factors.

Variables beside the nodes (landmarks, the vehicle's pose) are blocks of the joint Gaussian under their keys: increments
from the base, where each was first put (error state). Those of an epoch leave with the next one at which providers are
asked, after these have had the chance to tie the one to the other.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from factors import SingularSystemError
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.estimator import Estimator
from saga_fg.estimators.filtering import (
    ComponentBounds,
    Dynamics,
    Measured,
    Measurements,
    Observations,
    corrected,
    lost_in_rounding,
    predict,
)
from saga_fg.estimators.interval_dynamics import IntervalDynamics, replace_by_prior
from saga_fg.estimators.object_factors import prior_graph
from saga_fg.estimators.partition import BlockGaussian, StateLayout, checked_prior
from saga_fg.graph import (
    FactorProvider,
    GraphError,
    GraphView,
    LinearisationPoint,
    NewVariable,
    SceneFactorGraph,
    ask,
    insert_state,
    node_kind,
    predictors,
    solver_error,
)
from saga_fg.model import Transition
from saga_fg.numerics import FloatArray, IntArray, shallow_copy
from saga_fg.types import Frame

_NO_ROWS = np.empty(0, dtype=np.int64)
_UNDETERMINED = 1e-12  # share of its column that is left of a variable which the factors do not determine

Linear = tuple[list[int], FloatArray]  # keys and [A | b]


@dataclass(frozen=True, eq=False)
class AuxiliaryVariables:
    """The part of the running graph that a filter keeps beside its joint state.

    graph    variables without factors: those beside the nodes, and the nodes as they were when last asked
    labels   of nodes, by id
    """

    graph: SceneFactorGraph = field(default_factory=SceneFactorGraph)
    labels: Mapping[int, str] = field(default_factory=dict)

    def rows(self, layout: StateLayout) -> IntArray:
        """Rows of the auxiliary variables in the joint state."""
        known = self.graph.variables
        return np.array([row for row, node in enumerate(layout.nodes.tolist()) if node in known], dtype=np.int64)

    def dynamics(self, transition: Transition, x: BlockGaussian) -> Dynamics:
        """Dynamics of a transition over the nodes; the auxiliary variables stay as they are."""
        interval, others = IntervalDynamics(transition), self.rows(x.layout)
        if len(others) == 0:
            return interval.linearised(x.layout, x.mean)
        nodes = x.without(others)
        return interval.linearised(nodes.layout, nodes.mean).with_static(x.layout, others)

    def priors(self, x: BlockGaussian, time: float) -> SceneFactorGraph:
        """All that is known at `time`, as one prior for each component."""
        graph, ids = self.at(x, time)
        graph.marginalise([key for key in graph.variables if key not in ids])
        keys = {node: key for key, node in ids.items()}
        replace_by_prior(graph, x, keys, keys)
        return graph

    def at(self, x: BlockGaussian, time: float) -> tuple[SceneFactorGraph, dict[int, int]]:
        """The variables at `time`, and the id in the joint state of each that is in it, by key."""
        graph, joint = self.graph.copy(), x.layout.nodes.tolist()
        ids = {node: node for node in joint if node in graph.variables}
        if time > graph.time:
            graph.advance(time)
        else:  # asked again: the nodes have changed since
            graph.marginalise([key for key in graph.variables if key not in ids])
        _move(graph, x, ids)
        nodes = []
        for node, state in zip(joint, np.split(x.mean, x.layout.offsets[1:-1]), strict=bool(joint)):
            if node not in ids:
                kind, number = node_kind(node)
                nodes.append((node, NewVariable(kind, number, state, label=self.labels.get(node, ""))))
        keys = graph.add_variables("tracks", [new for _, new in nodes])
        return graph, ids | {key: node for key, (node, _) in zip(keys, nodes, strict=True)}


def asked(
    x: BlockGaussian,
    auxiliary: AuxiliaryVariables,
    providers: Sequence[FactorProvider],
    time: float,
    origin: FloatArray,
    frame: Frame | None,
    last: bool,
) -> tuple[BlockGaussian, AuxiliaryVariables]:
    """The joint state with what providers add at `time`; the epoch before leaves where they are the `last` ones.

    Raises `GraphError` for what the filter does not take.
    """
    bare, ids = auxiliary.at(x, time)
    graph, known, prior = bare.copy(), dict(ids), x
    view = GraphView(graph, lambda key: _covariance(prior, known, graph.point(), key), origin, frame)
    for provider in providers:
        ask(provider, graph, view)
    new = {key: one for key, one in graph.variables.items() if key not in bare.variables}
    factors = _linear(graph, ids, new)
    if alone := tuple(key for key in new if not graph.index.touching(key)):
        raise solver_error(graph.variables, graph.groups, SingularSystemError("", alone))
    if new:
        base = graph.base
        bare.add_variables(
            "",
            [
                NewVariable(one.kind, one.id, one.type.read(base, key), one.epoch is None, one.label, one.type)
                for key, one in new.items()
            ],
        )
        ids |= {key: key for key in new}
        for key, one in new.items():  # in the place of what the factors will say of it
            x = x.extended(x.layout.extended([key], one.dim), np.zeros((1, one.dim)), np.eye(one.dim)[None])
    x = _given(x, graph, ids, new, factors)
    leaving = [key for key, one in bare.variables.items() if last and one.epoch not in (None, bare.epoch)]
    bare.marginalise(leaving)
    x = x.without(x.layout.rows([key for key in leaving if key in ids]))
    _move(bare, x, ids)
    return x, AuxiliaryVariables(bare, auxiliary.labels)


def _given(
    x: BlockGaussian, graph: SceneFactorGraph, ids: Mapping[int, int], new: Collection[int], factors: Sequence[Linear]
) -> BlockGaussian:
    """The posterior given factors, which tie components together, and are all that is known of `new` variables."""
    rows = [x.layout.rows([ids[key] for key in keys]) for keys, _ in factors]
    first = np.concatenate([_NO_ROWS, *(its[:1].repeat(len(its)) for its in rows)])
    x = x.over(x.partition.joined(first, np.concatenate([_NO_ROWS, *rows])))
    layout, partition, mean, blocks = x.layout, x.partition, x.mean.copy(), [P.copy() for P in x.blocks]
    known, others = ~np.isin(layout.nodes, list(new)), layout.places(AuxiliaryVariables(graph).rows(layout))
    increment = np.zeros(len(mean))  # of nodes, whose factors are linearised where they are; of others from the base
    increment[others] = mean[others]
    label = np.array([partition.label[its[0]] for its in rows], dtype=np.int64)
    for number in np.unique(label).tolist():
        mine = np.flatnonzero(partition.label == number)
        places, old = layout.places(mine), layout.places(mine[known[mine]])
        try:
            W = np.linalg.inv(np.linalg.cholesky(x.joint(mine[known[mine]]))) if len(old) else np.empty((0, 0))
        except np.linalg.LinAlgError:
            raise lost_in_rounding(x.variances().max()) from None
        A = [_among(places, old, np.column_stack([W, W @ increment[old]]))]
        A += [_among(places, layout.places(rows[k]), factors[k][1]) for k in np.flatnonzero(label == number).tolist()]
        stacked, D = np.concatenate(A), len(places)
        upper = np.zeros((D, D + 1))
        triangle = np.linalg.qr(stacked, mode="r")[:D]
        upper[: len(triangle)] = triangle
        lost = np.abs(np.diagonal(upper)) <= _UNDETERMINED * np.linalg.norm(stacked[:, :-1], axis=0)
        if lost.any():
            nodes = layout.nodes[np.searchsorted(layout.offsets, places[lost], side="right") - 1]
            undetermined = tuple(key for key, node in ids.items() if node in nodes)
            raise solver_error(graph.variables, graph.groups, SingularSystemError("", undetermined))
        root = np.linalg.inv(upper[:, :-1])
        mean[places] += root @ upper[:, -1] - increment[places]
        blocks[partition.group[mine[0]]][partition.row[mine[0]]] = root @ root.T
    return BlockGaussian(partition, mean, tuple(blocks))


def _among(places: IntArray, own: IntArray, A: FloatArray) -> FloatArray:
    """[A | b] on the states at `own` places as one on those at `places`, ascending."""
    result = np.zeros((len(A), len(places) + 1))
    result[:, np.searchsorted(places, own)], result[:, -1] = A[:, :-1], A[:, -1]
    return result


def _move(graph: SceneFactorGraph, x: BlockGaussian, ids: Mapping[int, int]) -> None:
    """Put variables where the joint state has them."""
    values, base = graph.values, graph.base
    for key in ids.keys() & graph.variables.keys():
        one, state = graph.variable(key), x.mean[x.layout.places(x.layout.rows([ids[key]]))]
        values.erase(key)
        insert_state(values, one, one.type.retract(one.type.read(base, key), state) if ids[key] == key else state)
    graph.moved_to(values)


def _linear(graph: SceneFactorGraph, ids: Mapping[int, int], new: Collection[int]) -> list[Linear]:
    """All factors, on increments from the base. Raises `GraphError` for one on a node's state that is past."""
    point, result = graph.point(), []
    for number, held in graph.groups.items():
        for keys in held.factors.rows:
            old = [graph.variable(key) for key in keys if key not in ids and key not in new]
            if old or held.name is not None:
                expected = (
                    f"expected the newest states, {old[0]} is past" if old else "expected no name to replace it by"
                )
                names = ", ".join(str(graph.variable(key)) for key in keys)
                raise GraphError(
                    f"provider {held.provider}: {held.factors.name} on {names}: {expected}; the estimator kalman takes "
                    "a factor once and for all, isam2 and fixed-lag take this one"
                )
        result += [(list(one.keys()), np.array(one.augmentedJacobian())) for one in graph.linear(number, point)]
    return result


def _covariance(x: BlockGaussian, ids: Mapping[int, int], point: LinearisationPoint, key: int) -> FloatArray:
    """Marginal covariance of a variable; of a pose in its own frame."""
    if key not in ids:
        raise GraphError(f"{point.variables[key]}: expected a variable that was in the filter before this frame")
    P, D = x.joint(x.layout.rows([ids[key]])), point.transport(key)
    return P if D is None else D @ P @ D.T


_DECOUPLE_EVERY = 10  # predictions between looks for components that have fallen apart


@dataclass(frozen=True, eq=False)
class KalmanState:
    """The filter as a value: its Gaussian, how many predictions it has made, the time, s, and what `asked` keeps.

    Without providers it keeps nothing, and the value is made of numbers alone.
    """

    x: BlockGaussian
    predictions: int
    time: float
    auxiliary: AuxiliaryVariables | None


class JointKalmanFilter(Estimator):
    """The exact filter on the joint state. See `saga_fg.estimators.Estimator` for the methods.

    providers  asked by `ask_providers`, once a frame, for factors on the newest variables: an extended Kalman filter
    tolerance  correlation up to which nodes are taken for independent, and neighbours for independent inputs; 0: none
    max_component  largest number of nodes whose correlations are kept together, the strongest; None: any number

    Without bounds, as by default, the filter is exact.
    """

    def __init__(
        self, providers: Sequence[FactorProvider] = (), tolerance: float = 0.0, max_component: int | None = None
    ) -> None:
        if not 0 <= tolerance < 1:
            raise InputError(f"tolerance: expected a number from 0 to below 1, got {tolerance!r}")
        if max_component is not None and max_component < 1:
            raise InputError(f"max_component: expected a number of nodes >= 1, got {max_component!r}")
        self.providers = tuple(providers)
        self.bounds = ComponentBounds(tolerance, max_component or sys.maxsize) if tolerance or max_component else None
        self._state = BlockGaussian.empty()
        self._predictions = 0
        self._time = 0.0
        self._auxiliary = AuxiliaryVariables()
        self._frame: Frame | None = None
        self._origin = np.zeros(2)

    def __copy__(self) -> JointKalmanFilter:
        return shallow_copy(self)

    @property
    def nodes(self) -> IntArray:
        nodes, others = self._state.layout.nodes, self.others
        return np.delete(nodes, others) if len(others) else nodes

    @property
    def time(self) -> float:
        return self._time

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        self.add_unchecked(np.asarray(nodes), *checked_prior(nodes, means, covariances), labels)

    def add_unchecked(
        self, nodes: IntArray, means: FloatArray, covariances: FloatArray, labels: Mapping[int, str] | None = None
    ) -> None:
        self._state = self._state.extended(self._state.layout.extended(nodes, means.shape[1]), means, covariances)
        if self.providers:
            self._auxiliary = replace(self._auxiliary, labels={**self._auxiliary.labels, **(labels or {})})

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        """Set the frame that providers see, and the origin (2,) of the states' positions in the world, m."""
        self._frame, self._origin = frame, origin

    def ask_providers(self) -> None:
        """Take in the providers' factors. Raises `GraphError` for one that is not on the newest variables alone."""
        x, auxiliary = self._state, self._auxiliary
        for providers, last in ((predictors(self.providers), False), (self.providers, True)):
            if providers:
                x, auxiliary = asked(x, auxiliary, providers, self._time, self._origin, self._frame, last)
        self._state, self._auxiliary = x, auxiliary

    @property
    def others(self) -> IntArray:
        """Rows of the variables beside the nodes, in the joint state: poses, landmarks."""
        return self._auxiliary.rows(self._state.layout)

    @property
    def auxiliary(self) -> SceneFactorGraph:
        """The auxiliary variables with their values, without factors."""
        return self._auxiliary.graph

    def predict(self, transition: Transition) -> None:
        dynamics = self._auxiliary.dynamics(transition, self._state)
        x, partition = self._state, None
        if self.bounds is not None:
            partition = self.bounds.components(x, dynamics)
        elif self._predictions % _DECOUPLE_EVERY == _DECOUPLE_EVERY - 1:
            x = dynamics.separated(x)
        self._state = predict(x, dynamics, partition)
        self._predictions += 1
        self._time += transition.dt

    def update(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None = None,
    ) -> float:
        """Take in measurements of the present; `time` can only be None, as nothing of the past is kept."""
        if time is not None:
            raise InputError("time: the filter has no past; expected measurements moved to the present")
        x, total = self._state, 0.0
        for each in measurements if isinstance(measurements, Sequence) else (measurements,):
            require_type("measurements", each, Measured)
            if len(rows := each.rows(x.layout)):
                x, log_likelihood = corrected(x, each.linearised(x.layout, x.mean, rows))
                total += log_likelihood
        self._state = x
        return total

    def marginalise(self, nodes: ArrayLike) -> None:
        self._state = self._state.without(self._state.layout.rows(nodes))
        if self.providers:
            leaving = set(np.asarray(nodes).tolist())
            labels = {node: label for node, label in self._auxiliary.labels.items() if node not in leaving}
            self._auxiliary = replace(self._auxiliary, labels=labels)

    def posterior(self) -> BlockGaussian:
        """The joint Gaussian."""
        return self._state

    def graph(self) -> SceneFactorGraph:
        """One joint prior a component: the filter keeps nothing of the past but this. With providers by name."""
        return (
            self._auxiliary.priors(self._state, self._time) if self.providers else prior_graph(self._state, self._time)
        )

    def snapshot(self) -> KalmanState:
        """The whole state, as a value."""
        return KalmanState(self._state, self._predictions, self._time, self._auxiliary if self.providers else None)

    def restore(self, state: KalmanState) -> None:
        """Continue from a snapshot, bit-identically."""
        require_type("state", state, KalmanState)
        state.x.check_shapes()
        self._state, self._predictions, self._time = state.x, state.predictions, state.time
        self._auxiliary = state.auxiliary or AuxiliaryVariables()
