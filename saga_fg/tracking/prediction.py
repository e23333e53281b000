"""Predict: the state moves on along motions, courses and edges, to a frame or to times ahead.

For an interval the edges of the scene graph are those of its start:

x(t + dt) = F x(t) + b + w,   w ~ N(0, Q)   with F, b and Q of the graph's edges (`saga_fg.model.discretisation`)

Courses of vehicles are known when the state is predicted (`saga_fg.tracking.courses`).

Look ahead: the tracks that are reported now at future times, predicted jointly, with edges that go on to act.

The interval to a horizon is predicted in steps of at most `LOOKAHEAD_STEP`, each with the edges of the estimates at its
start: as the leader slows down, gaps and rates change. With s the probability that a track is stationary, and P the
joint covariance of the filter, the covariance between tracks i and j is

    (1 - s_i) P_ij (1 - s_j)     i != j

since whether an object is stationary is its own affair; the mean and the block i = j are those of
`saga_fg.tracking.track_filters`. The calibration of reported covariances is left out: it is about the errors of
detections (`saga_fg.tracking.track_life`), which soon are the smaller part.
"""

import logging
import math

import numpy as np

from saga_fg.model import NodeTable, Paths, build_graph
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.tracking.courses import known_courses, predicted_paths
from saga_fg.tracking.edge_record import answers
from saga_fg.tracking.track_life import reported_rows, untrackable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types import PredictedTracks

log = logging.getLogger(__name__)

SEEN = 0.3  # s since its last detection, for which an object counts as detected
MIN_EXISTENCE = 0.1  # below, a coasting track that was never confirmed has no edges: most tracks, hardly an object
MAX_STEPS = 100  # that an interval is predicted in
LOOKAHEAD_STEP = 0.5  # s, the longest with the same edges; a shorter `max_step` counts


def predict(state: TrackerState, time: float, ahead: bool = False) -> None:
    """Predict to a `time` counted from the state's start, s, which is not before the state's.

    ahead: of all detections to come, so that the headings of detected tracks too turn with their velocities.
    """
    settings, dt = state.settings, time - state.time
    if dt > 0 and not state.joint.empty:
        wanted = dt / settings.max_step
        steps = max(1, math.ceil(min(wanted, MAX_STEPS) - 1e-9))
        if wanted > MAX_STEPS:
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
    paths = predicted_paths(state, unseen, dt)
    explained, nodes, lights = state.settings.explained_noise, node_table(state, paths), state.map_nodes
    if watched and lights.beliefs:
        lights.drivers = lights.drivers.later(nodes, state.rules, table.last_detected >= state.time, state.time)
    likely = table.confirmed | (table.existence >= MIN_EXISTENCE) | (table.coasting(state.time) == 0)
    interacting = np.concatenate([likely, np.ones(len(nodes) - len(table), dtype=bool)])
    courses, heading = known_courses(state, dt, paths)
    prior = state.settings.edge_prior
    governing = state.edge_record.governing(state.rules, state.halting, prior, state.time)
    state.graph = build_graph(nodes, state.rules, explained, noise, courses, interacting, governing)
    before = state.kinematics().velocity
    state.joint.predict(state.graph, dt)
    table.box.turn_with(before, state.kinematics().velocity, unseen)
    table.box.yaw = np.where(np.isfinite(heading), heading, table.box.yaw)
    state.map_nodes.predict(dt)
    state.remove(untrackable(state))


def judge_edges(state: TrackerState) -> None:
    """Compare what edges said of detected objects with what these did, and let them say it again."""
    if state.settings.edge_prior == 1 or not any(answers(rule) for rule in state.rules):
        return
    nodes, seen, time = node_table(state), state.table.coasting(state.time) <= SEEN, state.time
    state.halting = state.halting.later(nodes, seen, time)
    state.edge_record = state.edge_record.later(state.rules, nodes, seen, time)


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
        id=table.id,
        label=table.label,
        types=state.joint.types_of(table.label),
        position=now.position,
        velocity=velocity,
        heading=np.where(np.isfinite(box.yaw), box.yaw, np.arctan2(velocity[:, 1], velocity[:, 0])),
        length=np.where(np.isfinite(box.size[:, 0]), box.size[:, 0], 0.0),
        velocity_variance=(P[:, 0, 0] + P[:, 1, 1]) / 2,
        has_moved=np.where(table.has_moved, 1.0, moves),
        unseen=table.coasting(state.time),
        existence=np.where(table.confirmed, 1.0, table.existence),
        paths=paths,
    )
    nodes = tracks.append(state.ego.table(state.joint)) if len(state.ego) else tracks
    here = state.map_nodes
    return nodes.append(here.table(len(nodes), state.origin, state.joint)) if len(here) else nodes


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
    return PredictedTracks(
        timestamp=newest,
        horizons=horizons,
        id=last.id,
        label=last.label,
        position=place,
        velocity=velocity,
        yaw=yaw,
        position_covariance=P,
        velocity_covariance=P_velocity,
        joint_covariance=whole,
    )


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
