"""Duplicate detections: of two detections of one class that are too close to be two objects, the weaker goes.

Closer than `distance` always; closer than `shadow` where it has less than `ratio` of the other's probability: two
people may walk half a metre apart, but a weak detection that close to a strong one is most often its shadow.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.boxes import Boxes


def strongest(
    boxes: Boxes, probability: FloatArray, distance: FloatArray, shadow: FloatArray, ratio: FloatArray
) -> IntArray:
    """Rows of the boxes that stay, ascending.

    boxes (n); probability, distance (m), shadow (m), ratio, each (n,). Greedy from the most probable down, so that a
    suppressed box suppresses no other.
    """
    if len(boxes) < 2:
        return np.arange(len(boxes))
    position = boxes.position[:, :2]
    pairs = cKDTree(position).query_pairs(float(max(distance.max(), shadow.max())), output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    apart = np.hypot(*(position[a] - position[b]).T)
    swap = probability[b] > probability[a]
    strong, weak = np.where(swap, b, a), np.where(swap, a, b)
    duplicate = apart < np.minimum(distance[a], distance[b])
    duplicate |= (apart < np.minimum(shadow[a], shadow[b])) & (probability[weak] < ratio[strong] * probability[strong])
    rival = (boxes.label[a] == boxes.label[b]) & duplicate
    strong, weak = strong[rival], weak[rival]
    alive = np.ones(len(boxes), dtype=bool)
    for k in np.argsort(-probability[strong], kind="stable"):
        if alive[strong[k]]:
            alive[weak[k]] = False
    return np.flatnonzero(alive)
