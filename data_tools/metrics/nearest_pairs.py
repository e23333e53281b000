"""Pairs of boxes of the same frame and class: all within a gate, and the best one-to-one pairs among them.

Pairs of a frame do not depend on other frames or on identities, so trackers are compared on the same labels.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from data_tools.metrics.assignment import Candidates, best_pairs
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.boxes import Boxes

FrameBoxes = tuple[IntArray, Boxes]  # index of the frame (N,), and N boxes
Pairs = tuple[IntArray, IntArray, FloatArray]  # rows (P,) of the first and of the second table, distance (P,) in m


def near_pairs(first: FrameBoxes, second: FrameBoxes, gate: float) -> Pairs:
    """All pairs of the same frame and class within a horizontal distance of `gate` m, in order of their rows."""
    labels = np.unique(np.concatenate([first[1].label, second[1].label]))
    if not len(first[1]) or not len(second[1]):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
    origin = first[1].position[0, :2]
    # the third axis moves boxes of another frame or class out of reach
    a, b = (
        cKDTree(
            np.column_stack(
                [
                    boxes.position[:, :2] - origin,
                    3.0 * gate * (frame * len(labels) + np.searchsorted(labels, boxes.label)),
                ]
            )
        )
        for frame, boxes in (first, second)
    )
    near = a.sparse_distance_matrix(b, gate, output_type="ndarray")
    near = near[np.lexsort((near["j"], near["i"]))]
    return near["i"].astype(np.int64), near["j"].astype(np.int64), near["v"].copy()


def nearest_pairs(first: FrameBoxes, second: FrameBoxes, gate: float) -> Pairs:
    """One-to-one pairs of the same frame and class within `gate` m: as many as possible, then the nearest."""
    row, column, distance = near_pairs(first, second, gate)
    labels, label = np.unique(first[1].label, return_inverse=True)
    chosen = best_pairs(Candidates(row, column, distance, (first[0] * len(labels) + label)[row]))
    return row[chosen], column[chosen], distance[chosen]
