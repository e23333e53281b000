"""The edges that rules find between the tracks of a result.

A result says nothing of the graph its tracks came from; but rules need only what a result has. So these are the edges
between the tracks as reported, whoever made them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from data_tools.metrics import SceneBoxes
from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.interactions import NodeTable
from saga_fg.model.node import ConstantVelocity, NodeType
from saga_fg.numerics.arrays import FloatArray, IntArray

MOVING = 2.0  # m/s, from which a track has moved
VELOCITY_VARIANCE = 1.0  # (m/s)^2, results do not give it

Edges = tuple[IntArray, IntArray, FloatArray]
"""Targets and sources (E,), rows of the table, and rates (E,), 1/s."""


def edges_of_moments(table: SceneBoxes, moments: int, rules: Sequence[EdgeRule]) -> Iterator[Edges]:
    """The edges of each moment."""
    node_type = NodeType("track", ConstantVelocity())
    moved: set[str] = set()
    for k in range(moments):
        rows = np.flatnonzero(table.frame == k)
        boxes = table.boxes.select(rows)
        velocity = np.nan_to_num(boxes.velocity)
        ids = table.id[rows]
        moved.update(ids[np.hypot(*velocity.T) > MOVING].tolist())
        heading = np.where(np.isfinite(boxes.yaw), boxes.yaw, np.arctan2(velocity[:, 1], velocity[:, 0]))
        nodes = NodeTable(
            np.arange(len(rows)),
            boxes.label,
            (node_type,) * len(rows),
            boxes.position[:, :2],
            velocity,
            heading,
            np.nan_to_num(boxes.size[:, 0]),
            np.full(len(rows), VELOCITY_VARIANCE),
            np.array([id_ in moved for id_ in ids.tolist()], dtype=np.bool_),
        )
        pairs = [rule.pairs(nodes) for rule in rules] if len(rows) > 1 else []
        none = np.empty(0, dtype=np.int64)
        yield (
            np.concatenate([none, *(rows[p.target] for p in pairs)]),
            np.concatenate([none, *(rows[p.source] for p in pairs)]),
            np.concatenate([np.empty(0), *(p.rate for p in pairs)]),
        )
