"""Predict: the state moves on along motions, courses and edges, to a frame or to times ahead.

For an interval the edges of the scene graph are those of its start:

x(t + dt) = F x(t) + b + w,   w ~ N(0, Q)   with F, b and Q of the graph's edges (`saga_fg.model.discretisation`)

Courses of vehicles are known when the state is predicted, from headings or from the path that they are on.

A track that is not detected goes on along its path: that of earlier traffic where there is any
(`saga_fg.tracking.traffic`), else that of its own heading and turn. On it, it takes on the speed of earlier traffic,
and its leaders are found. All is found anew for every interval and recorded with it (`saga_fg.model.turning`).

Look ahead: the tracks that are reported now at future times, predicted jointly, with edges that go on to act.

The interval to a horizon is predicted in steps of at most `STEP`, each with the edges of the estimates at its start: as
the leader slows down, gaps and rates change. With s the probability that a track is stationary, and P the joint
covariance of the filter, the covariance between tracks i and j is

    (1 - s_i) P_ij (1 - s_j)     i != j

since whether an object is stationary is its own affair; the mean and the block i = j are those of
`saga_fg.tracking.track_filters`. The calibration of reported covariances is left out: it is about the errors of
detections (`saga_fg.tracking.reporting`), which soon are the smaller part.

Effect of each edge of the scene graph on a prediction: the prediction with it less the one without it.

    effect of e on its target i = x_i(t + dt; all edges) - x_i(t + dt; all edges but e)

in position and velocity, from the estimates at the start of the interval (other components, such as an acceleration,
are taken as 0: edges act on them by nothing). As F has the sparsity of the graph, only the edges into i matter for i.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.kernels.paths import mean_courses
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import build_graph
from saga_fg.model.interactions import POSITION, VELOCITY, NodeTable, Paths
from saga_fg.model.motion import Curvilinear
from saga_fg.model.nonlinear_interactions import held
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.model.turning import KnownCourses, Unseen, turning_time
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, unchecked
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.reporting import reported_rows, untrackable
from saga_fg.tracking.track_filters import MOVING, TURNING
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.traffic import STEP, paths
from saga_fg.types.track import PredictedTracks

ACROSS = 0.3  # m/s, deviation of the velocity of a vehicle across its path: it moves within its lane
LEAVING = 1.0  # m/s, where no earlier traffic tells the path: it may turn, or leave its lane
WIDEST = 0.3  # rad, of a course, however slow the vehicle
TURNING_OFF = 0.05  # share of vehicles that begin to turn where no earlier traffic tells it
HARDEST_TURN = 2.0  # m/s^2, across the path: of fast vehicles, comfort limits the turn
TURNING_TIME = 1.0  # s: a path is not known better than by what it turns within this time
FLOW_TIME = 3.0  # s, in which a vehicle takes on the speed of earlier traffic
STEPS = 20  # of a path, as far as leaders are looked for
_ASTRAY = 0.5  # rad between heading and motion, from which the motion is noise
_LEAST = 1e-9


def predicted_paths(state: TrackerState, unseen: BoolArray) -> Paths:
    """The paths of the `unseen` (n,) vehicles that keep to their courses, of `STEPS` steps, in local positions."""
    table, headed = state.table, unseen & np.isfinite(state.table.box.yaw)
    rate = np.zeros(len(table))
    able = np.zeros(len(table), dtype=np.bool_)
    for node_type, rows in state.joint.rows_by_type(table.label, moving=True):
        if isinstance(node_type.motion, Curvilinear) and node_type.motion.course_time > 0:
            rows = rows[headed[rows]]
            able[rows] = True
            if node_type.motion.turn_time > 0:
                rate[rows] = table.turn.known(rows, node_type.motion.turning_share)[0]
    rows = able.nonzero()[0]
    now = state.kinematics().select(rows)
    speed = np.hypot(*now.velocity.T)
    curvature = np.where(speed > MOVING, rate[rows], 0.0) / np.maximum(speed, MOVING)
    box, v, P = table.box, now.velocity, now.P_velocity
    heading = mean_courses(box.yaw[rows], box.yaw_variance[rows], v, P, _ASTRAY, _LEAST)
    found = paths(state.traffic, table.id[rows], now.position + state.origin, heading, curvature, STEPS)
    return unchecked(Paths, **vars(found) | {"row": rows, "position": found.position - state.origin})


def known_courses(state: TrackerState, dt: float, paths: Paths) -> tuple[tuple[KnownCourses, ...], FloatArray]:
    """The courses of vehicles with a heading over the next `dt` s, by motion; their turn rates are predicted after.

    Returned as well: the headings after it (n,), rad, of those that keep to their `paths`, NaN of others.
    """
    table, velocity = state.table, state.kinematics().velocity
    turn_time, found, after = np.zeros(len(table)), [], np.full(len(table), np.nan)
    path = np.full(len(table), -1)
    path[paths.row] = np.arange(len(paths))
    for node_type, rows in state.joint.rows_by_type(table.label, moving=True):
        motion = node_type.motion
        if not isinstance(motion, Curvilinear):
            continue
        turn_time[rows] = motion.turn_time
        rows = rows[np.isfinite(table.box.yaw[rows])]
        if len(rows) == 0:
            continue
        rate, variance = table.turn.known(rows, motion.turning_share)
        speed = np.hypot(*velocity[rows].T)
        turns = (motion.turn_time > 0) & (speed > MOVING)
        rate, variance = np.where(turns, rate, 0.0), np.where(turns, variance, 0.0)
        heading, (settling, across, pull) = table.box.yaw[rows], np.zeros((3, len(rows)))
        led = (path[rows] >= 0).nonzero()[0]
        if len(led):
            own, way = paths.select(path[rows[led]]), speed[led] * dt
            turn = _at(own.heading, way) - own.heading[:, 0]
            heading[led] = own.heading[:, 0]
            coasting = table.coasting(state.time)[rows[led]]
            settling[led], across[led] = _across(own, speed[led], coasting, motion.course_time)
            typical, weight = typical_speed(own, way)
            pull[led] = weight / (weight + 1) * np.where(speed[led] > MOVING, typical - speed[led], 0.0) / FLOW_TIME
            after[rows[led]] = wrap_angle(heading[led] + turn)
            rate[led] = turn / turning_time(motion, dt)
        mean = state.joint.estimator.mean(table.id[rows])
        ids, unseen = table.id[rows], Unseen(settling, across, pull)
        found.append(KnownCourses.of(node_type, ids, heading, rate, variance, mean, dt, unseen))
    if turn_time.any():
        table.turn.predict(dt, turn_time)
    return tuple(found), after


def typical_speed(paths: Paths, way: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The speed (k,) of earlier traffic at some way (k,), m, along k paths, m/s, and its weight (k,)."""
    weight = _at(paths.weight, way)
    return _at(paths.weight * paths.speed, way) / np.maximum(weight, _LEAST), weight


