"""Measurements that arrive late, as measurements of the present state, along the objects' own motion.

    x(t - delay) = exp(-A delay) (x(t) - w),   w ~ N(0, Q)
    z = H x(t - delay) + v = H exp(-A delay) x(t) + v',   v' ~ N(0, R + H exp(-A delay) Q exp(-A delay)^T H^T)

Source: Bar-Shalom, Update with out-of-sequence measurements in tracking, IEEE Transactions on Aerospace and Electronic
Systems 38(3), 2002; here without the correlation of w with the present estimate.
"""

from __future__ import annotations

import numpy as np

from saga_fg.model.discretisation import own_motion
from saga_fg.model.interactions import POSITION
from saga_fg.model.motion import NodeType
from saga_fg.numerics.arrays import FloatArray


def moved_to_present(node_type: NodeType, H: FloatArray, R: FloatArray, delay: float) -> tuple[FloatArray, FloatArray]:
    """H (..., m, d) and R (..., m, m) of a measurement `delay` s old, as one of the present state."""
    F, Q = own_motion(node_type, delay)
    H_past = H @ np.linalg.inv(F)
    return H_past, R + H_past @ Q @ np.swapaxes(H_past, -1, -2)


def past_position(node_type: NodeType, delay: float) -> FloatArray:
    """(2, d) matrix that takes the present state to the position `delay` s ago."""
    H = node_type.selector(POSITION)
    return H @ np.linalg.inv(own_motion(node_type, delay)[0]) if delay > 0 else H
