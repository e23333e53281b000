"""Scan registration: point-to-plane ICP against the surfels of the scans before.

    minimise over T   sum_i rho( n_i . (T p_i - m_i) ),        rho(r) = s^2/2 log(1 + r^2 / s^2)      (Cauchy)

p_i are points of the scan, m_i and n_i mean and normal of the nearest flat surfel of the map. Each iteration updates
the pairs and takes one Gauss-Newton step x = (rotation, translation) in the scan's own frame, T <- T exp(x), with the
weights w = 1 / (1 + r^2 / s^2) of the present residuals:

    J_i = [ (p_i x R^T n_i)^T,  (R^T n_i)^T ],      (sum w J^T J) x = - sum w r J^T

The covariance of x is the sandwich of robust regression, with points of one surfel, whose residuals go together, as one
observation c:

    P = H^-1 ( sum_c g_c g_c^T ) H^-1,      H = sum_i w J^T J,   g_c = sum_{i in c} w r J^T

Where the surfaces leave motions open (`data_tools.lidar.degeneracy`), steps can be taken among the others alone, C the
columns that span them: x = C y, (C^T H C) y = - C^T g. The rest of the pose stays as it was given.

Sources: Chen and Medioni, Object modelling by registration of multiple range images, 1992; Huber and Ronchetti, Robust
Statistics, 2nd ed. 2009, section 6.3; Liang and Zeger, Biometrika 73 (1986).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from data_tools.lidar.degeneracy import Observability, observability
from data_tools.lidar.surfels import SurfelMap, Surfels
from saga_fg.errors import SagaError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.settings import Settings, setting

_TRANSLATION_TOLERANCE = 1e-3  # largest translation of the last step, m
_ROTATION_TOLERANCE = 1e-4  # largest rotation of the last step, rad
LEAST_PAIRS = 12  # twice the unknowns
UNCONSTRAINED = 1e-3  # least ratio of the smallest to the largest eigenvalue of the information


Undetermined = Literal["refuse", "hold", "follow"]
MAX_ITERATIONS = 30  # largest number of iterations


class RegistrationError(SagaError):
    """The scan does not overlap the map, or the overlap does not determine the pose."""


@dataclass(frozen=True)
class RegistrationSettings(Settings):
    """Method and convergence criteria of the registration."""

    method: Literal["gauss-newton", "open3d"] = setting(
        "gauss-newton", "our own iterations, or Open3D's tensor ICP on the same surfels; loops are registered by ours"
    )


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of a scan in the map.

    map_T_scan  (4, 4)
    covariance  (6, 6) of (rotation, translation) in the scan's frame, rad^2 and m^2
    residual    mean distance of the paired points from their surfels, m
    pairs       number of paired points
    iterations  number of iterations
    converged   True if the last step was short enough
    observed    which motions the map determines; P is 0 along the others if they were held
    """

    map_T_scan: FloatArray
    covariance: FloatArray
    residual: float
    pairs: int
    iterations: int
    converged: bool
    observed: Observability


def register(
    points: FloatArray,
    surfels: SurfelMap,
    map_T_scan: FloatArray,
    farthest: float,
    scale: float,
    settings: RegistrationSettings,
    undetermined: Undetermined = "refuse",
) -> Registration:
    """Register points (N, 3) of a scan, m, in its sensor's frame, with a map.

    map_T_scan  (4, 4) initial pose
    farthest    largest distance of a point from the mean of its surfel, m
    scale       s of the robust loss, m
    undetermined  along motions that the map leaves open: "refuse" them, "hold" the initial pose, or "follow" what
                  little the map says of them, which is for an initial pose that knows nothing

    Raises `RegistrationError` for fewer pairs than `LEAST_PAIRS`, and for an unconstrained motion that is refused.
    """

    def refined(free: FloatArray) -> Registration:
        return _refined(points, surfels, map_T_scan, farthest, scale, settings, free)

    try:
        found = refined(np.eye(6))
        observed = found.observed
    except _UnconstrainedError as error:
        observed = error.observed
        if undetermined == "refuse" or not len(observed.lost):
            raise
    else:
        if not len(observed.lost) or undetermined == "follow":
            return found
    if undetermined == "refuse" or len(observed.lost) == 6:
        raise _UnconstrainedError(observed)
    free = observed.motions[len(observed.lost) :].T * (1 / observed.scale)[:, None]
    return replace(refined(free), observed=observed)


class _UnconstrainedError(RegistrationError):
    def __init__(self, observed: Observability) -> None:
        super().__init__("registration: the visible surfaces leave a direction of motion unconstrained")
        self.observed = observed


