r"""Prediction and correction of a joint state by components, by the kernels of `saga_fg.kernels.filtering`.

Measurements of some nodes at one time have a form that an estimator can linearise, and linearise again:

    z = h(x_node) + v,   v ~ N(0, R)        h(x) = H x for `Measurements`, any measurement model for `Observations`

Around x0, with J = dh/dx,

    z - h(x0) + J x0 = J x + v

is what a linear estimator takes in. Angles among z are wrapped.

Predictions and corrections:

    predict   m <- F m + b              P <- F P F^T + Q                    F block-sparse, Q block-diagonal
    correct   S = H P H^T + R = L L^T   W = L^-1 H P    m <- m + W^T L^-1 (z - H m)    P <- P - W^T W

A component grows by the interactions that enter it. Components are worked on one after the other, and so are
measurements. Where a measurement is so much better than what was known (a millionfold in variance) that P - W^T W
cancels, one refinement with K = W^T L^-1 restores what must hold, H P = R K^T, so that the measured rows are as exact
as in Joseph's form.

Components have bounds, for speed: a prediction leaves out some correlations.

    x_i' = sum_{j with i} F_ij x_j + sum_{j not with i} F_ij x_j + b_i + q_i        i and j are "with" in one component

A node j of another component is an independent input: F_ij m_j is taken over exactly, F_ij P_jj F_ij^T is further noise
of x_i', and the correlation of the two is left out. Covariances are blocks of exact ones, and stay positive definite.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from factors import FactorError, MeasurementModel
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.partition import BlockGaussian, Partition, StateLayout, unflattened
from saga_fg.kernels.filtering import corrected_state, predicted_state, tie_strengths
from saga_fg.model import Blocks, Transition
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


CANCELLATION = 1e-6  # ratio of variances after and before below which a correction is refined


class FlatBlocks(NamedTuple):
    """m blocks of any sizes: target, source (m,), where each begins (m,), and all values one after the other."""

    target: IntArray
    source: IntArray
    begin: IntArray
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Dynamics:
    """x <- F x + b + q, q ~ N(0, Q) over the nodes of `layout` in its order; see
    `saga_fg.model.discretisation.Transition`."""

    layout: StateLayout
    F: tuple[Blocks, ...]
    b: FloatArray
    Q: tuple[Blocks, ...]

    @staticmethod
    def of(transition: Transition, layout: StateLayout) -> Dynamics:
        """Dynamics of a transition over exactly the nodes of `layout`; raises `InputError` for any other."""
        require_type("transition", transition, Transition)
        rows = layout.rows(transition.nodes)
        if len(rows) != len(layout):
            raise InputError(f"transition: expected {len(layout)} nodes, got {len(rows)}")
        if (layout.dims[rows] != transition.graph.dims).any():
            raise InputError("transition: the sizes of its states differ from those of the estimator")
        if (rows == np.arange(len(rows))).all():
            return Dynamics(layout, transition.F, transition.b, transition.Q)
        b = np.empty(layout.size)
        b[layout.places(rows)] = transition.b
        return Dynamics(layout, _renamed(transition.F, rows), b, _renamed(transition.Q, rows))

    def with_static(self, layout: StateLayout, others: IntArray) -> Dynamics:
        """Extend to `layout`, which has further nodes at the rows `others`: these stay as they are."""
        rows, b = np.delete(np.arange(len(layout)), others), np.zeros(layout.size)
        b[layout.places(rows)] = self.b
        return Dynamics(layout, (*_renamed(self.F, rows), *identity(layout, others)), b, _renamed(self.Q, rows))

    def of_nodes(self, layout: StateLayout, alone: bool = False) -> Dynamics:
        """Restrict to the nodes of `layout`, in its order, on which no others act; alone: not even each other."""
        if not alone and np.array_equal(layout.nodes, self.layout.nodes):
            return self
        rows = self.layout.rows(layout.nodes)
        place = np.full(len(self.layout), -1)
        place[rows] = np.arange(len(rows))
        b = self.b[self.layout.places(rows)]
        return Dynamics(layout, _within(self.F, place, alone), b, _within(self.Q, place, alone))

    def times(self, x: FloatArray) -> FloatArray:
        """F x of a joint state (D,)."""
        starts, result = self.layout.offsets[:-1], np.zeros(self.layout.size)
        for F in self.F:
            _, d_i, d_j = F.values.shape
            products = F.values @ x[starts[F.source][:, None] + np.arange(d_j)][:, :, None]
            at = starts[F.target][:, None] + np.arange(d_i)
            result += np.bincount(at.ravel(), weights=products.ravel(), minlength=len(result))
        return result

    @cached_property
    def flat(self) -> FlatBlocks:
        """The blocks of F, as kernels take them."""
        return _flat(self.F)

    @property
    def unchanged(self) -> BoolArray:
        """(n,) true for nodes that stay exactly as they are, x' = x without noise, whatever the others do."""
        n = len(self.layout)
        same, driven = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        for F in self.F:
            own = F.target == F.source
            same[F.target[own & (F.values == np.eye(*F.values.shape[1:])).all(axis=(1, 2))]] = True
            driven[F.target[~own & F.values.any(axis=(1, 2))]] = True
        for Q in self.Q:
            driven[Q.target[Q.values.any(axis=(1, 2))]] = True
        driven[np.repeat(np.arange(n), self.layout.dims)[self.b != 0]] = True
        return same & ~driven

    def joined(self, partition: Partition) -> Partition:
        """The components that a prediction leaves of those of `partition`."""
        return partition.joined(self.flat.target, self.flat.source)

    def within(self, partition: Partition) -> Dynamics:
        """Leave out the blocks of F between components."""
        label, F = partition.label, []
        for one in self.F:
            mine = label[one.target] == label[one.source]
            F.append(Blocks(one.target[mine], one.source[mine], one.values[mine]))
        return replace(self, F=tuple(F))

    def separated(self, x: BlockGaussian) -> BlockGaussian:
        """Separate the uncorrelated parts of components that no interaction of this interval ties."""
        tied = self.joined(Partition.apart(x.layout))
        return x if tied.count == self.joined(x.partition).count else x.decoupled()


