"""Prediction: the state moves on along motions, courses and edges, to a frame or to times ahead.

Courses of vehicles are known from headings, or from the path that they are on. A track that is not detected goes on
along its path: that of earlier traffic where there is any (`saga_fg.tracking.traffic`), else that of its own heading
and turn. On it, it takes on the speed of earlier traffic, and its leaders are found. All is found anew for every
interval and recorded with it (`saga_fg.model.manoeuvres`).

For an interval the edges of the scene graph are those of its start:

    x(t + dt) = F x(t) + b + w,   w ~ N(0, Q)     with F, b and Q of the edges (`saga_fg.model.discretisation`)

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
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from saga_fg.kernels.paths import mean_courses
from saga_fg.model import Curvilinear, Following, KnownCourses, NodeTable, Paths, Unseen, build_graph, turning_time
from saga_fg.numerics import BoolArray, FloatArray, IntArray, of_classes, unchecked, wrap_angle
from saga_fg.tracking.edge_record import answers
from saga_fg.tracking.right_of_way import INTERVAL, PERSON
from saga_fg.tracking.track_filters import MOVING, TURNING, Kinematics
from saga_fg.tracking.track_life import reported_rows, untrackable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.traffic import STEP, paths, straight_paths
from saga_fg.types import HIDDEN, VEHICLES, Hypothesis, PredictedMode, PredictedTracks

ACROSS = 0.3  # m/s, deviation of the velocity of a vehicle across its path: it moves within its lane
LEAVING = 1.0  # m/s, where no earlier traffic tells the path: it may turn, or leave its lane
WIDEST = 0.3  # rad, of a course, however slow the vehicle
TURNING_OFF = 0.05  # share of vehicles that begin to turn where no earlier traffic tells it
HARDEST_TURN = 2.0  # m/s^2, across the path: of fast vehicles, comfort limits the turn
SHARPEST_TURN = 4.0  # m/s^2, across the path, that drivers hardly exceed (Reymond et al., Human Factors 43, 2001)
TURNING_TIME = 1.0  # s: a path is not known better than by what it turns within this time
FLOW_TIME = 3.0  # s, in which a vehicle takes on the speed of earlier traffic
STEPS = 20  # of a path, as far as leaders are looked for
_ASTRAY = 0.5  # rad between heading and motion, from which the motion is noise
_TINY = 1e-9  # so that nothing is divided by 0


def predicted_paths(state: TrackerState, unseen: BoolArray, dt: float) -> Paths:
    """The paths of the `unseen` (n,) vehicles that keep to their courses, of `STEPS` steps, in local positions.

    dt  s, until they are predicted anew
    """
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
    heading = mean_courses(box.yaw[rows], box.yaw_variance[rows], v, P, _ASTRAY, _TINY)
    lasting = np.maximum(speed, MOVING)
    sharpest = SHARPEST_TURN / lasting[:, None] * np.column_stack([np.full(len(rows), dt), STEP / lasting])
    found = paths(state.traffic, table.id[rows], now.position + state.origin, heading, curvature, sharpest, STEPS)
    return unchecked(Paths, **vars(found) | {"row": rows, "position": found.position - state.origin})


def known_courses(state: TrackerState, dt: float, paths: Paths) -> tuple[tuple[KnownCourses, ...], FloatArray]:
    """The courses of vehicles with a heading over the next `dt` s, by motion; their turn rates are predicted after.

    Returned as well: the headings after it (n,), rad, of those that keep to their `paths`, NaN of others.
    """
    table, (place, velocity, *_) = state.table, state.kinematics()
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
            own, distance = paths.select(path[rows[led]]), speed[led] * dt
            turn = _at(own.heading, distance) - own.heading[:, 0]
            heading[led] = own.heading[:, 0]
            coasting = table.coasting(state.time)[rows[led]]
            settling[led], across[led] = _across(own, speed[led], coasting, motion.course_time)
            typical, weight = typical_speed(own, distance)
            flow = weight / (weight + 1) * np.where(speed[led] > MOVING, typical - speed[led], 0.0) / FLOW_TIME
            vehicles = rows[led]
            if not state.map_nodes.beliefs:  # else lights say who goes
                ids = table.id[vehicles]
                flow = state.right_of_way.accelerations(ids, place[vehicles], heading[led], velocity[vehicles], flow)
            pull[led] = flow
            after[vehicles] = wrap_angle(heading[led] + turn)
            rate[led] = turn / turning_time(motion, dt)
        mean = state.joint.estimator.mean(table.id[rows])
        ids, unseen = table.id[rows], Unseen(settling, across, pull)
        found.append(KnownCourses.from_turn_rates(node_type, ids, heading, rate, variance, mean, dt, unseen))
    if turn_time.any():
        table.turn.predict(dt, turn_time)
    return tuple(found), after


def typical_speed(paths: Paths, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The speed (k,) of earlier traffic at a distance (k,), m, along k paths, m/s, and its weight (k,)."""
    weight = _at(paths.weight, distance)
    return _at(paths.weight * paths.speed, distance) / np.maximum(weight, _TINY), weight


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
    return 2 * (own + off) / np.maximum(2 * own * course_time + off * unseen, _TINY), own + off


