"""Scan registration: point-to-plane ICP against surfels, and the directions that they leave open.

    minimise over T   sum_i rho( n_i . (T p_i - m_i) ),        rho(r) = s^2/2 log(1 + r^2 / s^2)      (Cauchy)

p_i are points of the scan, m_i and n_i mean and normal of the nearest flat surfel of the map. Each iteration updates
the pairs and takes one Gauss-Newton step x = (rotation, translation) in the scan's own frame, T <- T exp(x), with the
weights w = 1 / (1 + r^2 / s^2) of the present residuals:

    J_i = [ (p_i x R^T n_i)^T,  (R^T n_i)^T ],      (sum w J^T J) x = - sum w r J^T

The covariance of x is the sandwich of robust regression, with points of one surfel, whose residuals go together, as one
observation c:

    P = H^-1 ( sum_c g_c g_c^T ) H^-1,      H = sum_i w J^T J,   g_c = sum_{i in c} w r J^T

Where the surfaces leave motions open, steps can be taken among the others alone, C the
columns that span them: x = C y, (C^T H C) y = - C^T g. The rest of the pose stays as it was given.

Sources: Chen and Medioni, Object modelling by registration of multiple range images, 1992; Huber and Ronchetti, Robust
Statistics, 2nd ed. 2009, section 6.3; Liang and Zeger, Biometrika 73 (1986).

Surfels of the scans before: for each voxel, the Gaussian of the points that fell into it.

    n, m = mean, S = sum (p - m)(p - m)^T;   two sets of points of one voxel together, d = m_b - m_a:

    n = n_a + n_b,   m = m_a + n_b/n d,   S = S_a + S_b + n_a n_b / n d d^T            (Chan et al., 1979)

The eigenvector of S with the smallest eigenvalue is the normal of a surfel whose points lie flat: smallest eigenvalue
below a share of the second, and the second above that of a line. The voxels are sorted by key, and those too far from
the vehicle are dropped. Sources: Chan, Golub, LeVeque, Updating
formulae and a pairwise algorithm for computing sample variances, 1979; Biber and Strasser, The normal distributions
transform, IROS 2003.

Directions of motion that the surfaces in view leave open: along a tunnel, in an open field.

Each surfel g with a pair counts once, with the mean weight w_g of its points, which is small where they lie off it. Its
normal n at p sees a motion (rotation w, translation v) of the sensor by n . (v + w x p). With rotations as distances
at the typical range r of the surfels,

    A = sum_g w_g j_g j_g^T,    j_g = [ (p x n) / max(|p|, r),  n ]      (6, 6)

An eigenvalue of A is the number of surfels that face a motion. Normals have errors, so that some see a motion that none
faces: by the roughness s_g of the surfels, rad, about sum_g w_g s_g^2 of them. A motion that fewer see than that, and
`LEAST_SURFELS` more, is unconstrained: a few false surfels, across edges, are everywhere. Sources: Zhang, Kaess, Singh,
On degeneracy of optimization-based state estimation problems, ICRA 2016; Tuna et al., X-ICP, T-RO 2024.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from data_tools.lidar.scan import voxel_groups, voxel_keys
from saga_fg.errors import SagaError
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, transform_points

LEAST_POINTS = 6  # of a flat surfel
FLAT = 1 / 9  # largest share of the smallest eigenvalue in the second: a third of the standard deviation
WIDTH = 0.05  # least standard deviation along the surface, of a voxel's size: a line is not a surface
MEMORY = 200.0  # points after which older points lose weight


@dataclass(frozen=True, eq=False)
class Surfels(Columns):
    """M Gaussians, sorted by voxel.

    voxel    (M,) keys
    count    (M,) points, older ones with less weight
    mean     (M, 3) m
    scatter  (M, 3, 3) sum of the squares about the mean, m^2
    normal   (M, 3) unit normals, 0 where `flat` is False; flat (M,)
    """

    voxel: IntArray
    count: FloatArray
    mean: FloatArray
    scatter: FloatArray
    normal: FloatArray
    flat: BoolArray

    @classmethod
    def empty(cls) -> Surfels:
        none = np.empty(0)
        voxel = np.empty(0, dtype=np.int64)
        return cls(voxel, none, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0, dtype=np.bool_))


def surfels_of(points: FloatArray, size: float) -> Surfels:
    """The surfels of points (N, 3), m, in voxels of `size` m."""
    moments = _moments(points, size)
    return _with_normals(moments, np.ones(len(moments), dtype=np.bool_), size)


class SurfelMap:
    """Surfels around the vehicle, in the map's frame, and the search for the nearest flat one.

    size   of a voxel, m
    reach  largest distance of surfels from the last scan's position, m
    """

    def __init__(self, size: float, reach: float) -> None:
        self.size, self.reach = size, reach
        self.surfels = Surfels.empty()
        self._flat = self.surfels
        self._tree = cKDTree(np.empty((0, 3)))

    def add(self, points: FloatArray, position: FloatArray) -> None:
        """Add points (N, 3) observed from `position` (3,), both in the map's frame."""
        old, new = self.surfels, _moments(points, self.size)
        row = np.searchsorted(old.voxel, new.voxel)
        known = np.zeros(len(new), dtype=np.bool_)
        inside = row < len(old)
        known[inside] = old.voxel[row[inside]] == new.voxel[inside]
        merged = _merged(old.select(row[known]), new.select(known))
        both = old.append(new.select(~known))
        for name in ("count", "mean", "scatter"):
            getattr(both, name)[row[known]] = getattr(merged, name)
        changed = np.zeros(len(both), dtype=np.bool_)
        changed[row[known]] = changed[len(old) :] = True
        order = np.argsort(both.voxel, kind="stable")
        order = order[np.linalg.norm(both.mean[order] - position, axis=1) <= self.reach]
        self.surfels = _with_normals(both.select(order), changed[order], self.size)
        self._flat = self.surfels.select(self.surfels.flat)
        self._tree = cKDTree(self._flat.mean, balanced_tree=False, compact_nodes=False)

    def nearest(self, points: FloatArray, farthest: float) -> tuple[IntArray, Surfels]:
        """Rows (K,) of the points that have a flat surfel with its mean within `farthest` m, and the surfel of each."""
        distance, row = self._tree.query(points, distance_upper_bound=farthest)
        found = np.flatnonzero(np.isfinite(distance))
        return found, self._flat.select(row[found])


