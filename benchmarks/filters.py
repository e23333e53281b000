r"""Filters of flocks behind one interface: the textbook's, ours, GTSAM's window, and filters with edge states.

The filters with edge states are those of graph tracking (Bal et al., Bayesian Tracking of Video Graphs Using Joint
Kalman Smoothing and Registration, ECCV 2022, as Sani and Anand, arXiv 2411.03702, describe it). Besides the n nodes
x_i, the relations e_ij = x_j - x_i of all ordered pairs are states with means and covariances of their own, and
interactions act through them. From the dynamics x' = F x + b + q of the scene graph, which the node-only filter uses as
they are,

    x_i' = Phi_i x_i + sum_j F_ij e_ij + b_i + q_i                    Phi_i = F_ii + sum_j F_ij
    e_ij' = x_j' - x_i'

Two readings, since neither paper's text fixes how far the n^2 edges are correlated. `JointGraphTracking` is one
Gaussian over all 4 n^2 components, starts with e = x_j - x_i, and gives the node-only filter's answer. In
`SeparateGraphTracking` each node and each edge has its own covariance, which is what n^2 edge attributes at best cost.
There an edge is measured, as z_j - z_i with the noise of both, where both its ends are seen, and correlations between
nodes and edges are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from benchmarks.flocks import DT, Flock, FlockFrame
from factors import gaussian_factors, interaction_factors, nonlinear_graph, prior_factors
from saga_fg.estimators import Estimator, Gaussian, GraphFilter, kalman_predict, kalman_update
from saga_fg.numerics import FloatArray, IntArray

Step = Callable[[], None]
Read = tuple[FloatArray, FloatArray]  # newest means (n, 4) and covariances (n, 4, 4)
D = 4  # size of a node's state, and of an edge's


class Filter(Protocol):
    """A contender. What `prepare` does itself is not timed, the step that it returns is."""

    def prepare(self, frame: FlockFrame) -> Step:
        """The step that takes a frame in and reads out what is asked of all contenders."""
        ...

    def read(self) -> Read:
        """What was read in the latest step."""
        ...


class Ours:
    """An estimator of this package; all newest means and covariances are read."""

    def __init__(self, estimator: Estimator, flock: Flock) -> None:
        self.estimator, self._nodes = estimator, flock.nodes
        estimator.add(flock.nodes, flock.means, flock.covariances)

    def prepare(self, frame: FlockFrame) -> Step:
        return partial(self.step, frame)

    def step(self, frame: FlockFrame) -> None:
        self.estimator.predict(frame.transition)
        self.estimator.update(frame.measurements)
        self._read = self.estimator.mean(self._nodes), self.estimator.covariance(self._nodes)

    def read(self) -> Read:
        return self._read


class OurWindow(Ours):
    """The running graph over a window; the means of the whole window and the newest covariances are read."""

    def __init__(self, lag: int, flock: Flock) -> None:
        self._smoother = GraphFilter(lag=lag * DT)
        super().__init__(self._smoother, flock)

    def step(self, frame: FlockFrame) -> None:
        super().step(frame)
        self.window = [mean for _, _, mean in self._smoother.smoothed_means()]


class Textbook:
    """The textbook filter on the dense joint state."""

    def __init__(self, flock: Flock) -> None:
        self._x, self._n = Gaussian(flock.means.ravel(), scipy.linalg.block_diag(*flock.covariances)), len(flock)

    def prepare(self, frame: FlockFrame) -> Step:
        return partial(self._step, *dense(frame))

    def _step(self, F: FloatArray, b: FloatArray, Q: FloatArray, z: FloatArray, H: FloatArray, R: FloatArray) -> None:
        self._x, _ = kalman_update(kalman_predict(self._x, F, b, Q), z, H, R)
        self._read = blocks(self._x.mean, self._x.covariance, self._n)

    def read(self) -> Read:
        return self._read


class GtsamWindow:
    """`gtsam.IncrementalFixedLagSmoother` on the same factors; the means of the whole window are read.

    Its factors are made before the clock runs, and its covariances, which cost it more than all the rest, are not read.
    """

    def __init__(self, lag: int, flock: Flock) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.enableRelinearization = False
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag * DT + 1e-6, parameters)
        self._n, self._frames = len(flock), 0
        keys = self._keys(0)
        priors = nonlinear_graph(
            prior_factors(keys, flock.means, flock.covariances).native(), dict.fromkeys(keys.tolist(), D)
        )
        self._smoother.update(priors, _zeros(keys), dict.fromkeys(keys.tolist(), 0.0))

    def prepare(self, frame: FlockFrame) -> Step:
        before, now = self._keys(self._frames), self._keys(self._frames + 1)
        self._frames += 1
        (F,) = frame.transition.F
        order = np.argsort(F.target, kind="stable")
        indptr, Q, b = np.searchsorted(F.target[order], np.arange(self._n + 1)), *_noise(frame, self._n)
        seen = frame.measurements
        stacks = [
            *interaction_factors(now, before[F.source[order]], indptr, F.values[order], b, Q),
            gaussian_factors(now[seen.nodes, None], [seen.H], seen.z, seen.R),
        ]
        factors = [factor for stack in stacks for factor in stack.native()]
        graph = nonlinear_graph(factors, dict.fromkeys([*before.tolist(), *now.tolist()], D))
        return partial(self._step, graph, _zeros(now), dict.fromkeys(now.tolist(), self._frames * DT))

    def _step(self, *new: Any) -> None:
        self._smoother.update(*new)
        estimate = self._smoother.calculateEstimate()
        keys = sorted(self._smoother.timestamps())
        self.window = np.array([estimate.atVector(key) for key in keys]).reshape(-1, D * self._n)

    def read(self) -> Read:
        """Newest means and covariances, which take it seconds for more than 50 nodes."""
        keys = self._keys(self._frames).tolist()
        covariances = np.array([self._smoother.marginalCovariance(key) for key in keys])
        return self.window[-1].reshape(-1, D), covariances

    def _keys(self, frame: int) -> Any:
        return np.uint64(frame * self._n) + np.arange(self._n, dtype=np.uint64)


def _zeros(keys: Any) -> gtsam.Values:
    values = gtsam.Values()
    for key in keys.tolist():
        values.insert(key, np.zeros(D))
    return values


class JointGraphTracking:
    """One Kalman filter over nodes and edges."""

    def __init__(self, flock: Flock) -> None:
        n = self._n = len(flock)
        self._first, self._second = np.nonzero(~np.eye(n, dtype=bool))
        # (x, e) = lift x
        ends = scipy.sparse.csr_array(np.eye(n)[self._second] - np.eye(n)[self._first])
        relations = scipy.sparse.kron(ends, scipy.sparse.eye_array(D))
        self._lift = scipy.sparse.csr_array(scipy.sparse.vstack([scipy.sparse.eye_array(D * n), relations]))
        self._mean = self._lift @ flock.means.ravel()
        self._P = self._lift @ (self._lift @ scipy.linalg.block_diag(*flock.covariances)).T

    def prepare(self, frame: FlockFrame) -> Step:
        F, b, Q, z, H, R = dense(frame)
        lifted_Q = scipy.sparse.csr_array(self._lift @ scipy.sparse.csr_array(Q) @ self._lift.T)
        wide_H = scipy.sparse.csr_array(np.pad(H, ((0, 0), (0, len(self._mean) - H.shape[1]))))
        whole_F = scipy.sparse.csr_array(self._lift @ self._of_nodes(F))
        return partial(self._step, whole_F, self._lift @ b, lifted_Q, z, wide_H, R)

    def _step(self, F: Any, b: FloatArray, Q: Any, z: FloatArray, H: Any, R: FloatArray) -> None:
        mean = F @ self._mean + b
        P = F @ (F @ self._P).T
        P += Q
        HP = H @ P
        L = np.linalg.cholesky(H @ HP.T + R)
        W = scipy.linalg.solve_triangular(L, HP, lower=True)
        self._mean = mean + W.T @ scipy.linalg.solve_triangular(L, z - H @ mean, lower=True)
        self._P = P - W.T @ W

    def read(self) -> Read:
        return blocks(self._mean, self._P, self._n)

    def _of_nodes(self, F: FloatArray) -> scipy.sparse.csr_array:
        """(4 n, 4 n^2): the nodes' next states, where what neighbours contribute acts through edges."""
        parts = F.reshape(self._n, D, self._n, D)
        own = scipy.linalg.block_diag(*parts.sum(axis=2))
        edges = np.zeros((self._n, D, len(self._first), D))
        edges[self._first, :, np.arange(len(self._first))] = parts[self._first, :, self._second]
        return scipy.sparse.csr_array(np.concatenate([own, edges.reshape(D * self._n, -1)], axis=1))


