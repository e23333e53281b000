"""Edges of a recording: the tracker's rules at smoothed estimates, which use its future too.

An online edge depends on the estimates of its time; offline the same rules get smoothed positions, and whether an
object ever moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.motion import NodeType
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.smoothing.states import Lifespans, StateTable

MOVING = 2.0  # speed that is no estimation error, m/s
FACING = 1.0  # speed from which an object heads where it moves, m/s


@dataclass(frozen=True, eq=False)
class SmoothedEdges:
    """Graphs by edge rules at smoothed states; called with a moment, the ids of the objects there and their types.

    yaw (n,) and length (n,) of the objects by their detections, NaN where unknown
    """

    rules: Sequence[EdgeRule]
    explained_noise: float
    lifespans: Lifespans
    states: StateTable
    yaw: FloatArray
    length: FloatArray

    @cached_property
    def has_moved(self) -> BoolArray:
        """(n,) which objects are ever clearly in motion."""
        speed = np.hypot(*self.states.mean[:, 2:].T)
        sigma = np.sqrt(np.trace(self.states.covariance[:, 2:, 2:], axis1=1, axis2=2) / 2)
        moving = self.states.id[(speed > MOVING) & (speed > 3 * sigma)]
        return np.isin(self.lifespans.id, moving)

    def __call__(self, moment: int, ids: IntArray, types: tuple[NodeType, ...]) -> SceneGraph:
        at = self.states.rows_of(np.full(len(ids), moment), ids)
        rows, objects = np.flatnonzero(at >= 0), self.lifespans.rows_of(ids)
        mean, P = self.states.mean[at[rows]], self.states.covariance[at[rows]]
        label: StrArray = self.lifespans.label[objects[rows]]
        velocity = mean[:, 2:]
        course = np.arctan2(velocity[:, 1], velocity[:, 0])
        known = np.isfinite(self.yaw[objects[rows]]) & (np.hypot(*velocity.T) < FACING)
        nodes = NodeTable(
            ids[rows],
            label,
            tuple(types[row] for row in rows.tolist()),
            mean[:, :2],
            velocity,
            np.where(known, self.yaw[objects[rows]], course),
            np.nan_to_num(self.length[objects[rows]]),
            np.trace(P[:, 2:, 2:], axis1=1, axis2=2) / 2,
            self.has_moved[objects[rows]],
        )
        graph = build_graph(nodes, self.rules, explained_noise=self.explained_noise)
        if len(rows) == len(ids):
            return graph
        missing = np.setdiff1d(np.arange(len(ids)), rows)  # objects the states do not know move on their own
        return SceneGraph(
            np.concatenate([graph.nodes, ids[missing]]),
            (*graph.types, *(types[row] for row in missing.tolist())),
            graph.edges,
            np.concatenate([graph.diffusion_scale, np.ones(len(missing))]),
            graph.nonlinear,
        )