def _moments(points: FloatArray, size: float) -> Surfels:
    order, start = voxel_groups(points, size)
    m = len(start)
    if not m:
        return Surfels.empty()
    grouped = points[order]
    voxel, count = voxel_keys(grouped[start], size), np.diff(start, append=len(points))
    mean = np.add.reduceat(grouped, start) / count[:, None]
    off = grouped - np.repeat(mean, count, axis=0)
    scatter = np.empty((m, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        scatter[:, i, j] = scatter[:, j, i] = np.add.reduceat(off[:, i] * off[:, j], start)
    return Surfels(voxel, count.astype(np.float64), mean, scatter, np.zeros((m, 3)), np.zeros(m, dtype=np.bool_))


def _merged(a: Surfels, b: Surfels) -> Surfels:
    count = a.count + b.count
    d = b.mean - a.mean
    mean = a.mean + d * (b.count / count)[:, None]
    scatter = a.scatter + b.scatter + (a.count * b.count / count)[:, None, None] * d[:, :, None] * d[:, None, :]
    kept = np.minimum(1.0, MEMORY / count)
    return Surfels(a.voxel, count * kept, mean, scatter * kept[:, None, None], a.normal, a.flat)


def _with_normals(surfels: Surfels, changed: BoolArray, size: float) -> Surfels:
    normal, flat = surfels.normal.copy(), surfels.flat.copy()
    rows = np.flatnonzero(changed & (surfels.count >= LEAST_POINTS))
    values, vectors = np.linalg.eigh(surfels.scatter[rows] / surfels.count[rows, None, None])
    flat[rows] = (values[:, 0] < FLAT * values[:, 1]) & (values[:, 1] > (WIDTH * size) ** 2)
    normal[rows] = np.where(flat[rows, None], vectors[:, :, 0], 0.0)
    return Surfels(surfels.voxel, surfels.count, surfels.mean, surfels.scatter, normal, flat)


LEAST_SURFELS = 3.0
AXES = ("roll", "pitch", "heading", "along the road", "across the road", "vertically")


@dataclass(frozen=True, eq=False)
class Observability:
    """Motions of a scan that the map determines.

    surfels      (6,) number of surfels that face each of six orthogonal motions, ascending
    needed       number that a motion needs to be determined
    motions      (6, 6) rows: those motions, (rotation, translation) in the sensor's frame, rotations times `range`
    range        m, that a rotation is multiplied with to be a distance
    """

    surfels: FloatArray
    needed: float
    motions: FloatArray
    range: float

    @property
    def lost(self) -> FloatArray:
        """(k, 6) motions that are not determined."""
        return self.motions[self.surfels < self.needed]

    def open(self, variance: float) -> FloatArray:
        """Covariance (6, 6), rad^2 and m^2, of a tangent that has this variance, m^2, along each of those motions."""
        motions = self.lost / self.scale
        return np.asarray(variance * motions.T @ motions)

    @property
    def scale(self) -> FloatArray:
        """(6,) what a tangent (rad, m) is multiplied with to be a motion."""
        return np.array([self.range] * 3 + [1.0] * 3)

    def names(self, ahead: FloatArray | None = None) -> tuple[str, ...]:
        """The motions that are not determined, in words; ahead (3,): the way in the sensor's frame, by default x."""
        if not len(self.lost):
            return ()
        axes = np.zeros((6, 6))
        axes[:3, :3] = np.eye(3)
        axes[3:, 3:] = _axes(np.array([1.0, 0.0, 0.0]) if ahead is None else ahead)
        share = np.square(self.lost @ axes.T).sum(axis=0)  # of each axis in the subspace
        clear = share > 0.5
        return tuple(
            name for name, named in zip(AXES, clear if clear.any() else share == share.max(), strict=True) if named
        )


def observability(points: FloatArray, paired: Surfels, normal: FloatArray, weight: FloatArray) -> Observability:
    """Return what pairs determine: points (N, 3) and normals (N, 3) in the sensor's frame, weights (N,)."""
    _, first, group = np.unique(paired.voxel, return_index=True, return_inverse=True)
    w = np.bincount(group, weight) / np.bincount(group)
    p, n = points[first], normal[first]
    distance = np.linalg.norm(p, axis=1)
    reach = max(float(np.median(distance)), 1e-3)
    seen = np.hstack([np.cross(p, n) / np.maximum(distance, reach)[:, None], n])
    number, motions = np.linalg.eigh(seen.T @ (w[:, None] * seen))
    spread = np.linalg.eigvalsh(paired.scatter[first])
    roughness = np.clip(spread[:, 0] / np.maximum(spread[:, 1], 1e-12), 0.0, 1.0)  # rad^2
    needed = LEAST_SURFELS + float(w @ roughness)
    return Observability(number, needed, motions.T, reach)


def _axes(ahead: FloatArray) -> FloatArray:
    """Rows ahead, left and up of a way (3,) over ground."""
    up = np.array([0.0, 0.0, 1.0])
    left = np.cross(up, ahead)
    if np.linalg.norm(left) < 1e-6:
        return np.eye(3)
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, up), left, up])


_TRANSLATION_TOLERANCE = 1e-3  # largest translation of the last step, m
_ROTATION_TOLERANCE = 1e-4  # largest rotation of the last step, rad
LEAST_PAIRS = 12  # twice the unknowns
UNCONSTRAINED = 1e-3  # least ratio of the smallest to the largest eigenvalue of the information


Undetermined = Literal["refuse", "hold", "follow"]
MAX_ITERATIONS = 30  # largest number of iterations


class RegistrationError(SagaError):
    """The scan does not overlap the map, or the overlap does not determine the pose."""


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
        return _refined(points, surfels, map_T_scan, farthest, scale, free)

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
    free: FloatArray,
) -> Registration:
    """The registration among the motions free (6, k)."""
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
