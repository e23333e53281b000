"""One-to-one pairs of boxes of the same moment and class: as many as possible within a gate, then the nearest.

No memory and no identities: what is paired at a moment depends on that moment alone, so that two trackers are compared
on the same labels.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from data_tools.metrics.assignment import Candidates, optimal_pairs
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.boxes import Boxes


def nearest_pairs(
    first: tuple[IntArray, Boxes], second: tuple[IntArray, Boxes], gate: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows (P,) of the first and of the second table, and horizontal distances (P,), m, of at most `gate`.

    A table is (moment (N,), boxes (N)).
    """
    labels = np.unique(np.concatenate([first[1].label, second[1].label]))
    group = [moment * len(labels) + np.searchsorted(labels, boxes.label) for moment, boxes in (first, second)]
    if not len(group[0]) or not len(group[1]):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
    origin = first[1].position[0, :2]
    # boxes of another moment or class are out of reach along the third axis
    a, b = (
        np.column_stack([boxes.position[:, :2] - origin, 2.0 * gate * own])
        for (_, boxes), own in zip((first, second), group, strict=True)
    )
    near = cKDTree(a).sparse_distance_matrix(cKDTree(b), gate, output_type="ndarray")
    order = np.lexsort((near["j"], near["i"]))
    row, column, distance = (near[name][order] for name in ("i", "j", "v"))
    candidates = Candidates(row.astype(np.int64), column.astype(np.int64), distance, group[0][row])
    chosen = optimal_pairs(candidates, np.ones((len(candidates), 1), dtype=np.bool_))[:, 0]
    return candidates.row[chosen], candidates.column[chosen], candidates.cost[chosen]
