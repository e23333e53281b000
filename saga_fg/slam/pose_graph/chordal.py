"""A start for pose-graph optimisation without a guess: rotations first, then positions, each a linear problem.

Rotations, relaxed to matrices and anchored at R_0 = 1 (chordal relaxation):

    min  sum_e  kappa_e || R_second - R_first R_e ||_F^2

then each is replaced by the nearest rotation (polar decomposition). With these, the positions:

    min  sum_e  tau_e || t_second - t_first - R_first t_e ||^2

with the weights of the chordal cost (`saga_fg.slam.pose_graph.chordal_cost`), whose minimum is near.

Source: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM: a survey on rotation
estimation and its use in pose graph optimization", ICRA 2015. Both systems are sparse and solved directly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.pose_graph.chordal_cost import edge_matrix, edge_weights
from saga_fg.slam.pose_graph.graph import PoseGraph


def chordal_poses(graph: PoseGraph) -> FloatArray:
    """Return poses (N, d + 1, d + 1) from the measurements and priors alone; without priors the first is fixed.

    Known places move the whole where there are no known poses.

    Raises `InputError` for a graph that is not connected.
    """
    d, inner = graph.dim, replace(graph, places=None)
    whole = inner.with_frame_as_pose()
    apart = whole.components() != 0
    if apart.any():
        raise InputError(f"pose {int(whole.ids[apart][0])}: expected measurements that connect it with the first pose")
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
