r"""The other filter of the paper: graph tracking with node *and* edge states (Bal et al., Bayesian Tracking of Video
Graphs Using Joint Kalman Smoothing and Registration, ECCV 2022, as Sani and Anand, arXiv 2411.03702, describe it).

Besides the n nodes x_i, the relations e_ij = x_j - x_i of all ordered pairs are states with means and covariances of
their own, and interactions act through them. From the dynamics x' = F x + b + q of the scene graph, which the node-only
filter uses as they are,

    x_i' = Phi_i x_i + sum_j F_ij e_ij + b_i + q_i                    Phi_i = F_ii + sum_j F_ij
    e_ij' = x_j' - x_i'

Two readings, since neither paper's text fixes how far the n^2 edges are correlated:

    joint        one Gaussian over all 4 n^2 components; the edges' equation with sums of e_jk and e_ik in the place of
                 differences of x. It starts with e = x_j - x_i, and gives the node-only filter's answer.
    separate     each node and each edge has its own covariance, which is what n^2 edge attributes at best cost. An edge
                 is measured, as z_j - z_i with the noise of both, where both its ends are seen; own motion is that of
                 the target's, and correlations between nodes and edges are left out.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse

from benchmarks.contenders import dense
from benchmarks.flocks import Flock, FlockFrame
from saga_fg.numerics.arrays import FloatArray, IntArray

D = 4  # size of a node's state, and of an edge's


class JointGraphTracking:
    """One Kalman filter over nodes and edges; a `Filter` of `benchmarks.contenders`."""

    def __init__(self, flock: Flock) -> None:
        n = len(flock)
        self._n = n
        self._first, self._second = np.nonzero(~np.eye(n, dtype=bool))
        # (x, e) = lift x
        ends = scipy.sparse.csr_array(np.eye(n)[self._second] - np.eye(n)[self._first])
        relations = scipy.sparse.kron(ends, scipy.sparse.eye_array(D))
        self._lift = scipy.sparse.csr_array(scipy.sparse.vstack([scipy.sparse.eye_array(D * n), relations]))
        self._mean = self._lift @ flock.means.ravel()
        self._P = self._lift @ (self._lift @ scipy.linalg.block_diag(*flock.covariances)).T

    def prepare(self, frame: FlockFrame) -> None:
        F, b, Q, z, H, R = dense(frame)
        self._b, self._z, self._R = self._lift @ b, z, R
        self._Q = scipy.sparse.csr_array(self._lift @ scipy.sparse.csr_array(Q) @ self._lift.T)
        self._H = scipy.sparse.csr_array(np.pad(H, ((0, 0), (0, len(self._mean) - H.shape[1]))))
        self._F = scipy.sparse.csr_array(self._lift @ self._of_nodes(F))

    def step(self) -> None:
        mean = self._F @ self._mean + self._b
        P = self._F @ (self._F @ self._P).T
        P += self._Q
        HP = self._H @ P
        L = np.linalg.cholesky(self._H @ HP.T + self._R)
        W = scipy.linalg.solve_triangular(L, HP, lower=True)
        self._mean = mean + W.T @ scipy.linalg.solve_triangular(L, self._z - self._H @ mean, lower=True)
        self._P = P - W.T @ W

    def read(self) -> tuple[FloatArray, FloatArray]:
        at = np.arange(D * self._n).reshape(-1, D)
        return self._mean[at], self._P[at[:, :, None], at[:, None, :]]

    def _of_nodes(self, F: FloatArray) -> scipy.sparse.csr_array:
        """(4 n, 4 n^2): the nodes' next states, where what neighbours contribute acts through edges."""
        blocks = F.reshape(self._n, D, self._n, D)
        own = scipy.linalg.block_diag(*blocks.sum(axis=2))
        edges = np.zeros((self._n, D, len(self._first), D))
        k = np.arange(len(self._first))
        edges[self._first, :, k] = blocks[self._first, :, self._second]
        return scipy.sparse.csr_array(np.concatenate([own, edges.reshape(D * self._n, -1)], axis=1))


class SeparateGraphTracking:
    """A Kalman filter for every node and every edge; a `Filter` of `benchmarks.contenders`."""

    def __init__(self, flock: Flock) -> None:
        self._x, self._P = flock.means, flock.covariances
        self._e = self._x[None] - self._x[:, None]
        self._E = self._P[None] + self._P[:, None]

    def prepare(self, frame: FlockFrame) -> None:
        n, transition = len(self._x), frame.transition
        F = transition.F_matrix.toarray().reshape(n, D, n, D)
        own = np.arange(n)
        self._Phi = F.sum(axis=2)
        F = F.transpose(0, 2, 1, 3).copy()
        F[own, own] = 0.0
        self._target, self._source = np.nonzero(F.any(axis=(2, 3)))
        self._F = F[self._target, self._source]
        self._b = transition.b.reshape(n, D)
        self._Q = np.zeros((n, D, D))
        for blocks in transition.Q:
            self._Q[blocks.target] = blocks.values
        self._seen = frame.measurements

    def step(self) -> None:
        self._predict()
        seen = self._seen
        rows = seen.nodes
        self._x, self._P = self._x.copy(), self._P.copy()
        if len(rows) == 0:
            return
        self._x[rows], self._P[rows] = _updated(self._x[rows], self._P[rows], seen.z, seen.H[0], seen.R)
        i, j = rows[:, None], rows[None]
        z, R = seen.z[None] - seen.z[:, None], seen.R[None] + seen.R[:, None]
        self._e[i, j], self._E[i, j] = _updated(self._e[i, j], self._E[i, j], z, seen.H[0], R)

    def read(self) -> tuple[FloatArray, FloatArray]:
        return self._x, self._P

    def _predict(self) -> None:
        """Nodes, and edges as the differences of what their ends are predicted to do."""
        n = len(self._x)
        pull = _summed(self._target, (self._F @ self._e[self._target, self._source][..., None])[..., 0], n)
        spread = self._F @ self._E[self._target, self._source] @ np.swapaxes(self._F, 1, 2)
        spread = _summed(self._target, spread, n) + self._Q
        move = (self._Phi @ self._x[..., None])[..., 0]
        self._x = move + pull + self._b
        self._P = self._Phi @ self._P @ np.swapaxes(self._Phi, 1, 2) + spread
        Phi = self._Phi[:, None]
        drift = pull + self._b
        self._e = (Phi @ self._e[..., None])[..., 0] + drift[None] - drift[:, None]
        self._E = Phi @ self._E @ np.swapaxes(Phi, -1, -2) + spread[None] + spread[:, None]


def _summed(target: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Values (E, ...) added up by target: (n, ...)."""
    total = np.zeros((n, *values.shape[1:]))
    np.add.at(total, target, values)
    return total


def _updated(
    x: FloatArray, P: FloatArray, z: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Kalman's update of many states at once."""
    HP = H @ P
    K = np.swapaxes(np.linalg.solve(HP @ H.T + R, HP), -1, -2)
    return x + (K @ (z - x @ H.T)[..., None])[..., 0], P - K @ HP
