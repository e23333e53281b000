r"""Points seen from the poses of a graph, and poses and places known from outside.

    point           z = R^T (l - t) + v                     world_T_pose = (R, t), landmark l
    bearing         z = direction of R^T (l - t) + v        in the plane
    range bearing   z = (|| l - t ||, that direction) + v

For given poses the places are the weighted least squares of

    point   || R z + t - l ||^2_{R Omega R^T}        bearing   ( n . (l - t) )^2 Omega / rho^2,    n across the bearing

with rho the distance found without it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from factors import Bearing, ResidualFactors, point_factors, relative_factors, relative_range_bearing_factors
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, checked, checked_covariances, checked_ids, checked_rows

ObservationKind = Literal["point", "bearing", "range bearing"]
_FLAT = 1e-9  # ratio of eigenvalues below which bearings are parallel


@dataclass(frozen=True, eq=False)
class PosePriors:
    """Poses (rows of the graph) known from outside: world_T_pose (n, d + 1, d + 1), information (n, k, k)."""

    pose: IntArray
    world_T_pose: FloatArray
    information: FloatArray


@dataclass(frozen=True, eq=False)
class PositionPriors:
    """Places of poses (rows of the graph) known from outside: position (n, d), m, information (n, d, d), world frame.

    Raises `InputError` where these do not fit together.
    """

    pose: IntArray
    position: FloatArray
    information: FloatArray

    def __post_init__(self) -> None:
        n = len(checked_rows("pose", self.pose))
        places = checked("position", self.position, (n, None))
        checked_covariances("information", self.information, n, places.shape[1])

    @property
    def weight(self) -> FloatArray:
        """Weights (n,) of the squared distances, 1 / m^2: d / trace of the covariance."""
        return np.asarray(self.position.shape[1] / np.trace(np.linalg.inv(self.information), axis1=1, axis2=2))

    @property
    def orient(self) -> bool:
        """Whether they tell which way a rigid body of these places is turned: two places, in space not on one line."""
        middle = self.position - self.position.mean(axis=0)
        spread = np.linalg.svd(middle, compute_uv=False)
        needed = self.position.shape[1] - 1
        return len(spread) >= needed and bool(spread[needed - 1] > _FLAT * np.abs(self.position).max(initial=1.0))

    def fitted(self, world_T_pose: FloatArray) -> FloatArray:
        """Poses (N, d + 1, d + 1), moved as a whole to where the places are (weighted least squares)."""
        d, w = self.position.shape[1], self.weight / self.weight.sum()
        at = world_T_pose[self.pose, :d, d]
        middle, known = w @ at, w @ self.position
        U, _, Vt = np.linalg.svd((self.position - known).T @ (w[:, None] * (at - middle)))
        T = np.eye(d + 1)
        T[:d, :d] = U @ np.diag([*np.ones(d - 1), np.linalg.det(U @ Vt)]) @ Vt
        T[:d, d] = known - T[:d, :d] @ middle
        return np.asarray(T @ world_T_pose)


@dataclass(frozen=True, eq=False)
class LandmarkObservations:
    """kind; pose, landmark (n,): rows; z (n, m) in the frame of the pose, m and rad; information (n, m, m).

    Raises `InputError` where these do not fit together.
    """

    kind: ObservationKind
    pose: IntArray
    landmark: IntArray
    z: FloatArray
    information: FloatArray

    def __post_init__(self) -> None:
        if self.kind not in get_args(ObservationKind):
            raise InputError(f"kind: expected one of {', '.join(get_args(ObservationKind))}, got {self.kind!r}")
        n = len(checked_rows("pose", self.pose))
        checked_rows("landmark", self.landmark, n)
        z = checked("z", self.z, (n, {"bearing": 1, "range bearing": 2}.get(self.kind)))
        checked_covariances("information", self.information, n, z.shape[1])

    def factors(self, landmark_key: int) -> ResidualFactors:
        """Factors of the keys of a graph: poses from 0, landmarks from `landmark_key`."""
        keys = np.stack([self.pose, self.landmark + landmark_key], axis=1)
        covariances = np.linalg.inv(self.information)
        covariances = (covariances + covariances.swapaxes(1, 2)) / 2
        if self.kind == "point":
            return point_factors(keys, self.z, covariances)
        if self.kind == "bearing":
            return relative_factors(keys, Bearing(2), self.z, covariances, 2)
        return relative_range_bearing_factors(keys, self.z, covariances, 2)

    def normal_equations(self, world_T_pose: FloatArray, places: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """H (n, d, d) and H l (n, d) of each observation; places (L, d): where the landmarks are about."""
        d = world_T_pose.shape[-1] - 1
        T = world_T_pose[self.pose]
        R, t = T[:, :d, :d], T[:, :d, d]
        if self.kind == "point":
            H, local = self.information, self.z
        else:
            bearing = self.z[:, -1]
            along = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
            across = np.stack([-along[:, 1], along[:, 0]], axis=1)
            if self.kind == "bearing":
                rho = np.ones(len(t)) if places is None else np.linalg.norm(places[self.landmark] - t, axis=1)
                local = np.zeros_like(t)
                H = (
                    self.information
                    / np.maximum(rho, 1e-6)[:, None, None] ** 2
                    * across[:, :, None]
                    * across[:, None, :]
                )
            else:
                local = self.z[:, :1] * along
                J = np.stack([along, across / self.z[:, :1]], axis=1)
                H = J.swapaxes(1, 2) @ self.information @ J
        H = R @ H @ R.swapaxes(1, 2)
        place = (R @ local[:, :, None])[:, :, 0] + t
        return H, (H @ place[:, :, None])[:, :, 0]


@dataclass(frozen=True, eq=False)
class PointLandmarks:
    """ids (L,) unique; observations; position (L, d), m, NaN where there is no guess."""

    ids: IntArray
    observations: tuple[LandmarkObservations, ...]
    position: FloatArray

    def __post_init__(self) -> None:
        ids = checked_ids("ids", self.ids)
        for seen in self.observations:
            if ((seen.landmark < 0) | (seen.landmark >= len(ids))).any():
                raise InputError(f"landmark: expected rows of the {len(ids)} landmarks, from 0")

    def at(self, position: FloatArray) -> PointLandmarks:
        """A copy with the landmarks at other places."""
        return replace(self, position=position)

    def placed(self, world_T_pose: FloatArray) -> PointLandmarks:
        """The landmarks where they are seen from these poses.

        Raises `InputError` for one whose observations do not determine it, as a single bearing.
        """
        places = None
        for _ in range(2):
            places = self._solved(world_T_pose, places)
        assert places is not None
        return self.at(places)

    def _solved(self, world_T_pose: FloatArray, places: FloatArray | None) -> FloatArray:
        d = world_T_pose.shape[-1] - 1
        H, b = np.zeros((len(self.ids), d, d)), np.zeros((len(self.ids), d))
        for seen in self.observations:
            each_H, each_b = seen.normal_equations(world_T_pose, places)
            np.add.at(H, seen.landmark, each_H)
            np.add.at(b, seen.landmark, each_b)
        values = np.linalg.eigvalsh(H)
        bad = values[:, 0] <= _FLAT * values[:, -1]
        if bad.any():
            name = int(self.ids[np.argmax(bad)])
            raise InputError(f"landmark {name}: expected bearings that cross, or a range: its place is not determined")
        return np.asarray(np.linalg.solve(H, b[:, :, None])[:, :, 0])
