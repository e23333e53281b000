"""Duplicate detections: of two detections of one class that are too close to be two objects, the weaker goes."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.boxes import Boxes


def strongest(boxes: Boxes, probability: FloatArray, distance: FloatArray) -> IntArray:
    """Rows of the boxes that stay, ascending.

    boxes (n); probability (n,); distance (n,): centres of one class closer than this, m, belong to one object. Greedy
    from the most probable down, so that a suppressed box suppresses no other.
    """
    if len(boxes) < 2:
        return np.arange(len(boxes))
    position = boxes.position[:, :2]
    pairs = cKDTree(position).query_pairs(float(distance.max()), output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    apart = np.hypot(*(position[a] - position[b]).T)
    rival = (boxes.label[a] == boxes.label[b]) & (apart < np.minimum(distance[a], distance[b]))
    a, b = a[rival], b[rival]
    swap = probability[b] > probability[a]
    strong, weak = np.where(swap, b, a), np.where(swap, a, b)
    alive = np.ones(len(boxes), dtype=bool)
    for k in np.argsort(-probability[strong], kind="stable"):
        if alive[strong[k]]:
            alive[weak[k]] = False
    return np.flatnonzero(alive)
