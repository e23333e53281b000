"""Features of a pair of nodes for edge rules: position and motion of the source of an edge relative to its target.

ahead, lateral   offset of the source along and across the target's heading (left is positive), m
turn             heading of the target less that of the source, in [-pi, pi), rad
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from saga_fg.model.interactions import NodeTable
from saga_fg.numerics.arrays import FloatArray, IntArray


class EdgeEnds(NamedTuple):
    """One end of edges: position (..., 2) m, velocity (..., 2) m/s, heading (...) rad, has_moved (...) from 0 to 1."""

    position: FloatArray
    velocity: FloatArray
    heading: FloatArray
    has_moved: FloatArray


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


def edge_features(target: EdgeEnds, source: EdgeEnds) -> EdgeFeatures:
    """The features of edges between ends whose shapes broadcast."""
    offset, difference = source.position - target.position, source.velocity - target.velocity
    c, s = np.cos(target.heading), np.sin(target.heading)
    ahead = offset[..., 0] * c + offset[..., 1] * s
    lateral = offset[..., 1] * c - offset[..., 0] * s
    turn = (target.heading - source.heading + np.pi) % (2 * np.pi) - np.pi
    none = 0.0 * ahead
    return EdgeFeatures(
        ahead,
        lateral,
        turn,
        _norm(offset),
        _norm(difference),
        _norm(target.velocity) + none,
        _norm(source.velocity) + none,
        target.has_moved + none,
        source.has_moved + none,
    )


def features_of(nodes: NodeTable, target: IntArray, source: IntArray) -> EdgeFeatures:
    """The features (E,) of edges between rows of a table; without `has_moved` all nodes count as moved."""
    return edge_features(_ends(nodes, target), _ends(nodes, source))


def _ends(nodes: NodeTable, rows: IntArray) -> EdgeEnds:
    moved = np.ones(len(rows)) if nodes.has_moved is None else nodes.has_moved[rows].astype(np.float64)
    return EdgeEnds(nodes.position[rows], nodes.velocity[rows], nodes.heading[rows], moved)


def _norm(vector: FloatArray) -> FloatArray:
    """Length of (..., 2), with a derivative at zero."""
    return np.asarray(np.sqrt(vector[..., 0] ** 2 + vector[..., 1] ** 2 + 1e-12))
