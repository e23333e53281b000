"""The chordal cost of a pose graph, and a start that minimises it without a guess.

The chordal cost of a pose graph, a quadratic form in rotation matrices and positions.

    F = sum_e  kappa_e || R_second - R_first R_e ||_F^2 + tau_e || t_second - t_first - R_first t_e ||^2
      = tr( Y^T M Y ),      Y = ( Y_1; ...; Y_N ),  Y_i = ( R_i^T; t_i^T ),  M = A^T W A

    kappa_e = d / (2 tr(Sigma_R,e)) in space, 1 / tr(Sigma_R,e) in the plane,      tau_e = d / tr(Sigma_t,e)

with an edge a row of blocks of A: 1 at its second pose, -T_e^T at its first one. Its minimum is not that of the cost of
`saga_fg.slam.pose_graph.graph`, which measures rotations by their angle, but near it; and whether a minimum is the
global one can be proved (`saga_fg.slam.pose_graph.certificate`).

A point l seen at z from a pose, with information Omega, adds a row (1 at the point, -(z^T, 1) at the pose):

    tau || l - t - R z ||^2,      tau = d / tr(Omega^-1)

and a prior is an edge from one more pose, the frame that it is given in. A known place is a point z seen from there,
with the position of the pose in place of l.

Positions are free, and the best ones for given rotations solve a linear problem. What is left is a form in Y_R alone,

    F = tr( Y_R^T Q Y_R ),     Q = M_RR - M_Rt M_tt^+ M_tR

Source: Rosen, Carlone, Bandeira, Leonard, SE-Sync: a certifiably correct algorithm for synchronization over the special
Euclidean group, IJRR 2019, equations 20 to 24; the weights are those of its implementation.

A start for pose-graph optimisation without a guess: rotations first, then positions, each a linear problem.

Rotations, relaxed to matrices and anchored at R_0 = 1 (chordal relaxation):

    min  sum_e  kappa_e || R_second - R_first R_e ||_F^2

then each is replaced by the nearest rotation (polar decomposition). With these, the positions:

    min  sum_e  tau_e || t_second - t_first - R_first t_e ||^2

with the weights of the chordal cost, whose minimum is near.

Source: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM: a survey on rotation
estimation and its use in pose graph optimization", ICRA 2015. Both systems are sparse and solved directly.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.sparse import block_diag, bsr_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from saga_fg.numerics import FloatArray, IntArray
from saga_fg.slam.pose_graph.graph import PoseGraph

_FASTER = 15.0  # operations of a factorisation in the time of one of a product, from grids to loops
_FLOOR = 1e-9  # of the largest diagonal entry of M, added to make it definite: rotations and positions are relative


def edge_weights(graph: PoseGraph) -> tuple[FloatArray, FloatArray]:
    """kappa (M,), 1 / rad^2, and tau (M,), 1 / m^2, of the measurements."""
    covariance = np.linalg.inv(graph.information)
    turn = np.trace(covariance[:, graph.rotation, graph.rotation], axis1=1, axis2=2)
    shift = np.trace(covariance[:, graph.translation, graph.translation], axis1=1, axis2=2)
    return (1.0 if graph.dim == 2 else 1.5) / turn, graph.dim / shift


def edge_matrix(graph: PoseGraph, first: FloatArray, second: FloatArray) -> csc_array:
    """Sparse matrix with a row of blocks for each edge: (M, b, b) in the columns of its two poses."""
    m, b = first.shape[:2]
    blocks, columns = np.stack([first, second], axis=1), np.stack([graph.first, graph.second], axis=1)
    entries = (blocks.reshape(-1, b, b), columns.ravel(), 2 * np.arange(m + 1))
    return bsr_array(entries, shape=(m * b, len(graph) * b)).tocsc()


@dataclass(frozen=True, eq=False)
class ChordalCost:
    """M (N (d + 1) + L, N (d + 1) + L) of a pose graph of N poses, with the frame of its priors, and L points."""

    dim: int
    poses: int
    M: csc_array

    @classmethod
    def of(cls, graph: PoseGraph) -> Self:
        """The cost of all measurements of a graph."""
        graph = graph.with_frame_as_pose()
        d, (kappa, tau) = graph.dim, edge_weights(graph)
        T = graph.first_T_second
        A = edge_matrix(graph, -T.swapaxes(1, 2), np.broadcast_to(np.eye(d + 1), T.shape))
        W = np.column_stack([np.tile(kappa[:, None], (1, d)), tau]).ravel()
        M = (A.T @ diags_array(W) @ A).tocsc()
        points = 0 if graph.landmarks is None else len(graph.landmarks.ids)
        M = block_diag([M, csc_array((points,) * 2)], format="csc") if points else M
        size, n = M.shape[0], len(graph)
        if (seen := graph.landmarks) is not None:
            weight = d / np.trace(np.linalg.inv(seen.information), axis1=1, axis2=2)
            M = M + _point_form(size, d, seen.pose, n * (d + 1) + seen.landmark, seen.z, weight)
        if (places := graph.places) is not None:
            frame = np.full(len(places.pose), n - 1)
            M = M + _point_form(size, d, frame, places.pose * (d + 1) + d, places.position, places.weight)
        return cls(d, len(graph), M.tocsc())

    def at(self, world_T_pose: FloatArray, points: FloatArray | None = None) -> float:
        """F of poses (N, d + 1, d + 1) and points (L, d)."""
        Y = world_T_pose[:, : self.dim].swapaxes(1, 2).reshape(-1, self.dim)
        Y = Y if points is None else np.concatenate([Y, points])
        return float((Y * (self.M @ Y)).sum())

    @cached_property
    def rotations(self) -> IntArray:
        """Rows of Y_R."""
        rows = np.arange(self.poses * (self.dim + 1))
        return np.asarray(rows[rows % (self.dim + 1) != self.dim])

    @cached_property
    def positions(self) -> IntArray:
        """Rows of Y_t: of the poses, then of the points."""
        return np.delete(np.arange(self.M.shape[0]), self.rotations)

    def times(self, Y: FloatArray) -> FloatArray:
        """Q Y for Y (N d, r)."""
        t = self.best_positions(Y)
        return np.asarray(self._M_RR @ Y + self._M_Rt @ t)

    def best_positions(self, Y: FloatArray) -> FloatArray:
        """Y_t (N + L, r) of least cost for Y_R (N d, r), the first being 0."""
        t = np.zeros((len(self.positions), Y.shape[1]))
        if len(t) > 1:
            t[1:] = self._positions_solver.solve(np.ascontiguousarray(-(self._M_Rt.T @ Y)[1:]))
        return t

    def preconditioned(self, Y: FloatArray) -> FloatArray:
        """(Q + floor)^-1 Y for Y (N d, r), as the block of the inverse of the whole matrix."""
        whole = np.zeros((self.M.shape[0], Y.shape[1]))
        whole[self.rotations] = Y
        return np.asarray(self._solver.solve(whole)[self.rotations])

    @cached_property
    def entries(self) -> int:
        """Entries of the factors that a product with Q and with its preconditioner pass: what these cost."""
        return int(self._solver.L.nnz + (self._positions_solver.L.nnz if len(self.positions) > 1 else 0))

    @cached_property
    def products_per_factorisation(self) -> float:
        """Products with Q and its preconditioner that take as long as a factorisation of a matrix with M's entries."""
        column = np.diff(self._solver.L.indptr).astype(np.float64)
        return float((column**2).sum() / column.sum()) / _FASTER

    @cached_property
    def _M_RR(self) -> csc_array:
        return self.M[self.rotations][:, self.rotations]

    @cached_property
    def _M_Rt(self) -> csc_array:
        return self.M[self.rotations][:, self.positions]

    @cached_property
    def _positions_solver(self) -> SuperLU:
        free = self.positions[1:]
        return factorised(self.M[free][:, free])

    @cached_property
    def _solver(self) -> SuperLU:
        return factorised(self.M + _FLOOR * self.M.diagonal().max() * diags_array(np.ones(self.M.shape[0])))


