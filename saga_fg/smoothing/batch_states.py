"""States of all objects at all moments given all detections, those at rest, and factors of users' own.

States of all objects at all moments of a recording, given all of its detections.

    prior         position unknown, velocity as of a new track             first moment of an object
    interaction   || x_i(k+1) - sum_j F_ij x_j(k) - b_i ||_{Q_i}            every interval, edges frozen
    detection     rho( || z - H x_i(k) ||_R )                              every assigned detection
    stationary    || v_i(k) ||_{d^2/dt I}, Q_i scaled                       while the object is stationary

over one factor graph (`saga_fg.estimators.RecordingSmoother`; long recordings in windows, which comes to the same
within a millimetre and does not keep all matrices of an hour; with factors of users' own the running graph itself). The
edges of an interval follow from given states at its start: those of an earlier, simpler pass. Robust losses
(`factors.robust`) are reached by reweighting between passes.

The velocity of a stationary object is zero with the covariance d^2/dt in every interval dt, by which its position
wanders by d in a second, whatever the rate of frames: as far as the vehicle's own poses drift. A recording of one
moment has no interval; there dt is a second.

A recording as a running graph, in which factors of users' own take part.

Objects are variables by id and moment, with the new objects, interactions and detections of the smoother in NumPy, and
start at its result, the states without the users' factors. `BatchSolver` solves everything at once.

Stationary objects, recognised from smoothed states and their detections.

A run of moments is a halt if the smoothed speed stays below `stationary_speed` for at least `MIN_STATIONARY`, and the
positions measured meanwhile do not drift: with the weighted regression

    z_k = p + u (t_k - t_mean) + e_k,   weights w_k = 2 / tr R_k,   u* = sum w (t - t_mean) z / sum w (t - t_mean)^2

the drift |u*| T over its duration T is below `stationary_drift`. A parked vehicle is stationary all its life.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from factors import Robust
from saga_fg.estimators import (
    BatchSolver,
    DetectionFactors,
    Interactions,
    Measurements,
    NewObjects,
    RecordingSmoother,
    SmoothedState,
)
from saga_fg.graph import OBJECT, Additions, FactorProvider, GraphView, key_of
from saga_fg.model import VELOCITY, NodeType, SceneGraph, Transition, discretise
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.smoothing.association import Evidence
from saga_fg.smoothing.settings import OfflineClass
from saga_fg.smoothing.states import Lifespans, StateTable
from saga_fg.types import class_settings, class_values

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RecordingEpoch:
    """A moment of the recording: how objects got here, who is new, what is measured, and ids of who goes afterwards."""

    moment: int
    transition: Transition | None
    new_objects: NewObjects
    measurements: Sequence[Measurements]
    gone: IntArray


@dataclass(frozen=True, eq=False)
class _At:
    """A provider whose objects begin at known states, by id."""

    provider: FactorProvider
    states: Mapping[int, FloatArray]

    @property
    def name(self) -> str:
        return self.provider.name

    def factors(self, view: GraphView) -> Additions:
        additions = self.provider.factors(view)
        return replace(additions, variables=[replace(new, state=self.states[new.id]) for new in additions.variables])


def states_in_graph(
    epochs: Sequence[RecordingEpoch],
    start: StateTable,
    evidence: Evidence,
    labels: Mapping[int, str],
    providers: Sequence[FactorProvider],
) -> StateTable:
    """Smoothed states with the users' factors; start: without them; labels of the objects by id.

    Raises `GraphError`, naming the provider, for what the graph does not take.
    """
    solver = BatchSolver()
    solver.origin = evidence.origin
    for epoch in epochs:
        rows = start.at(epoch.moment)
        states = dict(zip(start.id[rows].tolist(), start.mean[rows], strict=True))
        moved = [] if epoch.transition is None else [_At(Interactions(epoch.transition), states)]
        new = _At(replace(epoch.new_objects, labels=labels), states)
        solver.step(
            float(evidence.times[epoch.moment]), [*moved, new, *map(DetectionFactors, epoch.measurements), *providers]
        )
    if not solver.solve().converged:
        log.warning("the states with the factors of %s have not settled", ", ".join(one.name for one in providers))
    number = {epoch.moment: k for k, epoch in enumerate(epochs)}
    keys = [key_of(OBJECT, i, number[k]) for k, i in zip(start.moment.tolist(), start.id.tolist(), strict=True)]
    mean = np.array([solver.state(key) for key in keys]).reshape(start.mean.shape)
    covariance = np.array([solver.covariance(key) for key in keys]).reshape(start.covariance.shape)
    return replace(start, mean=mean, covariance=covariance)


@dataclass(frozen=True, eq=False)
class StationaryStates:
    """States (m,) of stationary objects: moments in ascending order, and ids.

    position_drift  standard deviation of their place after one second, m
    """

    position_drift: float
    moment: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    id: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def at(self, moment: int, ids: IntArray) -> BoolArray:
        """(n,) which of these objects are stationary at a moment."""
        first, last = np.searchsorted(self.moment, [moment, moment + 1])
        return np.isin(ids, self.id[first:last])


def stationary_states(
    states: StateTable,
    lifespans: Lifespans,
    evidence: Evidence,
    object_of: IntArray,
    position_drift: float,
    classes: Mapping[str, OfflineClass],
) -> StationaryStates:
    """The states in which objects are stationary, held by a `position_drift`, m."""
    order = np.lexsort((states.moment, states.id))
    ids, moments = states.id[order], states.moment[order]
    label = lifespans.label[lifespans.rows_of(ids)]
    max_speed, max_drift = class_values(classes, OfflineClass, label, "stationary_speed", "stationary_drift")
    slow = np.hypot(*states.mean[order, 2:].T) <= max_speed
    begins = np.flatnonzero(slow & np.concatenate([[True], (ids[1:] != ids[:-1]) | ~slow[:-1]]))
    ends = np.flatnonzero(slow & np.concatenate([(ids[1:] != ids[:-1]) | ~slow[1:], [True]]))
    times = evidence.times
    rows = np.flatnonzero(object_of >= 0)
    rows = rows[np.argsort(object_of[rows], kind="stable")]
    owner, seen_at = object_of[rows], evidence.moment[rows]
    kept: list[IntArray] = []
    for a, b in zip(begins.tolist(), ends.tolist(), strict=True):
        if times[moments[b]] - times[moments[a]] < MIN_STATIONARY:
            continue
        mine = slice(np.searchsorted(owner, ids[a]), np.searchsorted(owner, ids[a], side="right"))
        within = rows[mine][(seen_at[mine] >= moments[a]) & (seen_at[mine] <= moments[b])]
        if len(within) and _drift(evidence, within) <= max_drift[a]:
            kept.append(np.arange(a, b + 1))
    chosen = np.concatenate([np.empty(0, dtype=np.int64), *kept])
    chosen = chosen[np.argsort(moments[chosen], kind="stable")]
    return StationaryStates(position_drift, moments[chosen], ids[chosen])


def _drift(evidence: Evidence, rows: IntArray) -> float:
    """Drift of the measured positions of an object from its first to its last detection, m."""
    t = evidence.times[evidence.moment[rows]]
    w = 2 / np.trace(evidence.R[rows, :2, :2], axis1=1, axis2=2)
    dt = t - np.average(t, weights=w)
    spread = float(np.sum(w * dt**2))
    if spread == 0:
        return 0.0
    slope = (w * dt) @ evidence.boxes.position[rows, :2] / spread
    return float(np.hypot(*slope) * (t[-1] - t[0]))


MIN_STATIONARY = 1.0  # shortest stationary interval, s
LONG_RECORDING = 120.0  # s from which it is smoothed in windows
MAX_JOINT = 64  # objects that are smoothed jointly: their covariance takes half a megabyte
UNKNOWN_POSITION = 100.0  # standard deviation of a position at the first moment of an object, m
MIN_WEIGHT = 1e-4  # of a detection; at zero its noise would be infinite

GraphOf = Callable[[int, IntArray, tuple[NodeType, ...]], SceneGraph]
"""The graph over an interval: called with its first moment, the ids of the objects there, and their node types."""
NOISE_SCALE = 1e-4  # factor on the process noise while stationary


def no_edges(moment: int, ids: IntArray, types: tuple[NodeType, ...]) -> SceneGraph:
    """Objects that move on their own."""
    return SceneGraph(ids, types)


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """How the n objects of a recording move.

    velocity_prior  (n, 2, 2) covariance of their first velocities, m^2/s^2
    classes         settings of their motions
    graph_of        edges of an interval
    stationary      which are at rest, and when; None: none
    """

    velocity_prior: FloatArray
    classes: Mapping[str, OfflineClass]
    graph_of: GraphOf = no_edges
    stationary: StationaryStates | None = None


def smooth_states(
    evidence: Evidence,
    object_of: IntArray,
    lifespans: Lifespans,
    motion: ObjectMotion,
    weight: FloatArray | None = None,
    providers: Sequence[FactorProvider] = (),
) -> StateTable:
    """Smoothed states of every object at every moment of its life.

    object_of (N,) the object of each detection, negative for none
    weight    (N,) how much each detection counts, from 0 to 1 (see `robust_weights`), 1 if not given
    providers asked once a moment for factors of their own
    """
    parts = _epochs(
        evidence,
        object_of,
        lifespans,
        motion.velocity_prior,
        _node_types(lifespans, motion.classes),
        motion.graph_of,
        np.ones(len(evidence)) if weight is None else weight,
        motion.stationary or StationaryStates(np.nan),
    )
    epochs = list(parts) if providers else parts
    long = len(evidence.times) > 0 and evidence.times[-1] - evidence.times[0] > LONG_RECORDING
    states = _smoothed(epochs, RecordingSmoother(long, MAX_JOINT))
    if not providers:
        return states
    labels = dict(zip(lifespans.id.tolist(), lifespans.label.tolist(), strict=True))
    return states_in_graph(list(epochs), states, evidence, labels, providers)


def _epochs(
    evidence: Evidence,
    object_of: IntArray,
    lifespans: Lifespans,
    velocity_prior: FloatArray,
    types: Sequence[NodeType],
    graph_of: GraphOf,
    weight: FloatArray,
    stationary: StationaryStates,
) -> Iterator[RecordingEpoch]:
    """Everything from the first moment of an object to the last one."""
    start = _first_positions(evidence, object_of, lifespans)
    present = np.empty(0, dtype=np.int64)
    bounds = np.searchsorted(evidence.moment, np.arange(len(evidence.times) + 1))
    begin = int(lifespans.first.min(initial=len(evidence.times)))
    for k in range(begin, int(lifespans.last.max(initial=-1)) + 1):
        transition = None
        if k > begin:
            graph = graph_of(k - 1, lifespans.id[present], tuple(types[i] for i in present.tolist()))
            still = stationary.at(k - 1, graph.nodes) & stationary.at(k, graph.nodes)
            graph = replace(graph, diffusion_scale=np.where(still, NOISE_SCALE, graph.diffusion_scale))
            transition = discretise(graph, float(evidence.times[k] - evidence.times[k - 1]))
        new = np.flatnonzero(lifespans.first == k)
        P = np.zeros((len(new), 4, 4))
        P[:, :2, :2] = UNKNOWN_POSITION**2 * np.eye(2)
        P[:, 2:, 2:] = velocity_prior[new]
        new_objects = NewObjects(lifespans.id[new], np.concatenate([start[new], np.zeros((len(new), 2))], axis=1), P)
        present = np.concatenate([present, new])
        measured = _measured(evidence, object_of, slice(int(bounds[k]), int(bounds[k + 1])), weight)
        pinned = lifespans.id[present][stationary.at(k, lifespans.id[present])]
        if len(pinned):
            later = max(k, 1)
            interval = evidence.times[later] - evidence.times[later - 1] if len(evidence.times) > 1 else 1.0
            H, R = types[0].selector(VELOCITY), stationary.position_drift**2 / interval * np.eye(2)
            measured.append(Measurements(pinned, np.zeros((len(pinned), 2)), H, R))
        gone = lifespans.last[present] == k
        yield RecordingEpoch(k, transition, new_objects, measured, lifespans.id[present[gone]])
        present = present[~gone]


def _smoothed(epochs: Iterable[RecordingEpoch], smoother: RecordingSmoother) -> StateTable:
    """By recursions over the joint state, in NumPy."""
    parts: list[tuple[IntArray, FloatArray, FloatArray]] = []
    first = 0
    for count, epoch in enumerate(epochs):
        first = epoch.moment - count
        if epoch.transition is not None:
            smoother.predict(epoch.transition)
        smoother.add(epoch.new_objects.nodes, epoch.new_objects.means, epoch.new_objects.covariances)
        for measurements in epoch.measurements:
            smoother.update(measurements)
        smoother.marginalise(epoch.gone)
        parts += map(_marginals, smoother.final())
    parts += map(_marginals, smoother.finish())
    return StateTable.of_moments([(first + k, *part) for k, part in enumerate(parts) if len(part[0])])


def _marginals(state: SmoothedState) -> tuple[IntArray, FloatArray, FloatArray]:
    return state.nodes, state.mean(state.nodes), state.covariance(state.nodes)


def robust_weights(evidence: Evidence, object_of: IntArray, states: StateTable, loss: Robust) -> FloatArray:
    """(N,) weight of each detection at given states of its object, 1 where it has none: one step of iteratively
    reweighted least squares, which over the passes comes to the minimum of the robust loss."""
    weight = np.ones(len(evidence))
    at = states.rows_of(evidence.moment, object_of)
    rows = np.flatnonzero(at >= 0)
    residual = evidence.boxes.position[rows, :2] - states.mean[at[rows], :2]
    d2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(evidence.R[rows, :2, :2]), residual)
    weight[rows] = np.where(evidence.corrected[rows] > 0, 1.0, np.maximum(loss.weight(np.sqrt(d2)), MIN_WEIGHT))
    return weight


def _measured(evidence: Evidence, object_of: IntArray, rows: slice, weight: FloatArray) -> list[Measurements]:
    """The attributed detections of a moment."""
    mine = np.arange(rows.start, rows.stop)[object_of[rows] >= 0]
    measured = []
    for velocity in (True, False):
        chosen = mine[evidence.with_velocity[mine] == velocity]
        if len(chosen) == 0:
            continue
        k = 4 if velocity else 2
        z = np.concatenate([evidence.boxes.position[chosen, :2], evidence.boxes.velocity[chosen]], axis=1)[:, :k]
        R = evidence.R[chosen, :k, :k] / weight[chosen, None, None]
        measured.append(Measurements(object_of[chosen], z, np.eye(4)[:k], R))
    return measured


def _node_types(lifespans: Lifespans, classes: Mapping[str, OfflineClass]) -> list[NodeType]:
    """The node type of each object; classes that move alike share one."""
    types: dict[float, NodeType] = {}
    labels, number = np.unique(lifespans.label, return_inverse=True)
    motions = [class_settings(classes, OfflineClass, label).motion for label in labels.tolist()]
    found = [types.setdefault(motion.acceleration_noise, NodeType("object", motion)) for motion in motions]
    return [found[k] for k in number.tolist()]


def _first_positions(evidence: Evidence, object_of: IntArray, lifespans: Lifespans) -> FloatArray:
    """(n, 2) where each object was first detected."""
    position = np.zeros((len(lifespans), 2))
    rows = np.flatnonzero(object_of >= 0)[::-1]
    position[lifespans.rows_of(object_of[rows])] = evidence.boxes.position[rows, :2]
    return position
