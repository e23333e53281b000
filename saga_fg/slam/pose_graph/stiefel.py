r"""Minimum of a quadratic form over N orthonormal frames: a Riemannian trust region.

    min tr( Y^T Q Y ),     Y = ( Y_1; ...; Y_N ),  Y_i (d, r),  Y_i Y_i^T = 1

For r = d these are the rotations and reflections of d dimensions. Frames of more dimensions, r > d, are a relaxation
without bad minima where r is large enough. With G = Q Y, the tangent space at Y, and Lambda_i = sym(G_i Y_i^T),

    grad = 2 (G - Lambda Y),      Hess[V] = 2 P( Q V - Lambda V ),      P(V)_i = V_i - sym(V_i Y_i^T) Y_i

Steps come from truncated conjugate gradients with a preconditioner (Steihaug 1983, Toint 1981), and lead back to the
frames by the polar decomposition. Source: Absil, Mahony, Sepulchre, Optimization Algorithms on Matrix Manifolds
(2008), algorithms 10 and 11.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import FloatArray

Product = Callable[[FloatArray], FloatArray]
_ACCEPTED, _POOR, _GOOD = 0.05, 0.25, 0.9  # shares of the promised decrease: to take a step, to shrink, to grow
_ROUNDING = 1e-13  # of the cost: differences below are noise
_LEAST = 1e-11  # of the cost: a step that promises less, and does not hold it, meets rounding
_LEAST_RADIUS = 1e-12
_MOST_STEPS, _MOST_INNER = 200, 300


class Frames(NamedTuple):
    """Y (N, d, r), its cost, and the number of products with Q of the way there."""

    Y: FloatArray
    cost: float
    products: int


def multipliers(Y: FloatArray, V: FloatArray) -> FloatArray:
    """Symmetric parts (N, d, d) of V_i Y_i^T; of V = Q Y they are Lambda."""
    product = V @ Y.swapaxes(1, 2)
    return np.asarray((product + product.swapaxes(1, 2)) / 2)


def nearest_frames(V: FloatArray) -> FloatArray:
    """Orthonormal frames (N, d, r) nearest to V (N, d, r)."""
    U, _, Wt = np.linalg.svd(V, full_matrices=False)
    return np.asarray(U @ Wt)


def best_frames(
    Q: Product, preconditioner: Product, Y: FloatArray, tolerance: float, most_products: float = np.inf
) -> Frames:
    """A local minimum from a start Y (N, d, r). Q, preconditioner: products with (N d, r).

    tolerance: decrease that a step of the preconditioner still promises, relative to the cost; most_products: with Q,
    after which the way ends where it is
    """
    here = _Point(Q, preconditioner, np.ascontiguousarray(Y))
    radius = np.sqrt(Y.shape[0] * Y.shape[1]) / 8
    products = 0
    for _ in range(_MOST_STEPS):
        if here.slope <= tolerance * here.cost or radius < _LEAST_RADIUS or products >= most_products:
            break
        step, promised, at_bound, count = _truncated_cg(here, radius, min(_MOST_INNER, most_products - products))
        products += count + 1
        there = _Point(Q, preconditioner, nearest_frames(Y + step))
        noise = _ROUNDING * here.cost
        ratio = (here.cost - there.cost + noise) / (promised + noise)
        if ratio < _POOR:
            radius /= 4
        elif ratio > _GOOD and at_bound:
            radius *= 2
        if ratio > _ACCEPTED:
            here, Y = there, there.Y
        elif promised <= _LEAST * here.cost:
            break
    return Frames(here.Y, here.cost, products)


@dataclass(eq=False)
class _Point:
    """The form at frames Y."""

    Q: Product
    preconditioner: Product
    Y: FloatArray

    @cached_property
    def QY(self) -> FloatArray:
        return self._times(self.Q, self.Y)

    @cached_property
    def cost(self) -> float:
        return float((self.Y * self.QY).sum())

    @cached_property
    def gradient(self) -> FloatArray:
        return np.asarray(2 * (self.QY - self._multipliers @ self.Y))

    @cached_property
    def conditioned_gradient(self) -> FloatArray:
        return self.conditioned(self.gradient)

    @cached_property
    def slope(self) -> float:
        """Square of the gradient in the metric of the preconditioner."""
        return float((self.gradient * self.conditioned_gradient).sum())

    def hessian(self, V: FloatArray) -> FloatArray:
        return 2 * self._tangent(self._times(self.Q, V) - self._multipliers @ V)

    def conditioned(self, V: FloatArray) -> FloatArray:
        return self._tangent(self._times(self.preconditioner, V))

    @cached_property
    def _multipliers(self) -> FloatArray:
        return multipliers(self.Y, self.QY)

    def _tangent(self, V: FloatArray) -> FloatArray:
        return np.asarray(V - multipliers(self.Y, V) @ self.Y)

    def _times(self, product: Product, V: FloatArray) -> FloatArray:
        return product(V.reshape(-1, V.shape[2])).reshape(V.shape)


def _truncated_cg(at: _Point, radius: float, most: float) -> tuple[FloatArray, float, bool, int]:
    """The step, the decrease it promises, whether it ends at the bound of the trust region, and its iterations.

    Lengths are measured in the metric of the preconditioner, by recursion (Conn, Gould, Toint 2000, section 7.5.1).
    """
    step, H_step, residual = np.zeros_like(at.Y), np.zeros_like(at.Y), at.gradient
    direction, rz = -at.conditioned_gradient, at.slope
    enough = rz * min(0.1, np.sqrt(rz)) ** 2
    ss, sd, dd = 0.0, 0.0, rz  # squares and product of step and direction
    at_bound = False
    count = 0
    for count in range(1, 1 + math.ceil(most)):  # noqa: B007
        H = at.hessian(direction)
        curvature = float((direction * H).sum())
        alpha = rz / curvature if curvature > 0 else np.inf
        at_bound = not (ss + 2 * alpha * sd + alpha**2 * dd < radius**2)
        if at_bound:
            alpha = (-sd + np.sqrt(sd**2 + dd * (radius**2 - ss))) / dd
        step, H_step, residual = step + alpha * direction, H_step + alpha * H, residual + alpha * H
        conditioned = at.conditioned(residual)
        before, rz = rz, float((residual * conditioned).sum())
        if at_bound or rz <= enough:
            break
        beta = rz / before
        ss, sd, dd = ss + 2 * alpha * sd + alpha**2 * dd, beta * (sd + alpha * dd), rz + beta**2 * dd
        direction = -conditioned + beta * direction
    return step, -float((at.gradient * step).sum() + (step * H_step).sum() / 2), at_bound, count
