r"""Marginals of nodes whose correlations are left out, under a transition of the scene graph.

    m_i <- sum_j F_ij m_j + b_i        P_i <- sum_j F_ij P_j F_ij^T + Q_i

For nodes whose sources are known, such as tracks that go on beside a hidden one: there the correlation of a target with
its sources is lost anyway as soon as they are measured again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.estimators.base import EstimatorBase
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray


class Marginals(EstimatorBase):
    """n nodes with the ids 0 to n - 1 as far as a tracker's prediction needs an estimator.

    means (n, D), covariances (n, D, D): padded to the largest state
    wanted  the first so many are predicted, the others stay
    """

    time: float = 0.0
    nodes: IntArray = np.empty(0, dtype=np.int64)

    def __init__(self, means: FloatArray, covariances: FloatArray, wanted: int) -> None:
        self.means, self.covariances, self._wanted = means, covariances, wanted
        self.nodes = np.arange(len(means))

    def predict(self, transition: Transition) -> None:
        """Move the first nodes on by a transition over all."""
        m, P, n = self.means, self.covariances, self._wanted
        mean, covariance = m.copy(), P.copy()
        mean[:n], covariance[:n] = 0.0, 0.0
        for blocks in transition.F:
            mine = np.flatnonzero(blocks.target < n)
            t, s, F = blocks.target[mine], blocks.source[mine], blocks.values[mine]
            i, j = F.shape[1:]
            np.add.at(mean[:, :i], t, (F @ m[s, :j, None])[..., 0])
            np.add.at(covariance[:, :i, :i], t, F @ P[s, :j, :j] @ np.swapaxes(F, 1, 2))
        for blocks in transition.Q:
            mine = np.flatnonzero(blocks.target < n)
            t, d = blocks.target[mine], blocks.values.shape[1]
            covariance[t, :d, :d] += blocks.values[mine]
        dims, start = transition.graph.dims[:n], transition.offsets[:n]
        for d in np.unique(dims).tolist():
            rows = np.flatnonzero(dims == d)
            mean[rows, :d] += transition.b[start[rows][:, None] + np.arange(d)]
        self.means, self.covariances = mean, covariance
        self.time += transition.dt

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, D) means, padded."""
        return np.asarray(self.means[np.asarray(nodes)])

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, D, D) covariances, padded."""
        return np.asarray(self.covariances[np.asarray(nodes)])

    def planar_marginals(self, nodes: ArrayLike, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (k, 4) with their covariances (k, 4, 4); places (k, 4) in the states, -1: zeros."""
        rows, known = np.arange(len(places))[:, None], places >= 0
        mean = np.where(known, self.mean(nodes)[rows, places], 0.0)
        covariance = self.covariance(nodes)[rows[:, :, None], places[:, :, None], places[:, None, :]]
        return mean, np.where(known[:, :, None] & known[:, None, :], covariance, 0.0)
