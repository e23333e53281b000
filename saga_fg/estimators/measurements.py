r"""Measurements of some nodes at one time, in a form that an estimator can linearise, and linearise again.

    z = h(x_node) + v,   v ~ N(0, R)        h(x) = H x for `Measurements`, any measurement model for `Observations`

Around x0, with J = dh/dx,

    z - h(x0) + J x0 = J x + v

is what a linear estimator takes in. Angles among z are wrapped.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from factors import FactorError, MeasurementModel
from saga_fg.errors import InputError
from saga_fg.estimators.partition import StateLayout
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked, checked_covariances, checked_rows


class LinearisedMeasurements(NamedTuple):
    """rows (m,) of the nodes; z (m, k); H (m, k, d); R (m, k, k)."""

    rows: IntArray
    z: FloatArray
    H: FloatArray
    R: FloatArray


@dataclass(frozen=True, eq=False)
class Measured(ABC):
    """m independent measurements of nodes whose states have equal size: nodes (m,) ids, may repeat; z (m, k)."""

    nodes: IntArray
    z: FloatArray

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    @abstractmethod
    def state_dim(self) -> int:
        """Size d of the states measured."""

    @property
    def linear(self) -> bool:
        """True where linearising it again elsewhere changes nothing."""
        return isinstance(self, Measurements)

    @abstractmethod
    def only(self, chosen: BoolArray) -> Self:
        """The measurements that are `chosen` (m,)."""

    @abstractmethod
    def linearised(self, layout: StateLayout, mean: FloatArray, rows: IntArray | None = None) -> LinearisedMeasurements:
        """Linearise around the joint state `mean` (D,) of `layout`; rows: what `rows` has returned."""

    def rows(self, layout: StateLayout) -> IntArray:
        """The rows (m,) of the nodes; `UnknownNodeError` or `InputError` unless they are in `layout` and of the right
        size."""
        rows = layout.rows(self.nodes)
        if len(rows) and (layout.dims[rows] != self.state_dim).any():
            size = layout.spans(rows).shape[1]
            raise InputError(f"H: expected {size} columns, the size of the nodes' states, got {self.state_dim}")
        return rows


@dataclass(frozen=True, eq=False)
class Measurements(Measured):
    """m independent linear measurements of nodes whose states have equal size d: z = H x_node + v, v ~ N(0, R).

    nodes (m,) ids, may repeat; z (m, k); H (m, k, d) or (k, d) for all; R (m, k, k) or (k, k) for all

    Raises `InputError` for wrong shapes, numbers that are not finite, or an R that is not symmetric positive definite.
    """

    H: FloatArray
    R: FloatArray

    def __post_init__(self) -> None:
        nodes = checked_rows("nodes", self.nodes)
        m = len(nodes)
        z = checked("z", self.z, (m, None))
        k = z.shape[1]
        H = checked("H", _one_each(self.H, m), (m, k, None))
        R = checked_covariances("R", _one_each(self.R, m), m, k)
        for name, array in (("nodes", nodes), ("z", z), ("H", H), ("R", R)):
            object.__setattr__(self, name, array)

    @classmethod
    def unchecked(cls, nodes: IntArray, z: FloatArray, H: FloatArray, R: FloatArray) -> Measurements:
        """Measurements of arrays that were checked where they came in: H (m, k, d), R (m, k, k)."""
        made = object.__new__(cls)
        vars(made).update(nodes=nodes, z=z, H=H, R=R)
        return made

    @property
    def state_dim(self) -> int:
        return int(self.H.shape[2])

    def only(self, chosen: BoolArray) -> Measurements:
        return Measurements.unchecked(self.nodes[chosen], self.z[chosen], self.H[chosen], self.R[chosen])

    def linearised(self, layout: StateLayout, mean: FloatArray, rows: IntArray | None = None) -> LinearisedMeasurements:
        return LinearisedMeasurements(layout.rows(self.nodes) if rows is None else rows, self.z, self.H, self.R)


@dataclass(frozen=True, eq=False)
class Observations(Measured):
    """m independent measurements by one measurement model, which may be nonlinear (range, bearing, range rate, ...).

    nodes (m,) ids, may repeat; z (m, k); R (m, k, k) or (k, k) for all; model: see `factors.measurement`

    Raises `InputError` for wrong shapes, numbers that are not finite, or an R that is not symmetric positive definite.
    """

    model: MeasurementModel
    R: FloatArray

    def __post_init__(self) -> None:
        empty = np.zeros((self.model.dim, self.model.state_dim))
        checked = Measurements(self.nodes, self.z, empty, self.R)  # shapes and R are checked alike
        for name in ("nodes", "z", "R"):
            object.__setattr__(self, name, getattr(checked, name))

    @property
    def state_dim(self) -> int:
        return self.model.state_dim

    def only(self, chosen: BoolArray) -> Observations:
        return replace(self, nodes=self.nodes[chosen], z=self.z[chosen], R=self.R[chosen])

    def linearised(self, layout: StateLayout, mean: FloatArray, rows: IntArray | None = None) -> LinearisedMeasurements:
        rows = layout.rows(self.nodes) if rows is None else rows
        x, model = mean[layout.spans(rows)], self.model
        try:
            residual = self.z - model.predict(x)
            H = np.array(model.jacobian(x), dtype=np.float64)
        except Exception as error:  # of a researcher's model: anything
            reason = error if isinstance(error, FactorError) else repr(error)
            raise InputError(f"{model.name}: {reason}") from error
        angles = list(model.angles)
        residual[:, angles] = (residual[:, angles] + np.pi) % (2 * np.pi) - np.pi
        if not (np.isfinite(residual).all() and np.isfinite(H).all()):
            raise InputError(f"{model.name}: the prediction or its Jacobian is not finite")
        return LinearisedMeasurements(rows, residual + (H @ x[:, :, None])[:, :, 0], H, self.R)


def _one_each(value: ArrayLike, m: int) -> ArrayLike:
    """A matrix that serves all m measurements, repeated; anything else as it is."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths, which `checked` will name
        return value
    return np.broadcast_to(array, (m, *array.shape)) if array.ndim == 2 else value
