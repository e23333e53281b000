"""Directions of motion that the surfaces in view leave open: along a tunnel, in an open field.

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

from dataclasses import dataclass

import numpy as np

from data_tools.lidar.surfels import Surfels
from saga_fg.numerics.arrays import FloatArray

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
    needed = LEAST_SURFELS + float(w @ _squared_roughness(paired.select(first)))
    return Observability(number, needed, motions.T, reach)


def _squared_roughness(surfels: Surfels) -> FloatArray:
    """(M,) rad^2: smallest over second eigenvalue of the scatter, from its trace and its second invariant."""
    S, n = surfels.scatter, surfels.normal
    trace = np.trace(S, axis1=1, axis2=2)
    least = np.einsum("ni,nij,nj->n", n, S, n)
    second = (trace**2 - np.einsum("nij,nij->n", S, S)) / 2  # sum of the products of two eigenvalues
    rest, product = trace - least, second - least * (trace - least)
    middle = (rest - np.sqrt(np.maximum(rest**2 - 4 * product, 0.0))) / 2
    return np.asarray(np.clip(least / np.maximum(middle, 1e-12), 0.0, 1.0))


def _axes(ahead: FloatArray) -> FloatArray:
    """Rows ahead, left and up of a way (3,) over ground."""
    up = np.array([0.0, 0.0, 1.0])
    left = np.cross(up, ahead)
    if np.linalg.norm(left) < 1e-6:
        return np.eye(3)
    left /= np.linalg.norm(left)
    return np.stack([np.cross(left, up), left, up])
