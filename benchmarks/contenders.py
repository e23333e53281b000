"""Contenders behind one interface: the textbook filter, GTSAM's smoother, and the estimators of saga-fg."""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np
import scipy.linalg

from benchmarks.flocks import DT, Flock, FlockFrame
from factors import interaction_factors, linear_detection_factors, nonlinear_graph, position, prior_factors
from saga_fg.estimators import Estimator, FixedLagSmoother, Gaussian, kalman_predict, kalman_update
from saga_fg.numerics.arrays import FloatArray


class Contender(Protocol):
    """A method in the comparison. `prepare` is not timed, `step` is."""

    def prepare(self, frame: FlockFrame) -> None:
        """Do work of the benchmark that is not timed."""

    def step(self) -> None:
        """Take the frame in and read out what is asked of all of them."""


class Filter(Contender, Protocol):
    """A contender that tells means and covariances."""

    def read(self) -> tuple[FloatArray, FloatArray]:
        """Newest means (n, 4) and covariances (n, 4, 4)."""


class Ours:
    """An estimator of this package; all newest means and covariances are read."""

    def __init__(self, estimator: Estimator, flock: Flock) -> None:
        self.estimator = estimator
        self._nodes = flock.nodes
        estimator.add(flock.nodes, flock.means, flock.covariances)

    def prepare(self, frame: FlockFrame) -> None:
        self._frame = frame

    def step(self) -> None:
        self.estimator.predict(self._frame.transition)
        self.estimator.update(self._frame.measurements)
        self._means, self._covariances = self.estimator.mean(self._nodes), self.estimator.covariance(self._nodes)

    def read(self) -> tuple[FloatArray, FloatArray]:
        return self._means, self._covariances


class OurWindow(Ours):
    """The fixed-lag smoother; the means of the whole window and the newest covariances are read."""

    def __init__(self, lag: int, flock: Flock) -> None:
        self._smoother = FixedLagSmoother(lag * DT)
        super().__init__(self._smoother, flock)

    def step(self) -> None:
        super().step()
        self.window = [moment.state for moment in self._smoother.smoothed(covariances=False)]


class Textbook:
    """The textbook filter on the dense joint state."""

    def __init__(self, flock: Flock) -> None:
        self._x = Gaussian(flock.means.ravel(), scipy.linalg.block_diag(*flock.covariances))
        self._diagonal = np.arange(4 * len(flock)).reshape(-1, 4)

    def prepare(self, frame: FlockFrame) -> None:
        self._frame = dense(frame)

    def step(self) -> None:
        F, b, Q, z, H, R = self._frame
        self._x, _ = kalman_update(kalman_predict(self._x, F, b, Q), z, H, R)
        at = self._diagonal
        self._read = self._x.mean[at], self._x.covariance[at[:, :, None], at[:, None, :]]

    def read(self) -> tuple[FloatArray, FloatArray]:
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
        priors = nonlinear_graph(prior_factors(keys, flock.means, flock.covariances), dict.fromkeys(keys.tolist(), 4))
        self._smoother.update(priors, self._zeros(keys), dict.fromkeys(keys.tolist(), 0.0))

    def prepare(self, frame: FlockFrame) -> None:
        before, now = self._keys(self._frames), self._keys(self._frames + 1)
        self._frames += 1
        (F,) = frame.transition.F
        order = np.argsort(F.target, kind="stable")
        indptr = np.searchsorted(F.target[order], np.arange(self._n + 1))
        Q = np.zeros((self._n, 4, 4))
        for blocks in frame.transition.Q:
            Q[blocks.target] = blocks.values
        b = frame.transition.b.reshape(self._n, 4)
        seen = frame.measurements
        factors = [
            *interaction_factors(now, before[F.source[order]], indptr, F.values[order], b, Q),
            *linear_detection_factors(now[seen.nodes], position(4), seen.z, seen.R),
        ]
        dims = dict.fromkeys([*before.tolist(), *now.tolist()], 4)
        self._told = (
            nonlinear_graph(factors, dims),
            self._zeros(now),
            dict.fromkeys(now.tolist(), self._frames * DT),
        )

    def step(self) -> None:
        self._smoother.update(*self._told)
        self._estimate = self._smoother.calculateEstimate()
        keys = sorted(self._smoother.timestamps())
        self.window = np.array([self._estimate.atVector(key) for key in keys]).reshape(-1, 4 * self._n)

    def covariances(self) -> FloatArray:
        """Newest covariances (n, 4, 4)."""
        keys = self._keys(self._frames).tolist()
        return np.array([self._smoother.marginalCovariance(key) for key in keys])

    def _keys(self, frame: int) -> Any:
        return np.uint64(frame * self._n) + np.arange(self._n, dtype=np.uint64)

    def _zeros(self, keys: Any) -> gtsam.Values:
        values = gtsam.Values()
        for key in keys.tolist():
            values.insert(key, np.zeros(4))
        return values


def dense(frame: FlockFrame) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """F, b, Q, z, H, R of a frame as the textbook wants them."""
    transition, seen = frame.transition, frame.measurements
    H = np.zeros((2 * len(seen), len(transition.b)))
    row = np.arange(2 * len(seen)).reshape(-1, 2)
    H[row[:, :, None], (4 * seen.nodes[:, None] + np.arange(4))[:, None, :]] = seen.H
    R = scipy.linalg.block_diag(*seen.R) if len(seen) else np.empty((0, 0))
    return transition.F_matrix.toarray(), transition.b, transition.Q_matrix.toarray(), seen.z.ravel(), H, R
