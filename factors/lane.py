"""Lanes and straight lines: what the vehicle sees of them, and objects that keep to a centre line.

Lanes as curves: a boundary seen from the vehicle, and objects that keep to a centre line.

A lane curve is a landmark c = (c_0, ..., c_k) in a level frame of its own, world_T_curve = (R_c, t_c), which is fixed
and has its x axis along the road (or in one for each factor: with c_0 alone, how far a line that bends lies aside of
where a map has it, seen at each foot):

    y = f(x) = c_0 + c_1 x + ... + c_k x^k

A point at (x, y) in that frame is off the curve by, to first order,

    r = (y - f(x)) / s - offset,        s = sqrt(1 + f'(x)^2)

with positive offsets to the left. Derivatives, e = y - f(x):

    dr/dx = -f' / s - e f' f'' / s^3        dr/dy = 1 / s        dr/dc_i = -x^i / s - e f' i x^(i-1) / s^3

A boundary point z (3,), seen from the pose (R, t), lies at (x, y, .) = R_c^T (R z + t - t_c); with the pose moved to
(R Exp(w), t + R v) that changes by R_c^T R (v - [z]x w). An object's place is part of its state.

Straight lines on the ground, seen from the vehicle: curbs, borders of lanes.

The state is a line in the plane, (theta, rho), in the Hesse normal form

    n . x = rho,      n = (cos theta, sin theta)

Of a piece of it two points z_1, z_2 (3,) are observed, its ends, in the frame of the pose (R, t); where along the line
they lie says nothing. The residuals are how far off the line they are in the world, from above,

    r_i = n . (R z_i + t) - rho

(E the first two axes), which needs no wrapping and is as good far from the origin as near it. (theta, rho),
(theta + 2 pi, rho) and (theta + pi, -rho) are one line; `HesseLine` goes from one line to another by the smallest
turn. With the pose moved to (R Exp(w), t + R v),

    dr_i/dw = -n^T E R [z_i]x    dr_i/dv = n^T E R    dr_i/dtheta = n' . (R z_i + t)    dr_i/drho = -1
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.between import pose
from factors.manifolds import SpatialPose, Vector, cross_matrix
from factors.measurement import checked_components
from factors.nonlinear import ResidualFactors, residual_factors
from factors.robust import RobustLoss
from factors.validation import FactorError, FloatArray, checked


def lane_boundary_factors(
    rows: ArrayLike,
    z: ArrayLike,
    variances: ArrayLike,
    world_T_curve: ArrayLike,
    coefficients: int,
    offsets: ArrayLike = 0.0,
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return n factors of points on a lane curve, seen from the vehicle.

    rows: (n, 2) keys of the pose (`gtsam.Pose3`) and the curve (a vector of `coefficients`); z: (n, 3), m, in the
    pose's frame; variances: (n,), or one for all, m^2, across the curve; world_T_curve: (n, 4, 4), or one (4, 4) for
    all; offsets: (n,), or one for all, m to the left of the curve. Raises `FactorError`.
    """
    measured = checked("z", z, (None, 3)).copy()
    n = len(measured)
    curve = _Curve(_frames(world_T_curve, n), _checked_count(coefficients), _column("offsets", offsets, n))
    function = _Boundary(measured, curve)
    noise, dims = _column("variances", variances, n)[:, None, None], (SpatialPose(), coefficients)
    return residual_factors(function, rows, dims, noise, 1, "points of a lane curve", robust)


