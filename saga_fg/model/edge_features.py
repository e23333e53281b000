"""Features of a pair of nodes for edge rules: position and motion of the source of an edge relative to its target.

ahead, lateral   where the source is along the path of the target, and beside it (left is positive), m
turn             direction of that path at the source less the heading of the source, in [-pi, pi), rad

The path of a node without a predicted one (`saga_fg.model.paths`) is the arc from its heading to that of the source,
whose way is taken for that of its first tangent: it is aside by ahead tan(turn / 2).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.model.interactions import NodeTable
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle

STEEPEST = 1.5  # rad, turn of an arc


class EdgeFeatures(NamedTuple):
    """Features of edges (...), see the module; distance m, velocity_difference m/s, speeds m/s, has_moved 0 to 1."""

    ahead: FloatArray
    lateral: FloatArray
    turn: FloatArray
    distance: FloatArray
    velocity_difference: FloatArray
    target_speed: FloatArray
    source_speed: FloatArray
    target_moved: FloatArray
    source_moved: FloatArray


def features_of(nodes: NodeTable, target: IntArray, source: IntArray) -> EdgeFeatures:
    """The features (E,) of edges between rows of a table; without `has_moved` all nodes count as moved."""
    offset, difference = (column[source] - column[target] for column in (nodes.position, nodes.velocity))
    ahead, lateral, direction, known = nodes.along(target, source)
    turn = wrap_angle(direction - nodes.heading[source])
    arc = ahead * np.tan(np.clip(turn, -STEEPEST, STEEPEST) / 2)
    speed = np.hypot(*nodes.velocity.T)
    moved = np.ones(len(nodes)) if nodes.has_moved is None else np.asarray(nodes.has_moved, dtype=np.float64)
    return EdgeFeatures(
        ahead,
        np.where(known, lateral, lateral + arc),
        turn,
        np.hypot(*offset.T),
        np.hypot(*difference.T),
        speed[target],
        speed[source],
        moved[target],
        moved[source],
    )