@dataclass(frozen=True)
class ComponentBounds:
    """Nodes that become, or remain, one component.

    tolerance  correlation up to which nodes count as independent
    most       largest number of nodes of a component; the strongest ties come first
    """

    tolerance: float
    most: int

    def components(self, x: BlockGaussian, dynamics: Dynamics) -> Partition:
        """The components that a prediction leaves; blocks of F between them are inputs."""
        parts, at, F = x.uncorrelated(self.tolerance), x.partition.block_places, dynamics.flat
        strength = tie_strengths(
            flat=x.flat,
            start=at.start,
            size=at.size,
            offset=at.offset,
            dims=x.layout.dims,
            part=parts.label,
            target=F.target,
            source=F.source,
            at_F=F.begin,
            F=F.values,
        )
        strong = (strength > self.tolerance).nonzero()[0]
        strong = strong[np.argsort(-strength[strong], kind="stable")]
        return parts.joined_up_to(parts.label[F.target[strong]], parts.label[F.source[strong]], self.most)


def predict(x: BlockGaussian, dynamics: Dynamics, partition: Partition | None = None) -> BlockGaussian:
    """The prior after the interval. Raises `InputError` where it is not finite.

    partition: the components it has; nodes that it separates lose their correlation, and blocks of F between them are
    inputs. None: those joined by F
    """
    partition = dynamics.joined(x.partition) if partition is None else partition
    x = x.over(partition.packed)  # which keeps what little correlation there is among the nodes of a pack
    at, F, Q = x.partition.block_places, dynamics.flat, _flat(dynamics.Q)
    finite, mean, flat = predicted_state(
        mean=x.mean,
        flat=x.flat,
        label=x.partition.label,
        start=at.start,
        size=at.size,
        offset=at.offset,
        dims=x.layout.dims,
        offsets=x.layout.offsets,
        part=partition.label,
        target=F.target,
        source=F.source,
        at_F=F.begin,
        F=F.values,
        b=dynamics.b,
        noisy=Q.target,
        at_Q=Q.begin,
        Q=Q.values,
    )
    if not finite:
        raise InputError("transition: the prediction is not finite, the dynamics grow beyond all numbers")
    return BlockGaussian(x.partition, mean, unflattened(flat, x.partition))


