"""Which detections belong to which object: frame by frame, the assignment of least cost to given states.

    d^2 = (z - m)^T (P + R)^-1 (z - m)

The states may be a tracker's, or those of a smoother that knows the future too.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import assign, gate, mahalanobis


def attribute(
    label: StrArray,
    position: FloatArray,
    covariance: FloatArray,
    seen_label: StrArray,
    seen: FloatArray,
    noise: FloatArray,
    share: float,
    max_distance: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Rows of objects and of detections that belong together, at one moment.

    label (n,), position (n, 2), covariance (n, 2, 2), max_distance (n,) of objects; seen_label (m,), seen (m, 2),
    noise (m, 2, 2) of detections; share: of true pairs that the chi-square gate lets through
    """
    objects, detections = [], []
    for name in np.unique(label):
        a, b = np.flatnonzero(label == name), np.flatnonzero(seen_label == name)
        if len(b) == 0:
            continue
        d2, log_det = mahalanobis(position[a], covariance[a], seen[b], noise[b])
        apart = np.hypot(*np.moveaxis(seen[b][None] - position[a][:, None], -1, 0))
        limit = gate(share)
        possible = (d2 < limit) & (apart < max_distance[a][:, None])
        row, column = assign(d2 + log_det, possible, limit + log_det.max(initial=0.0))
        objects.append(a[row])
        detections.append(b[column])
    if not objects:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    return np.concatenate(objects), np.concatenate(detections)