class SeparateGraphTracking:
    """A Kalman filter for every node and every edge."""

    def __init__(self, flock: Flock) -> None:
        self._x, self._P = flock.means, flock.covariances
        self._e = self._x[None] - self._x[:, None]
        self._E = self._P[None] + self._P[:, None]

    def prepare(self, frame: FlockFrame) -> Step:
        n = len(self._x)
        F = frame.transition.F_matrix.toarray().reshape(n, D, n, D)
        Phi, F = F.sum(axis=2), F.transpose(0, 2, 1, 3).copy()
        F[np.arange(n), np.arange(n)] = 0.0
        target, source = np.nonzero(F.any(axis=(2, 3)))
        return partial(self._step, frame, Phi, F[target, source], target, source, *_noise(frame, n))

    def _step(
        self,
        frame: FlockFrame,
        Phi: FloatArray,
        F: FloatArray,
        target: IntArray,
        source: IntArray,
        Q: FloatArray,
        b: FloatArray,
    ) -> None:
        """Predict nodes, and edges as the differences of what their ends are predicted to do; then correct both."""
        n = len(self._x)
        drift = _summed(target, (F @ self._e[target, source][..., None])[..., 0], n) + b
        spread = _summed(target, F @ self._E[target, source] @ np.swapaxes(F, 1, 2), n) + Q
        self._x = (Phi @ self._x[..., None])[..., 0] + drift
        self._P = Phi @ self._P @ np.swapaxes(Phi, 1, 2) + spread
        wide = Phi[:, None]
        self._e = (wide @ self._e[..., None])[..., 0] + drift[None] - drift[:, None]
        self._E = wide @ self._E @ np.swapaxes(wide, -1, -2) + spread[None] + spread[:, None]
        seen = frame.measurements
        if len(seen):
            rows, H = seen.nodes, seen.H[0]
            self._x[rows], self._P[rows] = _updated(self._x[rows], self._P[rows], seen.z, H, seen.R)
            pairs = rows[:, None], rows[None]
            z, R = seen.z[None] - seen.z[:, None], seen.R[None] + seen.R[:, None]
            self._e[pairs], self._E[pairs] = _updated(self._e[pairs], self._E[pairs], z, H, R)

    def read(self) -> Read:
        return self._x, self._P


