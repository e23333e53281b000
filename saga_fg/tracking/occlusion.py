r"""How much of each tracked box is hidden behind another, as seen from a sensor: in the plane, box by box.

    covered_i = max over j nearer than i of   | [a_i, b_i] and [a_j, b_j] | / (b_i - a_i)

[a, b] is the interval of bearings that a box takes up. A box is nearer if its centre is by at least half its diagonal.
Heights are left out, so that a low object in front of a tall one counts for more than it hides.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.boxes import Boxes

HIDDEN = 0.5  # share from which nobody looks at a box


def covered(boxes: Boxes, viewpoint: FloatArray, opaque: BoolArray) -> FloatArray:
    """(n,) shares between 0 and 1; boxes of unknown size or heading neither hide nor are hidden.

    viewpoint (2,) in the frame of the boxes; opaque (n,): which boxes can hide others
    """
    known = np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw)
    rows = np.flatnonzero(known)
    share = np.zeros(len(boxes))
    if not (known & opaque).any():
        return share
    seen = boxes.select(rows)
    offset = seen.position[:, :2] - viewpoint
    distance, bearing = np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
    corners = seen.corners() - viewpoint
    turn = wrap_angle(np.arctan2(corners[..., 1], corners[..., 0]) - bearing[:, None])
    low, high = turn.min(axis=1), turn.max(axis=1)
    front = np.flatnonzero(opaque[rows])
    apart = wrap_angle(bearing[front] - bearing[:, None])  # of box j from box i
    common = np.minimum(high[:, None], apart + high[front]) - np.maximum(low[:, None], apart + low[front])
    nearer = distance[front] + np.hypot(*seen.size[front, :2].T) / 2 < distance[:, None]
    part = np.where(nearer, common, 0.0) / np.maximum(high - low, 1e-6)[:, None]
    share[rows] = np.clip(part.max(axis=1), 0.0, 1.0)
    return share