def _across(paths: Paths, speed: FloatArray, unseen: FloatArray, course_time: float) -> tuple[FloatArray, FloatArray]:
    """Rate (k,), 1/s, with which the velocity across paths settles, and its variance (k,), (m/s)^2.

    It is that within the path, of the correlation time `course_time`, and that of those that have begun to turn off
    since they were seen, `unseen` (k,) s ago, with the acceleration a:

        s^2 = s_0^2 + a^2 t^2,   2 s^2 / k = 2 s_0^2 course_time + a^2 t^3      growth of the variance of the position
    """
    own = np.minimum(ACROSS**2 + (1 - paths.certainty) * LEAVING**2, (WIDEST * speed) ** 2)
    turn = _at(paths.heading, speed * TURNING_TIME) - paths.heading[:, 0]
    own = own + (paths.disagreement + turn**2) * speed**2
    off = (1 - paths.certainty) ** 2 * TURNING_OFF * np.minimum(TURNING * speed, HARDEST_TURN) ** 2 * unseen**2
    return 2 * (own + off) / np.maximum(2 * own * course_time + off * unseen, _LEAST), own + off


def _at(column: FloatArray, way: FloatArray) -> FloatArray:
    """Values (k,) of a column (k, m + 1) of paths at some way (k,), m, interpolated."""
    most, each = column.shape[1] - 1, np.arange(len(column))
    share = np.minimum(way / STEP, most)
    k = np.minimum(share.astype(np.int64), most - 1)
    return np.asarray(column[each, k] + (share - k) * (column[each, k + 1] - column[each, k]))


log = logging.getLogger(__name__)

LEAST_EXISTENCE = 0.1  # below, a coasting track that was never confirmed has no edges: most tracks, hardly an object
MOST_STEPS = 100  # that an interval is predicted in


def predict(state: TrackerState, time: float, ahead: bool = False) -> None:
    """Predict to a `time` counted from the state's start, s, which is not before the state's.

    ahead: of all detections to come, so that the headings of detected tracks too turn with their velocities.
    """
    settings, dt = state.settings, time - state.time
    if dt > 0 and not state.joint.empty:
        wanted = dt / settings.max_step
        steps = max(1, math.ceil(min(wanted, MOST_STEPS) - 1e-9))
        if wanted > MOST_STEPS:
            log.warning("%g s are predicted in %d steps, max_step asks for %.3g", dt, steps, wanted)
        for number in range(steps):
            _predict_step(state, dt / steps, ahead, watched=number == 0 and not ahead)
        state.table.box.predict(dt, state.class_values(state.table.label, "yaw_drift")[0])
    state.time = time


