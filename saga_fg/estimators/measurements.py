r"""Measurements of some nodes at one time, in a form that an estimator can linearise, and linearise again.

    z = h(x_node) + v,   v ~ N(0, R)        h(x) = H x for `Measurements`, any measurement model for `Observations`

Around x0, with J = dh/dx and the weight w of the robust loss at the residual's distance || z - h(x0) ||_R,

    sqrt(w) ( z - h(x0) + J x0 ) = sqrt(w) J x + v

is what a linear estimator takes in (iteratively reweighted least squares). Angles among z are wrapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg

from factors import FactorError, MeasurementModel, Robust
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.graduated import GraduatedNonConvexity
from saga_fg.estimators.partition import StateLayout
from saga_fg.estimators.protocol import Measurements
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

_LOG_2_PI = float(np.log(2 * np.pi))


@dataclass(frozen=True, eq=False)
class Observations:
    """m independent measurements by one measurement model, which may be nonlinear (range, bearing, range rate, ...).

    nodes (m,) ids, may repeat; z (m, k); R (m, k, k) or (k, k) for all; model: see `factors.measurement`

    Raises `InputError` for wrong shapes, numbers that are not finite, or an R that is not symmetric positive definite.
    """

    nodes: IntArray
    z: FloatArray
    model: MeasurementModel
    R: FloatArray

    def __post_init__(self) -> None:
        empty = np.zeros((self.model.dim, self.model.state_dim))
        checked = Measurements(self.nodes, self.z, empty, self.R)  # shapes and R are checked alike
        for name in ("nodes", "z", "R"):
            object.__setattr__(self, name, getattr(checked, name))

    def __len__(self) -> int:
        return len(self.nodes)


class LinearisedMeasurements(NamedTuple):
    """rows (m,) of the nodes; z (m, k); H (m, k, d); R (m, k, k)."""

    rows: IntArray
    z: FloatArray
    H: FloatArray
    R: FloatArray


class WhitenedMeasurements(NamedTuple):
    """Measurements in units of their noise, R = 1: rows (m,) of the nodes; z (m, k); H (m, k, d)."""

    rows: IntArray
    z: FloatArray
    H: FloatArray


def whitened(linear: LinearisedMeasurements) -> WhitenedMeasurements:
    """W z and W H, W R W^T = 1."""
    L = np.linalg.cholesky(linear.R)
    white = np.linalg.solve(L, np.concatenate([linear.H, linear.z[:, :, None]], axis=2))
    return WhitenedMeasurements(linear.rows, white[:, :, -1], white[:, :, :-1])


@dataclass(frozen=True, eq=False)
class RecordedMeasurements:
    """Measurements as an estimator records them.

    robust: a loss whose weights follow the residuals, or one whose `weights` (m,) a batch smoother sets.
    """

    measured: Measurements | Observations
    robust: Robust | GraduatedNonConvexity | None = None
    weights: FloatArray | None = None

    def __post_init__(self) -> None:
        require_type("measurements", self.measured, Measurements, Observations)
        if self.robust is not None:
            require_type("robust", self.robust, Robust, GraduatedNonConvexity)

    @property
    def loss(self) -> Robust | None:
        """The loss whose weights follow the residuals."""
        return self.robust if isinstance(self.robust, Robust) else None

    @property
    def linear(self) -> bool:
        """True where linearising it again elsewhere changes nothing."""
        return isinstance(self.measured, Measurements) and self.loss is None

    @property
    def state_dim(self) -> int:
        """Size d of the states measured."""
        measured = self.measured
        return int(measured.H.shape[2]) if isinstance(measured, Measurements) else measured.model.state_dim

    def only(self, chosen: BoolArray) -> RecordedMeasurements:
        """The measurements that are `chosen` (m,)."""
        if chosen.all():
            return self
        measured, weights = self.measured, None if self.weights is None else self.weights[chosen]
        nodes, z, R = measured.nodes[chosen], measured.z[chosen], measured.R[chosen]
        if isinstance(measured, Measurements):
            return replace(self, measured=Measurements.unchecked(nodes, z, measured.H[chosen], R), weights=weights)
        return replace(self, measured=replace(measured, nodes=nodes, z=z, R=R), weights=weights)

    def check(self, layout: StateLayout) -> IntArray:
        """The rows (m,) of the nodes; `UnknownNodeError` or `InputError` unless they are in `layout` and of the right
        size."""
        rows = layout.rows(self.measured.nodes)
        if len(rows) and (layout.dims[rows] != self.state_dim).any():
            size = layout.spans(rows).shape[1]
            raise InputError(f"H: expected {size} columns, the size of the nodes' states, got {self.state_dim}")
        return rows

    def linearised(self, layout: StateLayout, mean: FloatArray, rows: IntArray | None = None) -> LinearisedMeasurements:
        """Linearise around the joint state `mean` (D,) of `layout`; rows: those that `check` has returned."""
        measured = self.measured
        rows = layout.rows(measured.nodes) if rows is None else rows
        if self.linear and self.weights is None:
            assert isinstance(measured, Measurements)
            return LinearisedMeasurements(rows, measured.z, measured.H, measured.R)
        x = mean[layout.spans(rows)]
        residual, H = self._residual(x)
        z = measured.z if isinstance(measured, Measurements) else residual + (H @ x[:, :, None])[:, :, 0]
        root = np.sqrt(self.weights_at(layout, mean))
        return LinearisedMeasurements(rows, root[:, None] * z, root[:, None, None] * H, measured.R)

    def distances(self, layout: StateLayout, mean: FloatArray) -> FloatArray:
        """(m,) distances || z - h(x) ||_R of the residuals at the joint state `mean`, in standard deviations."""
        residual, _ = self._residual(mean[layout.spans(layout.rows(self.measured.nodes))])
        return _distances(residual, self.measured.R)

    def weights_at(self, layout: StateLayout, mean: FloatArray) -> FloatArray:
        """(m,) the weight of each measurement at the joint state `mean`."""
        if self.weights is not None:
            return self.weights
        return np.ones(len(self.measured)) if self.loss is None else self.loss.weight(self.distances(layout, mean))

    def with_weights(self, weights: FloatArray) -> RecordedMeasurements:
        """Fix the weights."""
        return replace(self, weights=weights)

    def _residual(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """z - h(x) (m, k) and dh/dx (m, k, d) at states x (m, d)."""
        measured = self.measured
        if isinstance(measured, Measurements):
            return measured.z - (measured.H @ x[:, :, None])[:, :, 0], measured.H
        model = measured.model
        try:
            residual = measured.z - model.predict(x)
            H = np.array(model.jacobian(x), dtype=np.float64)
        except Exception as error:  # of a researcher's model: anything
            reason = error if isinstance(error, FactorError) else repr(error)
            raise InputError(f"{model.name}: {reason}") from error
        angles = list(model.angles)
        residual[:, angles] = (residual[:, angles] + np.pi) % (2 * np.pi) - np.pi
        if not (np.isfinite(residual).all() and np.isfinite(H).all()):
            raise InputError(f"{model.name}: the prediction or its Jacobian is not finite")
        return residual, H


def log_likelihood(before: BlockGaussian, after: BlockGaussian, kinds: Sequence[RecordedMeasurements]) -> float:
    """The log-likelihood of measurements of the nodes of a Gaussian, from what was known before them and after.

        2 log p(z) = -k log 2 pi - log |R| - log |P| + log |P'| - || z - H m' ||_R^2 - || m' - m ||_P^2

    for linear measurements; at a minimum of nonlinear ones, Laplace's approximation.
    """
    total, layout = 0.0, before.layout
    measured = np.zeros(len(layout), dtype=bool)
    for recorded in kinds:
        distance, R = recorded.distances(layout, after.mean), recorded.measured.R
        total -= float(distance @ distance + np.linalg.slogdet(R)[1].sum()) + R.shape[0] * R.shape[1] * _LOG_2_PI
        measured[layout.rows(recorded.measured.nodes)] = True
    both = before.partition.joined(*_neighbours(after.partition.label))
    for label in np.unique(both.label[measured]).tolist():
        rows = np.flatnonzero(both.label == label)
        at = layout.places(rows)
        L, moved = np.linalg.cholesky(before.joint(rows)), after.mean[at] - before.mean[at]
        half = scipy.linalg.solve_triangular(L, moved, lower=True)
        total += float(np.linalg.slogdet(after.joint(rows))[1] - 2 * np.log(np.diag(L)).sum() - half @ half)
    return total / 2


def _neighbours(label: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs of nodes that tie together all of those with equal label."""
    order = np.argsort(label, kind="stable")
    same = np.flatnonzero(label[order][1:] == label[order][:-1])
    return order[same], order[same + 1]


def _distances(residual: FloatArray, R: FloatArray) -> FloatArray:
    whitened = np.linalg.solve(np.linalg.cholesky(R), residual[:, :, None])[:, :, 0]
    return np.asarray(np.linalg.norm(whitened, axis=1))
