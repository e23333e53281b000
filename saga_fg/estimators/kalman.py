"""SAGA-KF itself: one Kalman filter over the joint state of all nodes of the scene graph (Sani et al., ICPR 2024).

    predict   m <- F m + b              P <- F P F^T + Q                    F block-sparse, Q block-diagonal
    update    S = H P H^T + R = L L^T   W = L^-1 H P    m <- m + W^T L^-1 (z - H m)    P <- P - W^T W

Interactions correlate the nodes of a connected graph, and no others: the covariance is kept as one dense block for each
component of nodes that have become correlated, and components of equal size are worked on together. A node that is
measured so rarely, or left its neighbours so long ago, that its correlation has decayed below rounding is split off.
"""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from saga_fg.arrays import FloatArray, IntArray
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.correction import correct
from saga_fg.estimators.dynamics import Dynamics, predict
from saga_fg.estimators.factor_graph import prior_graph
from saga_fg.estimators.layout import checked_prior
from saga_fg.estimators.protocol import Measurements, require_kind
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.transition import Transition

_DECOUPLE_EVERY = 10  # predictions between looks for components that have fallen apart


@dataclass(frozen=True, eq=False)
class KalmanState:
    """The filter as a value: its Gaussian, how many predictions it has made, and the time, s."""

    x: BlockGaussian
    predictions: int
    time: float


class JointKalmanFilter:
    """The exact filter on the joint state. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    def __init__(self) -> None:
        self._state = BlockGaussian.empty()
        self._predictions = 0
        self._time = 0.0

    @property
    def nodes(self) -> IntArray:
        return self._state.layout.nodes

    @property
    def time(self) -> float:
        return self._time

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        self._state = self._state.extended(self._state.layout.extended(nodes, mean.shape[1]), mean, covariance)

    def predict(self, transition: Transition) -> None:
        dynamics = Dynamics.of(transition, self._state.layout)
        look = self._predictions % _DECOUPLE_EVERY == _DECOUPLE_EVERY - 1
        self._state = predict(dynamics.separated(self._state) if look else self._state, dynamics)
        self._predictions += 1
        self._time += transition.dt

    def update(self, measurements: Measurements) -> float:
        require_kind("measurements", measurements, Measurements)
        if len(measurements) == 0:
            return 0.0
        rows = self._state.layout.rows(measurements.nodes)
        size, d = self._state.layout.spans(rows).shape[1], measurements.H.shape[2]
        if size != d:
            raise InputError(f"H: expected {size} columns, the size of the nodes' states, got {d}")
        m = measurements
        self._state, _, log_likelihood = correct(self._state, rows, m.z, m.H, m.R)
        return log_likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        self._state = self._state.without(self._state.layout.rows(nodes))

    def mean(self, nodes: ArrayLike) -> FloatArray:
        layout = self._state.layout
        mean: FloatArray = self._state.mean[layout.spans(layout.rows(nodes))]
        return mean

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        layout = self._state.layout
        rows = layout.rows(nodes)
        layout.spans(rows)  # states of equal size, or an error that says so
        return self._state.covariances(rows)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        layout = self._state.layout
        mean: FloatArray = self._state.mean[layout.places(layout.rows(nodes))]
        return mean

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        return self._state.joint(self._state.layout.rows(nodes))

    def posterior(self) -> BlockGaussian:
        """All that the filter knows."""
        return self._state

    def graph(self) -> SceneFactorGraph:
        """One joint prior a component: the filter keeps nothing of the past but this."""
        return prior_graph(self._state, self._time)

    def snapshot(self) -> KalmanState:
        """The whole state, as a value."""
        return KalmanState(self._state, self._predictions, self._time)

    def restore(self, state: KalmanState) -> None:
        """Continue from a snapshot, bit-identically."""
        require_kind("state", state, KalmanState)
        self._state, self._predictions, self._time = state.x, state.predictions, state.time
