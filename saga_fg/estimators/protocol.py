"""The role of an estimator: hold the joint state of all nodes, move it by a transition, correct it by measurements.

    predict   x <- F x + b + q,  q ~ N(0, Q)          the graph's dynamics over an interval
    update    z = H x_node + v,  v ~ N(0, R)           measurements of some nodes

Every estimator agrees with `saga_fg.estimators.reference` (see docs/model.md for the figures).

A tracker needs nothing of its estimator but this protocol. An estimator of your own derives from
`saga_fg.estimators.EstimatorBase`, which has all but `time`, `add`, `predict`, `update`, `marginalise`, `posterior`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.graph.providers import FactorProvider
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.discretisation import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked, checked_covariances, checked_rows
from saga_fg.types.frame import Frame


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
    """The joint state of all nodes. Every method raises `InputError` or `UnknownNodeError` and then changes nothing.

    `copy.copy` returns an estimator that changes independently of this one. Beside the nodes there may be others, such
    as the vehicle's poses and landmarks, which factor providers add.
    """

    lag: float
    """Age up to which `update` puts measurements at their own time, s; 0: it takes those of the present alone."""
    providers: Sequence[FactorProvider]
    """Asked for factors once a frame by `ask_providers`; empty for none."""

    # the Gaussian, moved and corrected

    @property
    def time(self) -> float:
        """Sum of all intervals since the start, s."""
        ...

    @property
    def nodes(self) -> IntArray:
        """(n,) ids in the order of the joint state."""
        ...

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        """Add nodes independent of all others: ids (k,), means (k, d), covariances (k, d, d); classes by id."""
        ...

    def add_unchecked(
        self, nodes: IntArray, means: FloatArray, covariances: FloatArray, labels: Mapping[int, str] | None = None
    ) -> None:
        """Add nodes as `add` does, whose numbers were checked where they came in."""
        ...

    def predict(self, transition: Transition) -> None:
        """Move all nodes by a transition over exactly the present nodes, in any order."""
        ...

    def update(self, measurements: Measurements | Sequence[Measurements], time: float | None = None) -> float:
        """Take in measurements, several kinds at once if need be; return the log-likelihood of their innovation.

        time: when they were made, s, on this clock, which `remembered` is true of; None: now. NaN is returned where
        nothing is computed before it is asked for.
        """
        ...

    def marginalise(self, nodes: ArrayLike) -> None:
        """Integrate out nodes that disappear, so that their information on their neighbours stays."""
        ...

    def remembered(self, nodes: ArrayLike, time: float) -> BoolArray:
        """(k,) whether measurements of nodes at `time`, s, can still be put there; asked where `lag` is above 0."""
        ...

    # what is read

    def posterior(self) -> BlockGaussian:
        """The joint Gaussian: of the nodes, and perhaps of others."""
        ...

    @property
    def unsettled(self) -> IntArray:
        """Nodes whose nonlinear solution has not settled; the answer of closed forms always has."""
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

    def planar_marginals(self, nodes: ArrayLike, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (k, 4) with their covariances (k, 4, 4), by a kernel.

        places (k, 4): where x, y, vx, vy are in the states, -1 for none, which gives zeros
        """
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

    def handed_over(self) -> Self:
        """A copy that takes over what would be long to build again; this one is rarely needed after it."""
        ...

    # factors of providers, for those that have any

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        """Set the frame that providers see, and the origin (2,) of the states' positions in the world, m."""
        ...

    def ask_providers(self) -> None:
        """Take in the factors of all providers, once a frame."""
        ...

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Take in the factors of some providers at once, at the present epoch."""
        ...

    @property
    def others(self) -> Sequence[int] | IntArray:
        """The variables beside the nodes, by numbers of the estimator's own."""
        ...

    @property
    def auxiliary(self) -> SceneFactorGraph:
        """A graph that has the variables beside the nodes with their values, with or without factors."""
        ...

    def covariance_with(self, keys: Sequence[int], nodes: ArrayLike) -> FloatArray:
        """Joint covariance of variables of `auxiliary`, by key, and of some nodes, in the order given."""
        ...
