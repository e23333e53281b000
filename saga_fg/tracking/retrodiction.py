"""Retrodict: positions of tracks at an earlier time, along their own motion, and covariances between them."""

from __future__ import annotations

import numpy as np

from saga_fg.model.interactions import POSITION
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.pairwise_costs import CrossCovariances
from saga_fg.tracking.out_of_sequence import moved_to_present, past_position
from saga_fg.tracking.tracker_state import TrackerState


def past_positions(state: TrackerState, delay: float) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 2) of all tracks `delay` s ago and their covariances (n, 2, 2)."""
    if delay == 0:
        now = state.kinematics()
        return now.position, now.P
    ids, estimator = state.table.id, state.joint.estimator
    position, P = np.zeros((len(ids), 2)), np.zeros((len(ids), 2, 2))
    for node_type, rows in state.joint.rows_by_type(state.table.label, moving=True):
        H, R = moved_to_present(node_type, node_type.selector(POSITION), np.zeros((2, 2)), delay)
        position[rows] = estimator.mean(ids[rows]) @ H.T
        P[rows] = H @ estimator.covariance(ids[rows]) @ H.T + R
    return position, P


def past_cross_covariances(state: TrackerState, delay: float) -> CrossCovariances:
    """Covariances between the positions `delay` s ago of correlated pairs of tracks, by rows."""
    groups = state.joint.rows_by_type(state.table.label, moving=True)
    group = np.zeros(len(state), dtype=np.int64)
    for number, (_, rows) in enumerate(groups):
        group[rows] = number
    x = state.joint.estimator.posterior()
    nodes = x.layout.rows(state.table.id)
    first, second = x.correlated(nodes)
    past = [past_position(node_type, delay) for node_type, _ in groups]
    C = np.zeros((len(first), 2, 2))
    for a, H_a in enumerate(past):
        for b, H_b in enumerate(past):
            pairs = np.flatnonzero((group[first] == a) & (group[second] == b))
            if len(pairs):
                C[pairs] = H_a @ x.between(nodes[first[pairs]], nodes[second[pairs]]) @ H_b.T
    return CrossCovariances(first, second, C)
