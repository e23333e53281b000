r"""Distances in the plane that are smooth at zero, where |d| has a tip and d / |d| no direction.

    r(d) = |d|                                    from |d| = w on
    r(d) = w / 8 (3 + 6 x^2 - x^4),   x = |d| / w   nearer

    u = dr/dd = d / q              q = |d|,   nearer 2 w / (3 - x^2)
    du/dd = (I - k u u^T) / q      k = 1,     nearer (q / w)^3

r is the even polynomial of degree 4 that meets |d| with two derivatives, so that u and du/dd are continuous: |u| <= 1,
u = 0 at d = 0, and du/dd is at most 3 / (2 w), its change at most 3 / w^2 per metre. Nothing changes from w on. Forces
between bodies of N-body simulations are softened within a radius in this way (Hernquist and Katz, Astrophysical Journal
Supplement 70, 1989, appendix A).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from factors.validation import FloatArray


class SoftDistance(NamedTuple):
    """r (...), m; u (..., 2), its gradient; q (...), m, and k (...), from which the derivative of u is."""

    value: FloatArray
    direction: FloatArray
    radius: FloatArray
    share: FloatArray

    def bend(self) -> FloatArray:
        """The derivative (..., 2, 2) of u, 1/m."""
        u = self.direction
        along = self.share[..., None, None] * u[..., :, None] * u[..., None, :]
        return np.asarray((np.eye(2) - along) / self.radius[..., None, None])


def soft_distance(d: FloatArray, width: float) -> SoftDistance:
    """Return the soft length of vectors d (..., 2), m; width: w > 0, m."""
    length = np.hypot(d[..., 0], d[..., 1])
    near = length < width
    square = np.where(near, length / width, 1.0) ** 2
    radius = np.where(near, 2 * width / (3 - square), length)
    return SoftDistance(
        np.where(near, width / 8 * (3 + square * (6 - square)), length),
        d / radius[..., None],
        radius,
        np.where(near, (radius / width) ** 3, 1.0),
    )
