"""Predict: the state moves on along the objects' own motion and the edges of the scene graph, frozen an interval long.

x(t + dt) = F x(t) + b + w,   w ~ N(0, Q)   with F, b and Q of the graph's edges (`saga_fg.model.discretisation`)
"""

from __future__ import annotations

import logging
import math

import numpy as np

from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.paths import Paths
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking.deletion import untrackable
from saga_fg.tracking.known_courses import known_courses, predicted_paths
from saga_fg.tracking.tracker_state import TrackerState

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
    if watched and lights.infers:
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
    settings, stationarity = state.settings.stationarity, state.table.stationarity
    if settings.prior == 0:
        return None
    stationarity.predict(dt, state.kinematics(), settings)
    return np.concatenate([stationarity.noise_scale(settings), np.ones(len(state.ego) + len(state.map_nodes))])


def node_table(state: TrackerState, paths: Paths | None = None) -> NodeTable:
    """The present estimates as edge rules see them: the tracks with their `paths`, the vehicle, the nodes of the map.

    The direction of motion stands in for a heading that is not known. A confirmed track exists, hidden or not.
    """
    table, box, now = state.table, state.table.box, state.reported_kinematics()
    velocity, P = now.velocity, now.P_velocity
    moves = 1 - table.stationarity.probability if state.settings.stationarity.prior > 0 else 0.0
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
    return state.map_nodes.appended_to(state.ego.appended_to(tracks, state.joint), state.origin, state.joint)