def corrected(x: BlockGaussian, seen: LinearisedMeasurements) -> tuple[BlockGaussian, float]:
    """The posterior and the log-likelihood of the innovation.

    Raises `InputError` where a covariance has grown so large that R no longer counts among its digits.
    """
    at = x.partition.block_places
    definite, mean, flat, log_likelihood = corrected_state(
        mean=x.mean,
        flat=x.flat,
        start=at.start,
        size=at.size,
        offset=at.offset,
        offsets=x.layout.offsets,
        first=at.first,
        places=at.places,
        rows=seen.rows,
        z=seen.z,
        H=seen.H,
        R=seen.R,
        cancellation=CANCELLATION,
    )
    if not definite:
        raise lost_in_rounding(x.variances().max())
    return BlockGaussian(x.partition, mean, unflattened(flat, x.partition)), log_likelihood


def lost_in_rounding(variance: float) -> InputError:
    """The error of a correction whose R no longer counts among the digits of a `variance`."""
    return InputError(
        f"measurements: their noise is lost in the rounding of what is predicted, variances up to {variance:.3g}"
    )


def identity(layout: StateLayout, rows: IntArray) -> tuple[Blocks, ...]:
    """Blocks of the nodes at `rows` that stay as they are."""
    alike = [rows[layout.dims[rows] == d] for d in np.unique(layout.dims[rows])]
    return tuple(Blocks(k, k, np.tile(np.eye(layout.dims[k[0]]), (len(k), 1, 1))) for k in alike)


def noise_ratio(P: FloatArray, Q: FloatArray) -> FloatArray:
    """(m,) size of covariances P (m, d, d) in units of noise Q (m, d, d), the trace of Q^-1 P; infinite without any."""
    try:
        L = np.linalg.cholesky(Q)
    except np.linalg.LinAlgError:
        if len(Q) == 1:
            return np.array([np.inf])
        half = len(Q) // 2
        return np.concatenate([noise_ratio(P[:half], Q[:half]), noise_ratio(P[half:], Q[half:])])
    half_done = np.linalg.solve(L, P)
    return np.asarray(np.trace(np.linalg.solve(L, np.swapaxes(half_done, 1, 2)), axis1=1, axis2=2))


def _renamed(groups: tuple[Blocks, ...], rows: IntArray) -> tuple[Blocks, ...]:
    return tuple(Blocks(rows[blocks.target], rows[blocks.source], blocks.values) for blocks in groups)


def _within(groups: tuple[Blocks, ...], place: IntArray, alone: bool) -> tuple[Blocks, ...]:
    """The blocks between nodes that have a place >= 0, at their places; alone: of nodes with themselves."""
    found = []
    for one in groups:
        target, source = place[one.target], place[one.source]
        mine = (target >= 0) & (target == source if alone else source >= 0)
        if mine.any():
            found.append(Blocks(target[mine], source[mine], one.values[mine]))
    return tuple(found)


def _flat(groups: Sequence[Blocks]) -> FlatBlocks:
    none = np.empty(0, dtype=np.int64)
    target, source, begin, size = [none], [none], [none], 0
    for group in groups:
        target.append(group.target)
        source.append(group.source)
        begin.append(size + group.values[:1].size * np.arange(len(group.target)))
        size += group.values.size
    values = np.concatenate([np.empty(0), *(group.values.ravel() for group in groups)])
    return FlatBlocks(np.concatenate(target), np.concatenate(source), np.concatenate(begin), values)