def _at(column: FloatArray, distance: FloatArray) -> FloatArray:
    """Values (k,) of a column (k, m + 1) of paths at a distance (k,), m, interpolated."""
    most, each = column.shape[1] - 1, np.arange(len(column))
    share = np.minimum(distance / STEP, most)
    k = np.minimum(share.astype(np.int64), most - 1)
    return np.asarray(column[each, k] + (share - k) * (column[each, k + 1] - column[each, k]))


log = logging.getLogger(__name__)

MIN_EXISTENCE = 0.1  # below, a coasting track that was never confirmed has no edges: most tracks, hardly an object
MAX_STEPS = 100  # that an interval is predicted in
LOOKAHEAD_STEP = 0.5  # s, the longest with the same edges; a shorter `max_step` counts


def predict_state(state: TrackerState, time: float, ahead: bool = False) -> None:
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
    """Compare what edges said of detected objects with what these did, let them say it again, judge right of way."""
    if state.settings.edge_prior == 1 or not any(answers(rule) for rule in state.rules):
        return
    nodes, seen, time = node_table(state), state.table.coasting(state.time) <= HIDDEN, state.time
    state.halting = state.halting.later(nodes, seen, time)
    state.edge_record = state.edge_record.later(state.rules, nodes, seen, time)
    if state.right_of_way.due(time):
        table = state.table
        able = table.confirmed & of_classes(table.label, VEHICLES)
        unmoved = np.flatnonzero(able & ~table.has_moved)
        place = nodes.position[unmoved] + state.origin
        able[unmoved] = ~state.traffic.passes_beside(table.box.yaw[unmoved], place)  # else it is parked
        found = Paths.concatenate([predicted_paths(state, able, INTERVAL), _walked_paths(state, nodes)])
        paths = found.select(np.argsort(found.row))
        state.right_of_way = state.right_of_way.later(nodes, paths, state.halting.lines, time)


def _walked_paths(state: TrackerState, nodes: NodeTable) -> Paths:
    """The paths of people."""
    table = state.table
    rows = np.flatnonzero(table.confirmed & (table.label == PERSON))
    found = straight_paths(table.id[rows], nodes.position[rows], nodes.heading[rows], STEPS)
    return unchecked(Paths, **vars(found) | {"row": rows})


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


def look_ahead(
    state: TrackerState, horizons: FloatArray, joint: bool = False, hypotheses: bool = False
) -> PredictedTracks:
    """Predict the reported tracks to `horizons` (H,), s; changes the state, which is to be a copy.

    Left out are tracks that can't be predicted to the last of them. joint: with their joint covariances. hypotheses:
    where edges answer for themselves, the modes of those that move are to wait, to follow and to go on.
    """
    newest, start, reported = state.clock.newest, state.time, state.table.id[reported_rows(state)]
    cases = _hypotheses(state) if hypotheses and state.settings.edge_prior < 1 else []
    tables, expected, moving, together = [], [], [], []
    for horizon in horizons.tolist():
        _predict_to(state, state.relative(newest) + horizon)
        rows = np.flatnonzero(np.isin(state.table.id, reported))
        tables.append(state.table.select(rows))
        expected.append(state.reported_kinematics(rows))
        moving.append(state.kinematics().select(rows))
        together.append(_joint_covariance(state, rows, expected[-1].P) if joint else np.empty((0, 0)))
    in_cases = [_kinematics_at(twin, horizons) for _, _, twin in cases]
    last = tables[-1]
    for each in in_cases:  # left out are tracks that can't be predicted in one of them
        last = last.select(np.flatnonzero(np.isin(last.id, each[-1][0])))
    kept = [np.flatnonzero(np.isin(table.id, last.id)) for table in tables]
    yaw = np.stack([table.box.yaw[k] for table, k in zip(tables, kept, strict=True)])
    of_pairs = [(2 * k[:, None] + [0, 1]).ravel() for k in kept]  # the coordinates of the tracks kept
    whole = np.stack([P[np.ix_(k, k)] for P, k in zip(together, of_pairs, strict=True)]) if joint else None
    still = [table.stationarity.select(k) for table, k in zip(tables, kept, strict=True)]
    none = np.zeros((len(last), 2)), np.zeros((len(last), 2, 2))
    standing = [Kinematics(one.position, none[0], one.P, none[1]) for one in still]
    stands = np.stack([one.probability for one in still]) * (state.settings.stationary_share > 0)
    moves = [now.select(rows) for now, rows in zip(moving, kept, strict=True)]
    modes = [PredictedMode("moving", 1 - stands, **_world_columns(state, moves))] if not cases else []
    for (name, share, twin), each in zip(cases, in_cases, strict=True):
        own = [now.select(np.flatnonzero(np.isin(ids, last.id))) for ids, now in each]
        p = np.array([share[node] for node in last.id.tolist()])
        modes.append(PredictedMode(name, (1 - stands) * p, **_world_columns(twin, own)))
    modes.append(PredictedMode("stationary", stands, **_world_columns(state, standing)))
    mean = _world_columns(state, [now.select(rows) for now, rows in zip(expected, kept, strict=True)])
    return PredictedTracks(
        newest,
        horizons,
        last.id,
        last.label,
        yaw=yaw,
        **mean,
        coasting=last.coasting(start),
        modes=tuple(modes),
        joint_covariance=whole,
    )


