"""Duplicate detections: of two detections of one class that are too close to be two objects, the weaker goes.

Closer than `distance` always; closer than `shadow` where it has less than `ratio` of the other's probability: two
people may walk half a metre apart, but a weak detection that close to a strong one is most often its shadow.
Boxes of different classes stand in each other's place only where they overlap.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.overlap import paired_bev_iou, touching_pairs


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
    return _survivors(strong[rival], weak[rival], probability)


def of_one_class(boxes: Boxes, probability: FloatArray, overlap: FloatArray) -> IntArray:
    """Rows of the boxes that stay, ascending, of those that detectors take for several classes at once.

    boxes (n); probability (n,); overlap (n,): a box whose IoU, seen from above, with a more probable one of another
    class is larger than this goes; from 1 on it never does.
    """
    if len(boxes) < 2 or (overlap >= 1).all():
        return np.arange(len(boxes))
    a, b = touching_pairs(boxes, boxes)
    across = (a < b) & (boxes.label[a] != boxes.label[b])
    a, b = a[across], b[across]
    swap = probability[b] > probability[a]
    strong, weak = np.where(swap, b, a), np.where(swap, a, b)
    rival = paired_bev_iou(boxes.select(strong), boxes.select(weak)) > overlap[weak]
    return _survivors(strong[rival], weak[rival], probability)


def _survivors(strong: IntArray, weak: IntArray, probability: FloatArray) -> IntArray:
    """Rows that stay where strong[k] drives out weak[k]; the most probable have the first word."""
    alive = np.ones(len(probability), dtype=bool)
    for k in np.argsort(-probability[strong], kind="stable"):
        if alive[strong[k]]:
            alive[weak[k]] = False
    return np.flatnonzero(alive)