def _refined(
    points: FloatArray,
    surfels: SurfelMap,
    map_T_scan: FloatArray,
    farthest: float,
    scale: float,
    settings: RegistrationSettings,
    free: FloatArray,
) -> Registration:
    """The registration among the motions free (6, k)."""
    if settings.method == "open3d" and free.shape[1] == 6 and len(points) >= LEAST_PAIRS and len(surfels.flat):
        return _by_open3d(points, surfels, map_T_scan, farthest, scale)
    T = _rigid(map_T_scan)
    span = float(np.sqrt(np.mean(np.square(points)) * 3)) if len(points) else 1.0
    converged, step = False, 0
    while not converged and step < MAX_ITERATIONS:
        step += 1
        rows, paired = surfels.nearest(transform_points(T, points), farthest)
        J, r, w = _linearised(points[rows], paired, T, scale)
        x = _solve(J.T @ (w[:, None] * J), -J.T @ (w * r), span, free)
        if x is None:
            raise _UnconstrainedError(observability(points[rows], paired, J[:, 3:], w))
        T = _rigid(T @ gtsam.Pose3.Expmap(x).matrix())
        converged = bool(np.linalg.norm(x[3:]) < _TRANSLATION_TOLERANCE and np.linalg.norm(x[:3]) < _ROTATION_TOLERANCE)
    return _assessed(points[rows], paired, T, scale, free, step, converged)


def _by_open3d(
    points: FloatArray,
    surfels: SurfelMap,
    map_T_scan: FloatArray,
    farthest: float,
    scale: float,
) -> Registration:
    from data_tools.lidar.open3d_registration import icp  # which imports Open3D

    T, iterations, converged = icp(points, surfels, map_T_scan, farthest, scale, MAX_ITERATIONS)
    T = _rigid(T)
    rows, paired = surfels.nearest(transform_points(T, points), farthest)
    return _assessed(points[rows], paired, T, scale, np.eye(6), iterations, converged)


def _assessed(
    points: FloatArray, paired: Surfels, T: FloatArray, scale: float, free: FloatArray, step: int, converged: bool
) -> Registration:
    """The registration with its covariance, given pairs at its end."""
    J, r, w = _linearised(points, paired, T, scale)
    seen = observability(points, paired, J[:, 3:], w)
    if free.shape[1] == 6 and np.linalg.matrix_rank(J.T @ (w[:, None] * J)) < 6:
        raise _UnconstrainedError(seen)
    P = free @ _covariance(J @ free, r, w, paired.voxel) @ free.T
    return Registration(T, P, float(np.abs(r).mean()), len(r), step, converged, seen)


def _linearised(
    points: FloatArray, paired: Surfels, T: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Jacobian (N, 6), residual (N,) and weight (N,) of the pairs."""
    if len(points) < LEAST_PAIRS:
        raise RegistrationError(f"registration: expected {LEAST_PAIRS} points near the map at least, got {len(points)}")
    r = np.einsum("ni,ni->n", transform_points(T, points) - paired.mean, paired.normal)
    normal = paired.normal @ T[:3, :3]
    return np.hstack([np.cross(points, normal), normal]), r, 1 / (1 + (r / scale) ** 2)


def _solve(H: FloatArray, g: FloatArray, span: float, free: FloatArray) -> FloatArray | None:
    """The Gauss-Newton step among the motions free (6, k), None where they are not determined.

    span: a typical distance of the points, m, that scales rotations to translations
    """
    scale = np.array([span, span, span, 1.0, 1.0, 1.0])
    basis = np.linalg.qr(scale[:, None] * free)[0] / scale[:, None]
    values, vectors = np.linalg.eigh(basis.T @ H @ basis)
    if values[0] < UNCONSTRAINED * values[-1]:
        return None
    return np.asarray(basis @ (vectors @ ((vectors.T @ (basis.T @ g)) / values)))


def _covariance(J: FloatArray, r: FloatArray, w: FloatArray, group: IntArray) -> FloatArray:
    inverse = np.linalg.inv(J.T @ (w[:, None] * J))
    _, row = np.unique(group, return_inverse=True)
    scores = np.zeros((row.max() + 1, J.shape[1]))
    np.add.at(scores, row, (w * r)[:, None] * J)
    groups = len(scores)
    P = inverse @ (scores.T @ scores) @ inverse * (groups / max(groups - J.shape[1], 1))
    return np.asarray((P + P.T) / 2)


def _rigid(T: FloatArray) -> FloatArray:
    """The rigid transform nearest to T, which has accumulated rounding errors."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    rigid = T.copy()
    rigid[:3, :3] = U @ Vt
    return rigid
