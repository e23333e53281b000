r"""States of all objects at all moments of a recording, given all of its detections.

    prior         position unknown, velocity as of a new track             first moment of an object
    interaction   || x_i(k+1) - sum_j F_ij x_j(k) - b_i ||_{Q_i}            every interval, edges frozen
    detection     rho( || z - H x_i(k) ||_R )                              every assigned detection
    stationary    || v_i(k) ||_{d^2/dt I}, Q_i scaled                       while the object is stationary

over one factor graph (`saga_fg.estimators.BatchSmoother`; long recordings in windows, by `WindowedSmoother`, which
comes to the same within a millimetre and does not keep all matrices of an hour; with factors of users' own the running
graph itself, `saga_fg.smoothing.graph_states`). The edges of an interval follow from given states at its start: those
of an earlier, simpler pass. Robust losses (`factors.robust`) are reached by reweighting between passes.

The velocity of a stationary object is zero with the covariance d^2/dt in every interval dt, by which its position
wanders by d in a second, whatever the rate of frames: as far as the vehicle's own poses drift. A recording of one
moment has no interval; there dt is a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from factors import Robust
from saga_fg.estimators import BatchSmoother, Measurements, NewObjects, SmoothedState, WindowedSmoother
from saga_fg.graph import FactorProvider
from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import VELOCITY
from saga_fg.model.motion import NodeType
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.graph_states import RecordingEpoch, states_in_graph
from saga_fg.smoothing.settings import OfflineClass
from saga_fg.smoothing.states import Lifespans, StateTable
from saga_fg.smoothing.stationarity import StationaryStates
from saga_fg.types.by_class import class_settings

LONG_RECORDING = 120.0  # s from which it is smoothed in windows
MOST_JOINT = 64  # objects that are smoothed jointly: their covariance takes half a megabyte
UNKNOWN_POSITION = 100.0  # standard deviation of a position at the first moment of an object, m
LEAST_WEIGHT = 1e-4  # of a detection; at zero its noise would be infinite

GraphOf = Callable[[int, IntArray, tuple[NodeType, ...]], SceneGraph]
"""The graph over an interval: called with its first moment, the ids of the objects there, and their node types."""
NOISE_SCALE = 1e-4  # factor on the process noise while stationary


def no_edges(moment: int, ids: IntArray, types: tuple[NodeType, ...]) -> SceneGraph:
    """Objects that move on their own."""
    return SceneGraph(ids, types)


def smooth_states(
    evidence: Evidence,
    object_of: IntArray,
    lifespans: Lifespans,
    velocity_prior: FloatArray,
    classes: Mapping[str, OfflineClass],
    graph_of: GraphOf = no_edges,
    weight: FloatArray | None = None,
    stationary: StationaryStates | None = None,
    providers: Sequence[FactorProvider] = (),
) -> StateTable:
    """Smoothed states of every object at every moment of its life.

    object_of (N,) the object of each detection, negative for none; velocity_prior (n, 2, 2) covariance of the objects'
    first velocities; weight (N,) how much each detection counts, from 0 to 1 (see `robust_weights`), 1 if not given
    providers   asked once a moment for factors of their own
    """
    parts = _epochs(
        evidence,
        object_of,
        lifespans,
        velocity_prior,
        _node_types(lifespans, classes),
        graph_of,
        np.ones(len(evidence)) if weight is None else weight,
        stationary or StationaryStates(),
    )
    epochs = list(parts) if providers else parts
    long = len(evidence.times) > 0 and evidence.times[-1] - evidence.times[0] > LONG_RECORDING
    batch = partial(BatchSmoother, likelihoods=False, order="time")
    states = _smoothed(epochs, (WindowedSmoother if long else batch)(max_component=MOST_JOINT))
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
            H, R = types[0].selector(VELOCITY), stationary.settings.position_drift**2 / interval * np.eye(2)
            measured.append(Measurements(pinned, np.zeros((len(pinned), 2)), H, R))
        gone = lifespans.last[present] == k
        yield RecordingEpoch(k, transition, new_objects, measured, lifespans.id[present[gone]])
        present = present[~gone]


def _smoothed(epochs: Iterable[RecordingEpoch], smoother: BatchSmoother | WindowedSmoother) -> StateTable:
    """By recursions over the joint state, in NumPy."""
    states: list[SmoothedState] = []
    begin = 0
    for count, epoch in enumerate(epochs):
        begin = epoch.moment - count
        if epoch.transition is not None:
            smoother.predict(epoch.transition)
        smoother.add(epoch.new_objects.nodes, epoch.new_objects.means, epoch.new_objects.covariances)
        for measurements in epoch.measurements:
            smoother.update(measurements)
        smoother.marginalise(epoch.gone)
        if isinstance(smoother, WindowedSmoother):
            states += smoother.final()
    states += smoother.finish() if isinstance(smoother, WindowedSmoother) else smoother.smoothed()
    del smoother  # and the whole recording, before the states are copied
    parts = [(begin + k, s.nodes, s.mean(s.nodes), s.covariance(s.nodes)) for k, s in enumerate(states) if len(s.nodes)]
    return StateTable.of_moments(parts)


def robust_weights(evidence: Evidence, object_of: IntArray, states: StateTable, loss: Robust) -> FloatArray:
    """(N,) weight of each detection at given states of its object, 1 where it has none: one step of iteratively
    reweighted least squares, which over the passes comes to the minimum of the robust loss."""
    weight = np.ones(len(evidence))
    at = states.rows_of(evidence.moment, object_of)
    rows = np.flatnonzero(at >= 0)
    residual = evidence.boxes.position[rows, :2] - states.mean[at[rows], :2]
    d2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(evidence.R[rows, :2, :2]), residual)
    weight[rows] = np.maximum(loss.weight(np.sqrt(d2)), LEAST_WEIGHT)
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
    result = []
    for label in lifespans.label.tolist():
        motion = class_settings(classes, OfflineClass, label).motion
        result.append(types.setdefault(motion.acceleration_noise, NodeType("object", motion)))
    return result


def _first_positions(evidence: Evidence, object_of: IntArray, lifespans: Lifespans) -> FloatArray:
    """(n, 2) where each object was first detected."""
    position = np.zeros((len(lifespans), 2))
    rows = np.flatnonzero(object_of >= 0)[::-1]
    position[lifespans.rows_of(object_of[rows])] = evidence.boxes.position[rows, :2]
    return position