def _summed(target: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Values (E, ...) added up by target: (n, ...)."""
    total = np.zeros((n, *values.shape[1:]))
    np.add.at(total, target, values)
    return total


def _updated(x: FloatArray, P: FloatArray, z: FloatArray, H: FloatArray, R: FloatArray) -> Read:
    """Kalman's update of many states at once."""
    HP = H @ P
    K = np.swapaxes(np.linalg.solve(HP @ H.T + R, HP), -1, -2)
    return x + (K @ (z - x @ H.T)[..., None])[..., 0], P - K @ HP


def blocks(mean: FloatArray, covariance: FloatArray, n: int) -> Read:
    """Means and covariances of the first n nodes, one by one, of a dense Gaussian."""
    at = np.arange(D * n).reshape(-1, D)
    return mean[at], covariance[at[:, :, None], at[:, None, :]]


def dense(frame: FlockFrame) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """F, b, Q, z, H, R of a frame as the textbook wants them."""
    transition, seen = frame.transition, frame.measurements
    H = np.zeros((2 * len(seen), len(transition.b)))
    row = np.arange(2 * len(seen)).reshape(-1, 2)
    H[row[:, :, None], (D * seen.nodes[:, None] + np.arange(D))[:, None, :]] = seen.H
    R = scipy.linalg.block_diag(*seen.R) if len(seen) else np.empty((0, 0))
    return transition.F_matrix.toarray(), transition.b, transition.Q_matrix.toarray(), seen.z.ravel(), H, R


def _noise(frame: FlockFrame, n: int) -> tuple[FloatArray, FloatArray]:
    """Q (n, 4, 4) and b (n, 4) of the nodes."""
    Q = np.zeros((n, D, D))
    for part in frame.transition.Q:
        Q[part.target] = part.values
    return Q, frame.transition.b.reshape(n, D)