def lane_keeping_factors(
    rows: ArrayLike,
    variances: ArrayLike,
    world_T_curve: ArrayLike,
    coefficients: int,
    state_dim: int,
    position: tuple[int, int] = (0, 1),
    offsets: ArrayLike = 0.0,
    robust: RobustLoss | None = None,
) -> ResidualFactors:
    """Return n factors of objects that keep to a lane curve, or to a line beside it.

    rows: (n, 2) keys of the object (a vector of `state_dim`) and the curve (a vector of `coefficients`); variances:
    (n,), or one for all, m^2: how far objects stray; position: where the world position, m, sits in the object's state;
    world_T_curve, offsets: as for `lane_boundary_factors`. Raises `FactorError`.
    """
    n = len(np.asarray(rows))
    checked_components("position", position, state_dim, least=2)
    curve = _Curve(_frames(world_T_curve, n), _checked_count(coefficients), _column("offsets", offsets, n))
    function = _Keeping(curve, state_dim, tuple(position))
    noise, dims = _column("variances", variances, n)[:, None, None], (state_dim, coefficients)
    return residual_factors(function, rows, dims, noise, 1, "objects keeping to a lane curve", robust)


@dataclass(frozen=True, eq=False)
class _Curve:
    """frames: world_T_curve (n, 4, 4); count: coefficients; offsets (n,)."""

    frames: FloatArray
    count: int
    offsets: FloatArray

    def inside(self, world: FloatArray) -> FloatArray:
        """World points (n, 3) in the frame of the curve."""
        return np.asarray(np.einsum("ni,nij->nj", world - self.frames[:, :3, 3], self.frames[:, :3, :3]))

    def residual(self, xy: FloatArray, c: FloatArray) -> FloatArray:
        """r (n, 1) of points (n, 2) in the frame of the curve."""
        e, s, *_ = self._parts(xy, c)
        return (e / s - self.offsets)[:, None]

    def derivatives(self, xy: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
        """dr/d(x, y) (n, 2) and dr/dc (n, count)."""
        e, s, slope, bend, powers, slopes = self._parts(xy, c)
        along = -slope / s - e * slope * bend / s**3
        by_c = -powers / s[:, None] - (e * slope / s**3)[:, None] * slopes
        return np.stack([along, 1 / s], axis=1), by_c

    def _parts(self, xy: FloatArray, c: FloatArray) -> tuple[FloatArray, ...]:
        """e, s, f', f'' (n,), and x^i, i x^(i-1) (n, count)."""
        i = np.arange(self.count)
        x = xy[:, :1]
        powers = x**i
        slopes = i * x ** np.maximum(i - 1, 0)
        bends = i * (i - 1) * x ** np.maximum(i - 2, 0)
        slope = (slopes * c).sum(axis=1)
        return xy[:, 1] - (powers * c).sum(axis=1), np.hypot(1, slope), slope, (bends * c).sum(axis=1), powers, slopes


@dataclass(frozen=True, eq=False)
class _Boundary:
    z: FloatArray
    curve: _Curve

    def residual(self, pose: FloatArray, c: FloatArray) -> FloatArray:
        return self.curve.residual(self._inside(pose), c)

    def jacobians(self, pose: FloatArray, c: FloatArray) -> Sequence[FloatArray]:
        by_xy, by_c = self.curve.derivatives(self._inside(pose), c)
        turned = self.curve.frames[:, :3, :3].swapaxes(1, 2) @ pose[:, :3, :3]
        by_tangent = np.concatenate([-turned @ cross_matrix(self.z), turned], axis=2)[:, :2]
        return [by_xy[:, None, :] @ by_tangent, by_c[:, None, :]]

    def _inside(self, pose: FloatArray) -> FloatArray:
        world = (pose[:, :3, :3] @ self.z[:, :, None])[:, :, 0] + pose[:, :3, 3]
        return self.curve.inside(world)[:, :2]


@dataclass(frozen=True, eq=False)
class _Keeping:
    curve: _Curve
    state_dim: int
    position: tuple[int, ...]

    def residual(self, state: FloatArray, c: FloatArray) -> FloatArray:
        return self.curve.residual(self._inside(state), c)

    def jacobians(self, state: FloatArray, c: FloatArray) -> Sequence[FloatArray]:
        by_xy, by_c = self.curve.derivatives(self._inside(state), c)
        J_state = np.zeros((len(state), 1, self.state_dim))
        J_state[:, 0, list(self.position)] = np.einsum("nj,nij->ni", by_xy, self.curve.frames[:, :2, :2])
        return [J_state, by_c[:, None, :]]

    def _inside(self, state: FloatArray) -> FloatArray:
        world = np.zeros((len(state), 3))
        world[:, :2] = state[:, list(self.position)]
        return self.curve.inside(world)[:, :2]


def _frames(world_T_curve: ArrayLike, n: int) -> FloatArray:
    T = checked("world_T_curve", world_T_curve, (n, 4, 4) if np.ndim(world_T_curve) == 3 else (4, 4)).copy()
    for one in T.reshape(-1, 4, 4):
        pose("world_T_curve", one)
        if abs(one[2, 2] - 1) > 1e-9:
            raise FactorError("world_T_curve: expected a level frame, turned about the vertical alone")
    return np.broadcast_to(T, (n, 4, 4))


def _checked_count(coefficients: int) -> int:
    if isinstance(coefficients, bool) or not isinstance(coefficients, int) or coefficients < 1:
        raise FactorError(f"coefficients: expected a number of them, at least 1, got {coefficients!r}")
    return coefficients


def _column(name: str, value: ArrayLike, n: int) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    return checked(name, np.full(n, array) if array.ndim == 0 else array, (n,)).copy()


@dataclass(frozen=True)
class HesseLine:
    """A line in the plane as a vector (theta, rho), rad and m; delta = (turn within a quarter, m)."""

    @property
    def dim(self) -> int:
        return 2

    def read(self, values: gtsam.Values, key: int) -> FloatArray:
        return Vector(2).read(values, key)

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        return state + delta

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        turn = (other[0] - state[0] + np.pi) % (2 * np.pi) - np.pi
        if abs(turn) <= np.pi / 2:
            return np.array([turn, other[1] - state[1]])
        return np.array([turn - np.copysign(np.pi, turn), -other[1] - state[1]])

    def size(self, state: FloatArray) -> FloatArray:
        return np.array([1.0, abs(state[1])])

    def array(self, state: FloatArray) -> FloatArray:
        return state


def line_factors(
    rows: ArrayLike, ends: ArrayLike, covariances: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of straight lines seen from the vehicle.

    rows: (n, 2) keys of the pose (`gtsam.Pose3`) and of the line (a vector of 2: rad, m); ends: (n, 2, 3), m, in the
    frame of the pose; covariances: (n, 2, 2), or one for all, m^2, of the two ends across the line. Raises
    `FactorError`.
    """
    measured = checked("ends", ends, (None, 2, 3)).copy()
    function = _Edge(measured)
    return residual_factors(function, rows, (SpatialPose(), 2), covariances, 2, "straight lines", robust)


@dataclass(frozen=True, eq=False)
class _Edge:
    ends: FloatArray

    def residual(self, pose: FloatArray, line: FloatArray) -> FloatArray:
        n = np.stack([np.cos(line[:, 0]), np.sin(line[:, 0])], axis=1)
        return np.asarray((self._world(pose) @ n[:, :, None])[:, :, 0] - line[:, 1:])

    def jacobians(self, pose: FloatArray, line: FloatArray) -> Sequence[FloatArray]:
        c, s = np.cos(line[:, 0]), np.sin(line[:, 0])
        nR = c[:, None] * pose[:, 0, :3] + s[:, None] * pose[:, 1, :3]
        J_pose = np.empty((len(pose), 2, 6))
        for end in (0, 1):
            J_pose[:, end, :3] = -(nR[:, None, :] @ cross_matrix(self.ends[:, end]))[:, 0]
            J_pose[:, end, 3:] = nR
        turned = np.stack([-s, c], axis=1)
        by_theta = self._world(pose) @ turned[:, :, None]
        return [J_pose, np.concatenate([by_theta, np.full_like(by_theta, -1.0)], axis=2)]

    def _world(self, pose: FloatArray) -> FloatArray:
        """The ends (n, 2, 2) from above."""
        return np.asarray(self.ends @ pose[:, :2, :3].swapaxes(1, 2) + pose[:, None, :2, 3])
