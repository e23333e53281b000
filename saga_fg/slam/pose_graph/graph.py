"""Pose graphs: poses, measurements between pairs of them, points seen, places known from outside.

    first_T_second = world_T_first^-1 world_T_second,     measured with information Omega

    E = 1/2 sum_e || log( measured_e^-1 first_T_second ) ||^2_Omega_e

The tangent lies in the second pose's own frame, m and rad, ordered as in GTSAM: (x, y, heading) in the plane, (rotation
vector, translation) in space.

Points seen from the poses of a graph, and poses and places known from outside. A landmark l is seen at

    z = R^T (l - t) + v,      world_T_pose = (R, t),       v of information Omega

and for given poses its place is the minimum of the sum of  || R z + t - l ||^2_{R Omega R^T}.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from factors import ResidualFactors, relative_factors
from saga_fg.errors import InputError
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    checked,
    checked_covariances,
    checked_ids,
    checked_rows,
    refuse,
)

_FLAT = 1e-9  # of the largest coordinate, below which known places lie on one line


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
class PointLandmarks:
    """L points, and S observations of them.

    ids             (L,) unique; position (L, d), m, NaN where there is no guess
    pose, landmark  (S,) rows of an observation; z (S, d) in the frame of the pose, m; information (S, d, d)

    Raises `InputError` where these do not fit together.
    """

    ids: IntArray
    position: FloatArray
    pose: IntArray
    landmark: IntArray
    z: FloatArray
    information: FloatArray

    def __post_init__(self) -> None:
        ids, n = checked_ids("ids", self.ids), len(checked_rows("pose", self.pose))
        landmark = checked_rows("landmark", self.landmark, n)
        if ((landmark < 0) | (landmark >= len(ids))).any():
            raise InputError(f"landmark: expected rows of the {len(ids)} landmarks, from 0")
        z = checked("z", self.z, (n, np.asarray(self.position).shape[-1]))
        checked_covariances("information", self.information, n, z.shape[1])

    def factors(self, landmark_key: int) -> ResidualFactors:
        """Factors of the keys of a graph: poses from 0, landmarks from `landmark_key`."""
        keys = np.stack([self.pose, self.landmark + landmark_key], axis=1)
        covariances = np.linalg.inv(self.information)
        dim = self.z.shape[1]
        return relative_factors(keys, self.z, (covariances + covariances.swapaxes(1, 2)) / 2, dim, range(dim))

    def placed(self, world_T_pose: FloatArray) -> PointLandmarks:
        """The landmarks where they are seen from these poses (least squares)."""
        d = self.z.shape[1]
        R, t = world_T_pose[self.pose, :d, :d], world_T_pose[self.pose, :d, d:]
        each = R @ self.information @ R.swapaxes(1, 2)
        H, b = np.zeros((len(self.ids), d, d)), np.zeros((len(self.ids), d, 1))
        np.add.at(H, self.landmark, each)
        np.add.at(b, self.landmark, each @ (R @ self.z[:, :, None] + t))
        return replace(self, position=np.asarray(np.linalg.solve(H, b)[:, :, 0]))


_ORTHONORMAL = 1e-6


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses in the plane (d = 2) or in space (d = 3), and measurements between them.

    ids             (N,) unique, of the poses
    world_T_pose    (N, d + 1, d + 1) a first guess of the poses
    first, second   (M,) rows of the poses between which was measured
    first_T_second  (M, d + 1, d + 1) the measurements
    information     (M, k, k) of the tangent, k = 3 or 6; positive definite
    landmarks       points seen from the poses
    priors          poses known from outside
    places          places of poses known from outside; without priors and places the first pose is held

    Raises `InputError` where these do not fit together, or a rotation is none.
    """

    ids: IntArray
    world_T_pose: FloatArray
    first: IntArray
    second: IntArray
    first_T_second: FloatArray
    information: FloatArray
    landmarks: PointLandmarks | None = None
    priors: PosePriors | None = None
    places: PositionPriors | None = None

    @classmethod
    def of_measurements(
        cls,
        ids: IntArray,
        first: IntArray,
        second: IntArray,
        first_T_second: FloatArray,
        information: FloatArray,
        priors: PosePriors | None = None,
        places: PositionPriors | None = None,
    ) -> PoseGraph:
        """A graph without a guess: poses start at dead reckoning from the first one, along the fewest measurements.

        Poses that no measurements connect with the first one start where it is.
        """
        size = np.asarray(first_T_second).shape[-1]
        still = np.tile(np.eye(size), (len(ids), 1, 1))
        graph = cls(ids, still, first, second, first_T_second, information, priors=priors, places=places)
        if not len(graph):
            return graph
        poses = _dead_reckoned(graph)
        return graph.at(poses if priors is not None or places is None else places.fitted(poses))

    def __post_init__(self) -> None:
        ids = checked_ids("ids", self.ids)
        size = np.asarray(self.world_T_pose).shape[-1:]
        if size not in ((3,), (4,)):
            raise InputError(f"world_T_pose: expected 3 x 3 or 4 x 4 transforms, got shape {size}")
        d = size[0] - 1
        first, second = checked_rows("first", self.first), checked_rows("second", self.second, len(self.first))
        for name, rows in (("first", first), ("second", second)):
            if ((rows < 0) | (rows >= len(ids))).any():
                raise InputError(f"{name}: expected rows of the {len(ids)} poses, from 0")
        refuse(first == second, lambda row: InputError(f"second[{row}]: expected another pose than the first"))
        poses = _checked_transforms("world_T_pose", self.world_T_pose, len(ids), d)
        between = _checked_transforms("first_T_second", self.first_T_second, len(first), d)
        information = checked_covariances("information", self.information, len(first), 3 * (d - 1))
        for name, array in (
            ("ids", ids), ("world_T_pose", poses), ("first", first), ("second", second),
            ("first_T_second", between), ("information", information),
        ):  # fmt: skip
            object.__setattr__(self, name, array)

    @property
    def rotation(self) -> slice:
        """Entries of the rotation in the tangent."""
        return slice(2, 3) if self.dim == 2 else slice(0, 3)

    @property
    def translation(self) -> slice:
        """Entries of the translation in the tangent."""
        return slice(0, 2) if self.dim == 2 else slice(3, 6)

    @property
    def dim(self) -> int:
        """2 in the plane, 3 in space."""
        return int(self.world_T_pose.shape[-1]) - 1

    def __len__(self) -> int:
        return len(self.ids)

    def at(self, world_T_pose: FloatArray) -> PoseGraph:
        """Return this graph with other poses."""
        return replace(self, world_T_pose=world_T_pose)

    def with_landmarks(self, landmarks: PointLandmarks | None) -> PoseGraph:
        """Return this graph with landmarks; those without a guess are placed where the poses see them."""
        if landmarks is not None and np.isnan(landmarks.position).any():
            landmarks = landmarks.placed(self.world_T_pose)
        return replace(self, landmarks=landmarks)

    @property
    def anchored(self) -> bool:
        """True if priors or places say where the graph is."""
        return self.priors is not None or self.places is not None

    def with_frame_as_pose(self) -> PoseGraph:
        """Return this graph with priors as measurements from one more pose, the last: the frame they are given in.

        Places are in this frame too, and remain.
        """
        priors, n = self.priors, len(self)
        if not self.anchored:
            return self
        graph = replace(
            self,
            ids=np.append(
                self.ids, np.setdiff1d(np.arange(n + 1), self.ids)[0]
            ),  # one more than the largest may be none
            world_T_pose=np.concatenate([self.world_T_pose, np.eye(self.dim + 1)[None]]),
        )
        if priors is None:
            return graph
        return replace(
            graph,
            first=np.concatenate([self.first, np.full(len(priors.pose), n)]),
            second=np.concatenate([self.second, priors.pose]),
            first_T_second=np.concatenate([self.first_T_second, priors.world_T_pose]),
            information=np.concatenate([self.information, priors.information]),
            priors=None,
        )

    def in_its_frame(self, poses: FloatArray) -> FloatArray:
        """Return poses (N, d + 1, d + 1), given those of `with_frame_as_pose` up to a common motion.

        Without priors and places the first pose is then that of the graph.
        """
        if not self.anchored:
            return np.asarray(self.world_T_pose[0] @ np.linalg.inv(poses[0]) @ poses)
        return np.asarray(np.linalg.inv(poses[-1]) @ poses[:-1])

    def check_connected(self) -> None:
        """Raise `InputError` for a graph that measurements between poses do not connect."""
        expected = "expected measurements that connect it with the first pose"
        refuse(self.components() != 0, lambda row: InputError(f"pose {self.ids[row]}: {expected}"))

    def components(self) -> IntArray:
        """Return the connected component (N,) of each pose, numbered from 0 in the order of their first poses."""
        _, label = connected_components(_joined(self))
        _, first_row, part = np.unique(label, return_index=True, return_inverse=True)
        return np.asarray(np.argsort(np.argsort(first_row))[part], dtype=np.int64)


