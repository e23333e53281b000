"""The role of an estimator: hold the joint state of all nodes, move it by a transition, correct it by measurements.

    predict   x <- F x + b + q,  q ~ N(0, Q)          the graph's dynamics over an interval
    update    z = H x_node + v,  v ~ N(0, R)           measurements of some nodes

Every estimator agrees with `saga_fg.estimators.reference` (see docs/model.md for the figures).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.layout import StateLayout
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.kernels.components import planar_marginals
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray, checked, checked_covariances, checked_rows


@dataclass(frozen=True, eq=False)
class Measurements:
    """m independent linear measurements of nodes whose states have equal size d: z = H x_node + v, v ~ N(0, R).

    nodes (m,) ids, may repeat; z (m, k); H (m, k, d) or (k, d) for all; R (m, k, k) or (k, k) for all

    Raises `InputError` for wrong shapes, numbers that are not finite, or an R that is not symmetric positive definite.
    """

    nodes: IntArray
    z: FloatArray
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

    def __len__(self) -> int:
        return len(self.nodes)


def _one_each(value: ArrayLike, m: int) -> ArrayLike:
    """A matrix that serves all m measurements, repeated; anything else as it is."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths, which `checked` will name
        return value
    return np.broadcast_to(array, (m, *array.shape)) if array.ndim == 2 else value


class Estimator(Protocol):
    """The joint state of all nodes. Every method raises `InputError` or `UnknownNodeError` and then changes nothing."""

    @property
    def nodes(self) -> IntArray:
        """(n,) ids in the order of the joint state."""
        ...

    @property
    def time(self) -> float:
        """Sum of all intervals since the start, s."""
        ...

    def add(self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        """Nodes that appear, independent of all others: ids (k,), means (k, d), covariances (k, d, d)."""
        ...

    def predict(self, transition: Transition) -> None:
        """Move all nodes by a transition over exactly the present nodes, in any order."""
        ...

    def update(self, measurements: Measurements | Sequence[Measurements]) -> float:
        """Take in measurements, several kinds at once if need be; returns the log-likelihood of their innovation."""
        ...

    def marginalise(self, nodes: ArrayLike) -> None:
        """Nodes that disappear: integrated out, so that their information on their neighbours stays."""
        ...

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, d) means of nodes of equal size d."""
        ...

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, d, d) marginal covariances of nodes of equal size d."""
        ...

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        """Stacked mean of some nodes, in the order given, of any sizes."""
        ...

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        """Joint covariance of some nodes, in the order given, of any sizes."""
        ...

    def graph(self) -> SceneFactorGraph:
        """The equivalent factor graph, its values the solution; `solve()` and GTSAM's own solvers come to the same.

        `graph.of(OBJECT, graph.epoch)` are the present nodes. Raises `InputError` that names a node on which edges act
        without process noise in all directions of its state: its interaction is no factor.
        """
        ...

    def snapshot(self) -> Any:
        """The whole state as a value, which can be pickled."""
        ...

    def restore(self, state: Any) -> None:
        """Continue from a snapshot of an estimator of the same kind; raises `InputError` for anything else."""
        ...


class LatestMarginals:
    """Marginals of the nodes that are there now. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    def handed_over(self) -> Self:
        """A copy that goes on in the place of this one."""
        return copy.copy(self)

    def mean(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        mean: FloatArray = x.mean[x.layout.spans(rows)]
        return mean

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        x.layout.spans(rows)  # states of equal size, or an error that says so
        return x.covariances(rows)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        mean: FloatArray = x.mean[x.layout.places(rows)]
        return mean

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        return x.joint(rows)

    def planar_marginals(self, nodes: ArrayLike, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (k, 4) with their covariances (k, 4, 4), by a kernel.

        places (k, 4): where x, y, vx, vy are in the states, -1 for none, which gives zeros
        """
        x, rows = self._at(nodes)
        at = x.partition.block_places
        return planar_marginals(x.mean, x.flat, x.layout.offsets, at.start, at.size, at.offset, rows, places)

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        """A Gaussian, and which of its rows are these nodes."""
        raise NotImplementedError


def live_rows(x: BlockGaussian, live: StateLayout, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
    """A Gaussian that may have nodes that have left since, and which of its rows are `nodes`."""
    rows = live.rows(nodes)
    return x, rows if len(live) == len(x.layout) else x.layout.rows(live.nodes[rows])
