"""Overlap of oriented boxes: bird's-eye IoU, see `saga_fg.types.overlap`."""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.array_types import FloatArray
from saga_fg.kernels.compilation import kernel


@kernel("f2 f2 f1 f2 f2 f1 f")
def paired_overlaps(
    position: FloatArray,
    size: FloatArray,
    yaw: FloatArray,
    other_position: FloatArray,
    other_size: FloatArray,
    other_yaw: FloatArray,
    hair: float,
) -> FloatArray:
    """(n,) IoU of the footprints of n boxes and n others; NaN where a size or heading is unknown.

    hair: relative growth and shrinkage, so that common edges count once
    """
    n = len(yaw)
    result = np.zeros(n)
    signs_x, signs_y = (1.0, -1.0, -1.0, 1.0), (1.0, 1.0, -1.0, -1.0)
    x, y, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for i in range(n):
        hx, hy, gx, gy = size[i, 0] / 2, size[i, 1] / 2, other_size[i, 0] / 2, other_size[i, 1] / 2
        ox, oy = position[i, 0] - other_position[i, 0], position[i, 1] - other_position[i, 1]
        if math.isnan(hx + hy + gx + gy + yaw[i] + other_yaw[i]):
            result[i] = np.nan
            continue
        grown = hair * max(hx + hy, gx + gy)
        total = 0.0
        for turn in range(2):  # edges of the first in the frame of the second, and the other way round
            if turn == 0:
                ax, ay, bx, by, px, py = hx, hy, gx + grown, gy + grown, ox, oy
                own, frame = yaw[i], other_yaw[i]
            else:
                ax, ay, bx, by, px, py = gx, gy, hx - grown, hy - grown, -ox, -oy
                own, frame = other_yaw[i], yaw[i]
            c, s = math.cos(frame), math.sin(frame)
            mx, my = c * px + s * py, c * py - s * px
            c, s = math.cos(own - frame), math.sin(own - frame)
            for k in range(4):
                kx, ky = ax * signs_x[k], ay * signs_y[k]
                x[k], y[k] = mx + (c * kx - s * ky), my + (s * kx + c * ky)
            for k in range(4):
                dx[k], dy[k] = x[(k + 1) % 4] - x[k], y[(k + 1) % 4] - y[k]
            for k in range(4):
                run_x = 1e-300 if abs(dx[k]) < 1e-300 else dx[k]
                run_y = 1e-300 if abs(dy[k]) < 1e-300 else dy[k]
                x1, x2 = (-bx - x[k]) / run_x, (bx - x[k]) / run_x
                y1, y2 = (-by - y[k]) / run_y, (by - y[k]) / run_y
                enter = max(max(min(x1, x2), min(y1, y2)), 0.0)
                leave = min(min(max(x1, x2), max(y1, y2)), 1.0)
                share = max(leave - enter, 0.0)
                total += share * (x[k] * dy[k] - y[k] * dx[k]) if turn == 0 else share * 2 * gx * gy
        area, other_area = 4 * hx * hy, 4 * gx * gy
        common = min(max(total / 2, 0.0), min(area, other_area))
        result[i] = common / (area + other_area - common)
    return result