def _hypotheses(state: TrackerState) -> list[tuple[Hypothesis, dict[int, float], TrackerState]]:
    """Hypotheses of moving objects: name, probability by id, and a copy of the state in which it holds for all."""
    table = state.table
    nodes = node_table(state, predicted_paths(state, np.ones(len(table), dtype=np.bool_), LOOKAHEAD_STEP))
    governing = state.edge_record.governing(state.rules, state.halting, state.settings.edge_prior, state.time)
    follows, waits = np.zeros(len(nodes)), state.right_of_way.waiting(table.id)
    leading = {k: rule for k, rule in enumerate(state.rules) if isinstance(rule, Following) and answers(rule)}
    for number, rule in leading.items():
        if governing is not None:
            target, source, _ = rule.pairs(nodes)
            np.maximum.at(follows, target, governing(number, nodes, target, source))
    led = (1 - waits) * follows[: len(table)]
    shares: dict[Hypothesis, FloatArray] = {"waits": waits, "follows": led, "goes on": 1 - waits - led}
    found = []
    for name, share in shares.items():
        twin = state.copied()
        twin.right_of_way = state.right_of_way.decided(name == "waits")
        if name == "follows":
            twin.settings = replace(state.settings, edge_prior=1.0)
        elif name == "goes on":
            without = {number: replace(rule, rate=0.0) for number, rule in leading.items()}  # all keep their numbers
            twin.rules = tuple(without.get(number, rule) for number, rule in enumerate(state.rules))
        found.append((name, dict(zip(table.id.tolist(), share.tolist(), strict=True)), twin))
    return found


def _kinematics_at(state: TrackerState, horizons: FloatArray) -> list[tuple[IntArray, Kinematics]]:
    """Ids and kinematics of all tracks at each horizon; changes the state."""
    found = []
    for horizon in horizons.tolist():
        _predict_to(state, state.relative(state.clock.newest) + horizon)
        found.append((state.table.id, state.kinematics()))
    return found


def _world_columns(state: TrackerState, each: Sequence[Kinematics]) -> dict[str, Any]:
    """Columns (H, N, ...) of what is predicted in the world, by the kinematics of N tracks at each of H horizons."""
    position, velocity, P, P_velocity = (np.stack(columns) for columns in zip(*each, strict=True))
    return {
        "position": position + state.origin,
        "velocity": velocity,
        "position_covariance": P,
        "velocity_covariance": P_velocity,
    }


def _predict_to(state: TrackerState, time: float) -> None:
    """Predict to a time counted from the state's start, s, in short steps."""
    begin, elapsed = state.time, time - state.time
    steps = math.ceil(elapsed / LOOKAHEAD_STEP - 1e-9)
    for k in range(1, steps + 1):
        predict_state(state, time if k == steps else begin + k * elapsed / steps, ahead=True)


def _joint_covariance(state: TrackerState, rows: IntArray, own: FloatArray) -> FloatArray:
    """(2n, 2n) of the positions of the tracks `rows` (n,), whose own covariances are `own` (n, 2, 2)."""
    table, n = state.table.select(rows), len(rows)
    P = state.joint.position_covariance(table.id, table.label).reshape(n, 2, n, 2)
    if state.settings.stationary_share > 0:
        moves = np.where(table.coasting(state.time) > 0, 1 - table.stationarity.probability, 1.0)
        P = P * (moves[:, None] * moves)[:, None, :, None]
    P[np.arange(n), :, np.arange(n)] = own
    return np.asarray(P.reshape(2 * n, 2 * n))