def _predict_step(state: TrackerState, dt: float, ahead: bool, watched: bool) -> None:
    """Predict by `dt` s with the edges of the present estimates; from vehicles `watched` now lights are inferred."""
    table = state.table
    unseen = ahead | (table.last_detected < state.time)
    noise = _predict_stationarity(state, dt)
    paths = predicted_paths(state, unseen)
    explained, nodes, lights = state.settings.explained_noise, node_table(state, paths), state.map_nodes
    if watched and lights.beliefs:
        lights.drivers = lights.drivers.later(nodes, state.rules, table.last_detected >= state.time, state.time)
    likely = table.confirmed | (table.existence >= LEAST_EXISTENCE) | (table.coasting(state.time) == 0)
    interacting = np.concatenate([likely, np.ones(len(nodes) - len(table), dtype=bool)])
    courses, heading = known_courses(state, dt, paths)
    state.graph = build_graph(nodes, state.rules, explained, noise, courses, interacting)
    before = state.kinematics().velocity
    state.joint.predict(state.graph, dt)
    table.box.turn_with(before, state.kinematics().velocity, unseen)
    table.box.yaw = np.where(np.isfinite(heading), heading, table.box.yaw)
    state.map_nodes.predict(dt)
    state.remove(untrackable(state))


def _predict_stationarity(state: TrackerState, dt: float) -> FloatArray | None:
    """Predict which tracks are stationary; return the factors on the process noise of all nodes."""
    stationarity = state.table.stationarity
    if state.settings.stationary_share == 0:
        return None
    stationarity.predict(dt, state.kinematics())
    return np.concatenate([stationarity.noise_scale, np.ones(len(state.ego) + len(state.map_nodes))])


def node_table(state: TrackerState, paths: Paths | None = None) -> NodeTable:
    """The present estimates as edge rules see them: the tracks with their `paths`, the vehicle, the nodes of the map.

    The direction of motion stands in for a heading that is not known. A confirmed track exists, hidden or not.
    """
    table, box, now = state.table, state.table.box, state.reported_kinematics()
    velocity, P = now.velocity, now.P_velocity
    moves = 1 - table.stationarity.probability if state.settings.stationary_share > 0 else 0.0
    tracks = NodeTable(
        table.id,
        table.label,
        state.joint.types_of(table.label),
        now.position,
        velocity,
        np.where(np.isfinite(box.yaw), box.yaw, np.arctan2(velocity[:, 1], velocity[:, 0])),
        np.where(np.isfinite(box.size[:, 0]), box.size[:, 0], 0.0),
        (P[:, 0, 0] + P[:, 1, 1]) / 2,
        np.where(table.has_moved, 1.0, moves),
        unseen=table.coasting(state.time),
        existence=np.where(table.confirmed, 1.0, table.existence),
        paths=paths,
    )
    nodes = tracks.append(state.ego.table(state.joint)) if len(state.ego) else tracks
    if len(state.map_nodes) == 0:
        return nodes
    return nodes.append(state.map_nodes.table(len(nodes), state.origin, state.joint))


LOOKAHEAD_STEP = 0.5  # s, the longest with the same edges; a shorter `max_step` counts


def look_ahead(state: TrackerState, horizons: FloatArray, joint: bool = False) -> PredictedTracks:
    """Predict the reported tracks to `horizons` (H,), s; changes the state, which is to be a copy.

    Left out are tracks that can't be predicted to the last of them. joint: with their joint covariances.
    """
    newest, reported = state.clock.newest, state.table.id[reported_rows(state)]
    tables, moments, together = [], [], []
    for horizon in horizons.tolist():
        _predict_to(state, state.relative(newest) + horizon)
        rows = np.flatnonzero(np.isin(state.table.id, reported))
        tables.append(state.table.select(rows))
        moments.append(state.reported_kinematics().select(rows))
        together.append(_joint_covariance(state, rows, moments[-1].P) if joint else np.empty((0, 0)))
    last = tables[-1]
    kept = [np.flatnonzero(np.isin(table.id, last.id)) for table in tables]
    moved = [now.select(rows) for now, rows in zip(moments, kept, strict=True)]
    position, velocity, P, P_velocity = (np.stack(columns) for columns in zip(*moved, strict=True))
    yaw = np.stack([table.box.yaw[k] for table, k in zip(tables, kept, strict=True)])
    of_pairs = [(2 * k[:, None] + [0, 1]).ravel() for k in kept]  # the coordinates of the tracks kept
    whole = np.stack([P[np.ix_(k, k)] for P, k in zip(together, of_pairs, strict=True)]) if joint else None
    place = position + state.origin
    return PredictedTracks(newest, horizons, last.id, last.label, place, velocity, yaw, P, P_velocity, whole)