def _point_form(size: int, d: int, pose: IntArray, column: IntArray, z: FloatArray, weight: FloatArray) -> csc_array:
    """The form (size, size) of points, whose positions stand in a column (S,) of A each, seen at z from poses."""
    ones = np.ones((len(z), 1))
    columns = np.column_stack([pose[:, None] * (d + 1) + np.arange(d + 1), column])
    entries = (np.hstack([-z, -ones, ones]).ravel(), columns.ravel(), (d + 2) * np.arange(len(z) + 1))
    A = csr_array(entries, shape=(len(z), size)).tocsc()
    return (A.T @ diags_array(weight) @ A).tocsc()


def factorised(matrix: csc_array) -> SuperLU:
    """LU without exchange of rows, of a symmetric matrix: U has the signs of its eigenvalues on the diagonal."""
    options = {"SymmetricMode": True}
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def chordal_poses(graph: PoseGraph) -> FloatArray:
    """Return poses (N, d + 1, d + 1) from the measurements and priors alone; without priors the first is fixed.

    Known places move the whole where there are no known poses.

    Raises `InputError` for a graph that is not connected.
    """
    d, inner = graph.dim, replace(graph, places=None)
    whole = inner.with_frame_as_pose()
    whole.check_connected()
    kappa, tau = edge_weights(whole)
    poses = np.tile(np.eye(d + 1), (len(whole), 1, 1))
    poses[:, :d, :d] = _rotations(whole, kappa)
    poses[:, :d, d] = _positions(whole, poses[:, :d, :d], tau)
    poses = inner.in_its_frame(poses)
    return graph.places.fitted(poses) if graph.places is not None and graph.priors is None else poses


def nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Return the rotations (N, d, d) nearest to matrices (N, d, d) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(matrices)
    sign = np.ones(U.shape[:2])
    sign[:, -1] = np.linalg.det(U @ Vt)
    return np.asarray((U * sign[:, None, :]) @ Vt)


def _rotations(graph: PoseGraph, weight: FloatArray) -> FloatArray:
    """Return rotations (N, d, d); with X_i = R_i^T an edge has the residual X_second - R_e^T X_first in each column."""
    d = graph.dim
    R = graph.first_T_second[:, :d, :d]
    A = edge_matrix(graph, -R.swapaxes(1, 2), np.broadcast_to(np.eye(d), R.shape))
    X = _anchored(A, np.repeat(weight, d), np.zeros((len(R) * d, d)), np.eye(d))
    return nearest_rotations(X.reshape(-1, d, d).swapaxes(1, 2))


def _positions(graph: PoseGraph, R: FloatArray, weight: FloatArray) -> FloatArray:
    d, ones = graph.dim, np.ones((len(graph.first), 1, 1))
    moved = (R[graph.first] @ graph.first_T_second[:, :d, d:])[:, :, 0]
    return _anchored(edge_matrix(graph, -ones, ones), weight, moved, np.zeros((1, d)))


def _anchored(A: csc_array, weight: FloatArray, b: FloatArray, anchor: FloatArray) -> FloatArray:
    """Return x minimising sum_i weight_i (A x - b)_i^2 with its first rows fixed at `anchor`."""
    fixed, free = A[:, : len(anchor)], A[:, len(anchor) :]
    if free.shape[1] == 0:
        return anchor
    weighted = free.T @ diags_array(weight / weight.max())
    x = splu((weighted @ free).tocsc()).solve(np.asarray(weighted @ (b - fixed @ anchor)))
    return np.concatenate([anchor, x])
