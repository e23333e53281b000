"""SAGA-KF itself: one Kalman filter over the joint state of all nodes of the scene graph (Sani et al., ICPR 2024).

    predict   m <- F m + b              P <- F P F^T + Q                    F block-sparse, Q block-diagonal
    update    S = H P H^T + R = L L^T   W = L^-1 H P    m <- m + W^T L^-1 (z - H m)    P <- P - W^T W

The covariance is dense: interactions correlate all nodes of a connected graph.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import ArrayLike

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.errors import InputError
from saga_fg.estimators.layout import Layout, checked_prior
from saga_fg.estimators.protocol import Measurements
from saga_fg.transition import Transition


@dataclass(frozen=True, eq=False)
class JointState:
    """What a joint filter knows: nodes (n,), sizes of their states (n,), mean (D,), covariance (D, D)."""

    nodes: IntArray
    dims: IntArray
    mean: FloatArray
    covariance: FloatArray


class JointKalmanFilter:
    """The exact filter on the joint state. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    def __init__(self) -> None:
        self._layout = Layout()
        self._mean: FloatArray = np.empty(0)
        self._covariance: FloatArray = np.empty((0, 0))

    @property
    def nodes(self) -> IntArray:
        return self._layout.nodes

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._layout.extended(nodes, mean.shape[1])
        old = self._layout.size
        P = np.zeros((layout.size, layout.size))
        P[:old, :old] = self._covariance
        span = layout.spans(np.arange(len(self._layout), len(layout)))
        P[span[:, :, None], span[:, None, :]] = covariance
        self._layout, self._mean, self._covariance = layout, np.concatenate([self._mean, mean.ravel()]), P

    def predict(self, transition: Transition) -> None:
        rows = self._layout.rows(transition.nodes)
        if len(rows) != len(self._layout):
            raise InputError(f"transition: expected {len(self._layout)} nodes, got {len(rows)}")
        if (self._layout.dims[rows] != transition.graph.dims).any():
            raise InputError("transition: the sizes of its states differ from those of the estimator")
        if (rows != np.arange(len(rows))).any():
            self._reorder(rows)
        F = transition.F_matrix
        self._mean = F @ self._mean + transition.b
        half = F @ self._covariance
        P = F @ half.T
        for blocks in transition.Q:
            span = self._layout.spans(blocks.target)
            P[span[:, :, None], span[:, None, :]] += blocks.values
        self._covariance = (P + P.T) / 2

    def update(self, measurements: Measurements) -> float:
        if len(measurements) == 0:
            return 0.0
        span = self._layout.spans(self._layout.rows(measurements.nodes))
        m, k, d = measurements.H.shape
        if span.shape[1] != d:
            raise InputError(f"H: expected {span.shape[1]} columns, the size of the nodes' states, got {d}")
        indptr = np.arange(m * k + 1) * d
        columns = np.repeat(span, k, axis=0).ravel()
        H = scipy.sparse.csr_matrix((measurements.H.ravel(), columns, indptr), shape=(m * k, self._layout.size))
        innovation = measurements.z.ravel() - H @ self._mean
        HP = H @ self._covariance
        S = H @ HP.T
        at = np.arange(m * k).reshape(m, k)
        S[at[:, :, None], at[:, None, :]] += measurements.R
        L = scipy.linalg.cholesky((S + S.T) / 2, lower=True, overwrite_a=True, check_finite=False)
        W = scipy.linalg.solve_triangular(L, HP, lower=True, check_finite=False)
        whitened = scipy.linalg.solve_triangular(L, innovation, lower=True, check_finite=False)
        self._mean = self._mean + W.T @ whitened
        self._covariance = self._covariance - W.T @ W
        log_det = 2 * float(np.log(np.diag(L)).sum())
        return float(-0.5 * (whitened @ whitened + log_det + m * k * math.log(2 * math.pi)))

    def marginalise(self, nodes: ArrayLike) -> None:
        rows = self._layout.rows(nodes)
        layout = self._layout.without(rows)
        keep = np.ones(self._layout.size, dtype=bool)
        keep[self._layout.places(rows)] = False
        self._mean, self._covariance = self._mean[keep], self._covariance[np.ix_(keep, keep)]
        self._layout = layout

    def mean(self, nodes: ArrayLike) -> FloatArray:
        return np.asarray(self._mean[self._layout.spans(self._layout.rows(nodes))])

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        span = self._layout.spans(self._layout.rows(nodes))
        return np.asarray(self._covariance[span[:, :, None], span[:, None, :]])

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        return np.asarray(self._mean[self._layout.places(self._layout.rows(nodes))])

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        places = self._layout.places(self._layout.rows(nodes))
        return np.asarray(self._covariance[np.ix_(places, places)])

    def snapshot(self) -> JointState:
        """The whole state, as a value."""
        return JointState(self._layout.nodes, self._layout.dims, self._mean, self._covariance)

    def restore(self, state: JointState) -> None:
        """Continue from a snapshot, bit-identically."""
        self._layout = Layout(state.nodes, state.dims)
        self._mean, self._covariance = state.mean, state.covariance

    def _reorder(self, rows: IntArray) -> None:
        places = self._layout.places(rows)
        self._mean, self._covariance = self._mean[places], self._covariance[np.ix_(places, places)]
        self._layout = Layout(self._layout.nodes[rows], self._layout.dims[rows])