def trusted(graph: PoseGraph) -> BoolArray:
    """Mask (M,) of the measurements that are odometry: between successive poses."""
    return np.asarray(np.abs(graph.second - graph.first) == 1)


def _joined(graph: PoseGraph) -> csr_array:
    """Sparse matrix (N, N) with an entry for each measured pair."""
    entries = (np.ones(len(graph.first)), (graph.first, graph.second))
    return coo_array(entries, shape=(len(graph), len(graph))).tocsr()


def _dead_reckoned(graph: PoseGraph) -> FloatArray:
    first, second = graph.first.tolist(), graph.second.tolist()
    order, before = breadth_first_order(_joined(graph), 0, directed=False)
    edge_of = dict(zip(zip(first, second, strict=True), range(len(first)), strict=True))
    poses = graph.world_T_pose.copy()
    for row in order[1:].tolist():
        parent = int(before[row])
        if (edge := edge_of.get((parent, row))) is not None:
            poses[row] = poses[parent] @ graph.first_T_second[edge]
        else:
            poses[row] = poses[parent] @ np.linalg.inv(graph.first_T_second[edge_of[row, parent]])
    return poses


def _checked_transforms(name: str, value: FloatArray, count: int, d: int) -> FloatArray:
    T = checked(name, value, (count, d + 1, d + 1))
    R = T[:, :d, :d]
    skew = np.abs(R @ R.swapaxes(1, 2) - np.eye(d)).max(axis=(1, 2), initial=0.0)
    bad = (skew > _ORTHONORMAL) | (np.linalg.det(R) < 0) | (T[:, d] != np.eye(d + 1)[d]).any(axis=1)
    refuse(bad, lambda row: InputError(f"{name}[{row}]: expected a rigid transform (orthonormal rotation)"))
    return T
