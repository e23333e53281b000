"""SAGA-KF itself: one Kalman filter over the joint state of all nodes of the scene graph (Sani et al., ICPR 2024).

    predict   m <- F m + b              P <- F P F^T + Q                    F block-sparse, Q block-diagonal
    update    S = H P H^T + R = L L^T   W = L^-1 H P    m <- m + W^T L^-1 (z - H m)    P <- P - W^T W

Interactions correlate the nodes of a connected graph, and no others: the covariance is kept as one dense block for each
component of nodes that have become correlated, and components of equal size are worked on together. A node that is
measured so rarely, or left its neighbours so long ago, that its correlation has decayed below rounding is split off.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.base import EstimatorBase
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.bounds import ComponentBounds
from saga_fg.estimators.filter_steps import corrected, predicted
from saga_fg.estimators.kalman_providers import AuxiliaryVariables, asked
from saga_fg.estimators.layout import checked_prior
from saga_fg.estimators.measurements import Observations, RecordedMeasurements
from saga_fg.estimators.object_factors import prior_graph
from saga_fg.estimators.protocol import Measurements
from saga_fg.graph.providers import FactorProvider, predictors
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray, shallow_copy
from saga_fg.types.frame import Frame

_DECOUPLE_EVERY = 10  # predictions between looks for components that have fallen apart


@dataclass(frozen=True, eq=False)
class KalmanState:
    """The filter as a value: its Gaussian, how many predictions it has made, the time, s, and what `asked` keeps.

    Without providers it keeps nothing, and the value is made of numbers alone.
    """

    x: BlockGaussian
    predictions: int
    time: float
    auxiliary: AuxiliaryVariables | None


class JointKalmanFilter(EstimatorBase):
    """The exact filter on the joint state. See `saga_fg.estimators.protocol.Estimator` for the methods.

    providers  asked by `ask_providers`, once a frame, for factors on the newest variables: an extended Kalman filter
    tolerance  correlation up to which nodes are taken for independent, and neighbours for independent inputs; 0: none
    max_component  largest number of nodes whose correlations are kept together, the strongest; None: any number

    Without bounds, as by default, the filter is exact.
    """

    def __init__(
        self, providers: Sequence[FactorProvider] = (), tolerance: float = 0.0, max_component: int | None = None
    ) -> None:
        if not 0 <= tolerance < 1:
            raise InputError(f"tolerance: expected a number from 0 to below 1, got {tolerance!r}")
        if max_component is not None and max_component < 1:
            raise InputError(f"max_component: expected a number of nodes >= 1, got {max_component!r}")
        self.providers = tuple(providers)
        self.bounds = ComponentBounds(tolerance, max_component or sys.maxsize) if tolerance or max_component else None
        self._state = BlockGaussian.empty()
        self._predictions = 0
        self._time = 0.0
        self._auxiliary = AuxiliaryVariables()
        self._frame: Frame | None = None
        self._origin = np.zeros(2)

    def __copy__(self) -> JointKalmanFilter:
        return shallow_copy(self)

    @property
    def nodes(self) -> IntArray:
        nodes, others = self._state.layout.nodes, self.others
        return np.delete(nodes, others) if len(others) else nodes

    @property
    def time(self) -> float:
        return self._time

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        self._add(nodes, *checked_prior(nodes, means, covariances), labels)

    def add_unchecked(
        self, nodes: IntArray, means: FloatArray, covariances: FloatArray, labels: Mapping[int, str] | None = None
    ) -> None:
        self._add(nodes, means, covariances, labels)

    def _add(
        self, nodes: ArrayLike, mean: FloatArray, covariance: FloatArray, labels: Mapping[int, str] | None
    ) -> None:
        self._state = self._state.extended(self._state.layout.extended(nodes, mean.shape[1]), mean, covariance)
        if self.providers:
            self._auxiliary = replace(self._auxiliary, labels={**self._auxiliary.labels, **(labels or {})})

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        """Set the frame that providers see, and the origin (2,) of the states' positions in the world, m."""
        self._frame, self._origin = frame, origin

    def ask_providers(self) -> None:
        """Take in the providers' factors. Raises `GraphError` for one that is not on the newest variables alone."""
        x, auxiliary = self._state, self._auxiliary
        for providers, last in ((predictors(self.providers), False), (self.providers, True)):
            if providers:
                x, auxiliary = asked(x, auxiliary, providers, self._time, self._origin, self._frame, last)
        self._state, self._auxiliary = x, auxiliary

    @property
    def others(self) -> IntArray:
        """Rows of the variables beside the nodes, in the joint state: poses, landmarks."""
        return self._auxiliary.rows(self._state.layout)

    @property
    def auxiliary(self) -> SceneFactorGraph:
        """The auxiliary variables with their values, without factors."""
        return self._auxiliary.graph

    def predict(self, transition: Transition) -> None:
        dynamics = self._auxiliary.dynamics(transition, self._state)
        look = self._predictions % _DECOUPLE_EVERY == _DECOUPLE_EVERY - 1
        self._state = predicted(self._state, dynamics, self.bounds, look)
        self._predictions += 1
        self._time += transition.dt

    def update(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None = None,
    ) -> float:
        """Take in measurements of the present; `time` can only be None, as nothing of the past is kept."""
        if time is not None:
            raise InputError("time: the filter has no past; expected measurements moved to the present")
        x, total = self._state, 0.0
        for each in measurements if isinstance(measurements, Sequence) else (measurements,):
            recorded = RecordedMeasurements(each)
            if len(rows := recorded.check(x.layout)):
                x, log_likelihood = corrected(x, recorded.linearised(x.layout, x.mean, rows))
                total += log_likelihood
        self._state = x
        return total

    def marginalise(self, nodes: ArrayLike) -> None:
        self._state = self._state.without(self._state.layout.rows(nodes))
        if self.providers:
            leaving = set(np.asarray(nodes).tolist())
            labels = {node: label for node, label in self._auxiliary.labels.items() if node not in leaving}
            self._auxiliary = replace(self._auxiliary, labels=labels)

    def posterior(self) -> BlockGaussian:
        """The joint Gaussian."""
        return self._state

    def graph(self) -> SceneFactorGraph:
        """One joint prior a component: the filter keeps nothing of the past but this. With providers by name."""
        return (
            self._auxiliary.priors(self._state, self._time) if self.providers else prior_graph(self._state, self._time)
        )

    def snapshot(self) -> KalmanState:
        """The whole state, as a value."""
        return KalmanState(self._state, self._predictions, self._time, self._auxiliary if self.providers else None)

    def restore(self, state: KalmanState) -> None:
        """Continue from a snapshot, bit-identically."""
        require_type("state", state, KalmanState)
        self._state, self._predictions, self._time = state.x, state.predictions, state.time
        self._auxiliary = state.auxiliary or AuxiliaryVariables()