def _predict_to(state: TrackerState, time: float) -> None:
    """Predict to a time counted from the state's start, s, in short steps."""
    begin, elapsed = state.time, time - state.time
    steps = math.ceil(elapsed / LOOKAHEAD_STEP - 1e-9)
    for k in range(1, steps + 1):
        predict(state, time if k == steps else begin + k * elapsed / steps, ahead=True)


def _joint_covariance(state: TrackerState, rows: IntArray, own: FloatArray) -> FloatArray:
    """(2n, 2n) of the positions of the tracks `rows` (n,), whose own covariances are `own` (n, 2, 2)."""
    table, n = state.table.select(rows), len(rows)
    P = state.joint.position_covariance(table.id, table.label).reshape(n, 2, n, 2)
    if state.settings.stationary_share > 0:
        moves = np.where(table.coasting(state.time) > 0, 1 - table.stationarity.probability, 1.0)
        P = P * (moves[:, None] * moves)[:, None, :, None]
    P[np.arange(n), :, np.arange(n)] = own
    return np.asarray(P.reshape(2 * n, 2 * n))


@dataclass(frozen=True, eq=False)
class EdgeEffect:
    """One edge: ids of its ends, its interaction and rate (1/s), how it moved (2,), m, and sped up (2,), m/s, i."""

    target: int
    source: int
    interaction: str
    rate: float
    position: FloatArray
    velocity: FloatArray


def edge_effects(graph: SceneGraph, dt: float, nodes: NodeTable) -> list[EdgeEffect]:
    """The effects of all edges of `graph` over `dt` s on nodes whose estimates (at least) `nodes` holds."""
    row_of = {id_: row for row, id_ in enumerate(nodes.id.tolist())}
    into: dict[int, list[Edges]] = {}
    for group in graph.edges:
        for k in range(len(group)):
            into.setdefault(int(group.target[k]), []).append(_single(group, k))
    effects = []
    for i, edges in into.items():
        together = _predicted(graph, i, edges, dt, nodes, row_of)
        for e, edge in enumerate(edges):
            change = together - _predicted(graph, i, edges[:e] + edges[e + 1 :], dt, nodes, row_of)
            ids = int(graph.nodes[i]), int(graph.nodes[edge.source[0]])
            effects.append(EdgeEffect(*ids, edge.interaction, float(edge.rate[0]), change[:2], change[2:]))
    for law_edges in graph.nonlinear:
        i, j = (graph.nodes[rows].tolist() for rows in (law_edges.target, law_edges.source))
        states = np.concatenate([nodes.position, nodes.velocity], axis=1)
        own, other = (states[[row_of[node] for node in ends]] for ends in (i, j))
        a = law_edges.law.accelerations(own, other, law_edges.given).value
        moved = held((law_edges.rate[:, None] * a)[:, :, None], dt)[:, :, 0]
        each = zip(i, j, law_edges.rate.tolist(), moved, strict=True)
        effects += [EdgeEffect(t, s, law_edges.interaction, rate, x[:2], x[2:]) for t, s, rate, x in each]
    return effects


def _single(group: Edges, k: int) -> Edges:
    one = slice(k, k + 1)
    triple = (group.A_self[one], group.A_other[one], group.b[one])
    return Edges(group.interaction, group.target[one], group.source[one], group.rate[one], *triple)


def _predicted(
    graph: SceneGraph, i: int, edges: Sequence[Edges], dt: float, nodes: NodeTable, row_of: dict[int, int]
) -> FloatArray:
    """Position and velocity (4,) of node row i after dt, if only `edges` (single ones, into i) act on it."""
    rows = [i, *sorted({int(edge.source[0]) for edge in edges})]
    place = {row: n for n, row in enumerate(rows)}
    local = tuple(
        Edges(
            edge.interaction,
            np.array([0]),
            np.array([place[int(edge.source[0])]]),
            edge.rate,
            edge.A_self,
            edge.A_other,
            edge.b,
        )
        for edge in edges
    )
    types = tuple(graph.types[row] for row in rows)
    transition = discretise(SceneGraph(graph.nodes[rows], types, local), dt)
    states = []
    for row, node_type in zip(rows, types, strict=True):
        x = np.zeros(node_type.dim)
        known = row_of[int(graph.nodes[row])]
        x[node_type.index(POSITION)] = nodes.position[known]
        if node_type.has(VELOCITY):
            x[node_type.index(VELOCITY)] = nodes.velocity[known]
        states.append(x)
    own = (transition.F_matrix @ np.concatenate(states) + transition.b)[: types[0].dim]
    return np.asarray(np.concatenate([own[types[0].index(POSITION)], own[types[0].index(VELOCITY)]]))
