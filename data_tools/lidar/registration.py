"""Scan registration: point-to-plane ICP against a local map of surfels.

    minimise over T   sum_i rho( n_i . (T p_i - m_i) ),        rho(r) = s^2/2 log(1 + r^2 / s^2)      (Cauchy)

p_i are points of the scan, m_i and n_i mean and normal of the nearest flat surfel of the map. Each iteration updates
the pairs and takes one Gauss-Newton step x = (rotation, translation) in the scan's own frame, T <- T exp(x), with the
weights w = 1 / (1 + r^2 / s^2) of the present residuals:

    J_i = [ (p_i x R^T n_i)^T,  (R^T n_i)^T ],      (sum w J^T J) x = - sum w r J^T

The covariance of x is the sandwich of robust regression, with points of one surfel, whose residuals go together, as one
observation c:

    P = H^-1 ( sum_c g_c g_c^T ) H^-1,      H = sum_i w J^T J,   g_c = sum_{i in c} w r J^T

Sources: Chen and Medioni, Object modelling by registration of multiple range images, 1992; Huber and Ronchetti, Robust
Statistics, 2nd ed. 2009, section 6.3; Liang and Zeger, Biometrika 73 (1986).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from data_tools.lidar.surfels import SurfelMap, Surfels
from saga_fg.errors import SagaError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.settings import Positive, PositiveInt, Settings, setting

LEAST_PAIRS = 12  # twice the unknowns
UNCONSTRAINED = 1e-3  # least ratio of the smallest to the largest eigenvalue of the information


class RegistrationError(SagaError):
    """The scan does not overlap the map, or the overlap does not determine the pose."""


@dataclass(frozen=True)
class RegistrationSettings(Settings):
    """Convergence criteria of the registration."""

    max_iterations: PositiveInt = setting(30, "largest number of iterations")
    translation_tolerance: Positive = setting(1e-3, "largest translation of the last step, m")
    rotation_tolerance: Positive = setting(1e-4, "largest rotation of the last step, rad")


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of a scan in the map.

    map_T_scan  (4, 4)
    covariance  (6, 6) of (rotation, translation) in the scan's frame, rad^2 and m^2
    residual    mean distance of the paired points from their surfels, m
    pairs       number of paired points
    iterations  number of iterations
    converged   True if the last step was short enough
    """

    map_T_scan: FloatArray
    covariance: FloatArray
    residual: float
    pairs: int
    iterations: int
    converged: bool


def register(
    points: FloatArray,
    surfels: SurfelMap,
    map_T_scan: FloatArray,
    farthest: float,
    scale: float,
    settings: RegistrationSettings,
) -> Registration:
    """Register points (N, 3) of a scan, m, in its sensor's frame, with a map.

    map_T_scan  (4, 4) initial pose
    farthest    largest distance of a point from the mean of its surfel, m
    scale       s of the robust loss, m

    Raises `RegistrationError` for fewer pairs than `LEAST_PAIRS`, and for an unconstrained direction.
    """
    T = _rigid(map_T_scan)
    span = float(np.sqrt(np.mean(np.square(points)) * 3)) if len(points) else 1.0
    converged, step = False, 0
    while not converged and step < settings.max_iterations:
        step += 1
        rows, paired = surfels.nearest(transform_points(T, points), farthest)
        J, r, w = _linearised(points[rows], paired, T, scale)
        x = _solve(J.T @ (w[:, None] * J), -J.T @ (w * r), span)
        T = _rigid(T @ gtsam.Pose3.Expmap(x).matrix())
        converged = bool(
            np.linalg.norm(x[3:]) < settings.translation_tolerance
            and np.linalg.norm(x[:3]) < settings.rotation_tolerance
        )
    J, r, w = _linearised(points[rows], paired, T, scale)
    return Registration(T, _covariance(J, r, w, paired.voxel), float(np.abs(r).mean()), len(r), step, converged)


def _linearised(
    points: FloatArray, paired: Surfels, T: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Jacobian (N, 6), residual (N,) and weight (N,) of the pairs."""
    if len(points) < LEAST_PAIRS:
        raise RegistrationError(f"registration: expected {LEAST_PAIRS} points near the map at least, got {len(points)}")
    r = np.einsum("ni,ni->n", transform_points(T, points) - paired.mean, paired.normal)
    normal = paired.normal @ T[:3, :3]
    return np.hstack([np.cross(points, normal), normal]), r, 1 / (1 + (r / scale) ** 2)


def _solve(H: FloatArray, g: FloatArray, span: float) -> FloatArray:
    """The Gauss-Newton step; `span`, a typical distance of the points, m, scales rotations to translations."""
    scale = np.array([span, span, span, 1.0, 1.0, 1.0])
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    if values[0] < UNCONSTRAINED * values[-1]:
        raise RegistrationError("registration: the visible surfaces leave a direction of motion unconstrained")
    return np.asarray(vectors @ ((vectors.T @ (g / scale)) / values) / scale)


def _covariance(J: FloatArray, r: FloatArray, w: FloatArray, group: IntArray) -> FloatArray:
    inverse = np.linalg.inv(J.T @ (w[:, None] * J))
    _, row = np.unique(group, return_inverse=True)
    scores = np.zeros((row.max() + 1, 6))
    np.add.at(scores, row, (w * r)[:, None] * J)
    groups = len(scores)
    P = inverse @ (scores.T @ scores) @ inverse * (groups / max(groups - 6, 1))
    return np.asarray((P + P.T) / 2)


def _rigid(T: FloatArray) -> FloatArray:
    """The rigid transform nearest to T, which has accumulated rounding errors."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    rigid = T.copy()
    rigid[:3, :3] = U @ Vt
    return rigid
