"""The role of an estimator: hold the joint state of all nodes, move it by a transition, correct it by measurements.

    predict   x <- F x + b + q,  q ~ N(0, Q)          the graph's dynamics over an interval
    update    z = H x_node + v,  v ~ N(0, R)           measurements of some nodes

Every estimator agrees with `saga_fg.estimators.reference` (see docs/model.md for the figures).

A tracker needs nothing of its estimator but this class. An estimator of your own derives from it and has

    time         an attribute of the class, or a property, s; `predict` adds `transition.dt` to it
    add          nodes that appear
    predict      x <- F x + b + q, q ~ N(0, Q), with `transition.F_matrix`, `transition.b` and `transition.Q_matrix`
    update       measurements, which may be a sequence of several kinds
    marginalise  nodes that disappear
    posterior    the joint Gaussian; from matrices, `BlockGaussian.from_dense` makes one

What is read of it comes from `posterior`; copies and snapshots copy all attributes but `providers`, so that these
methods may change arrays in place.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.filtering import Measurements, Observations
from saga_fg.estimators.object_factors import prior_graph
from saga_fg.estimators.partition import BlockGaussian
from saga_fg.graph import FactorProvider, SceneFactorGraph
from saga_fg.kernels.components import planar_marginals
from saga_fg.model import Transition
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.parts import part_name
from saga_fg.types import Frame


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """An estimator as a value: the name of its class, and its attributes."""

    kind: str
    attributes: Mapping[str, Any]


class Estimator(ABC):
    """The joint state of all nodes. Every method raises `InputError` or `UnknownNodeError` and then changes nothing.

    `copy.copy` returns an estimator that changes independently of this one. Beside the nodes there may be others, such
    as the vehicle's poses and landmarks, which factor providers add.
    """

    lag: float = 0.0
    """Age up to which `update` puts measurements at their own time, s; 0: it takes those of the present alone."""
    snapshots_hold_models: ClassVar[bool] = False
    """Whether a snapshot holds the models of what moves nonlinearly, which are functions and no plain values."""
    providers: Sequence[FactorProvider] = ()
    """Asked for factors once a frame by `ask_providers`; empty for none."""

    # the Gaussian, moved and corrected

    @property
    @abstractmethod
    def time(self) -> float:
        """Sum of all intervals since the start, s."""

    @property
    def nodes(self) -> IntArray:
        """(n,) ids in the order of the joint state."""
        return self.posterior().layout.nodes

    @abstractmethod
    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        """Add nodes independent of all others: ids (k,), means (k, d), covariances (k, d, d); classes by id."""

    def add_unchecked(
        self, nodes: IntArray, means: FloatArray, covariances: FloatArray, labels: Mapping[int, str] | None = None
    ) -> None:
        """Add nodes as `add` does, whose numbers were checked where they came in."""
        self.add(nodes, means, covariances, labels)

    @abstractmethod
    def predict(self, transition: Transition) -> None:
        """Move all nodes by a transition over exactly the present nodes, in any order."""

    @abstractmethod
    def update(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None = None,
    ) -> float:
        """Take in measurements, several kinds at once if need be; return the log-likelihood of their innovation.

        time: when they were made, s, on this clock, which `remembered` is true of; None: now. NaN is returned where
        nothing is computed before it is asked for.
        """

    @abstractmethod
    def marginalise(self, nodes: ArrayLike) -> None:
        """Integrate out nodes that disappear, so that their information on their neighbours stays."""

    def remembered(self, nodes: ArrayLike, time: float) -> BoolArray:
        """(k,) whether measurements of nodes at `time`, s, can still be put there; asked where `lag` is above 0."""
        return np.zeros(len(np.asarray(nodes)), dtype=bool)

    # what is read

    @abstractmethod
    def posterior(self) -> BlockGaussian:
        """The joint Gaussian: of the nodes, and perhaps of others."""

    @property
    def unsettled(self) -> IntArray:
        """Nodes whose nonlinear solution has not settled; the answer of closed forms always has."""
        return np.empty(0, dtype=np.int64)

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, d) means of nodes of equal size d."""
        return self.posterior().means_of(nodes)

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, d, d) marginal covariances of nodes of equal size d."""
        return self.posterior().covariances_of(nodes)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        """Stacked mean of some nodes, in the order given, of any sizes."""
        x = self.posterior()
        return np.asarray(x.mean[x.layout.places(x.layout.rows(nodes))])

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        """Joint covariance of some nodes, in the order given, of any sizes."""
        x = self.posterior()
        return x.joint(x.layout.rows(nodes))

    def planar_marginals(self, nodes: ArrayLike, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (k, 4) with their covariances (k, 4, 4), by a kernel.

        places (k, 4): where x, y, vx, vy are in the states, -1 for none, which gives zeros
        """
        x = self.posterior()
        at, rows = x.partition.block_places, x.layout.rows(nodes)
        return planar_marginals(x.mean, x.flat, x.layout.offsets, at.start, at.size, at.offset, rows, places)

    def graph(self) -> SceneFactorGraph:
        """The equivalent factor graph, its values the solution; `solve()` and GTSAM's own solvers come to the same.

        `graph.of(OBJECT, graph.epoch)` are the present nodes.
        """
        return prior_graph(self.posterior(), self.time)

    def snapshot(self) -> Any:
        """The whole state as a value, which can be pickled."""
        return EstimatorState(part_name(self), self._own_attributes())

    def restore(self, state: Any) -> None:
        """Continue from a snapshot of an estimator of the same kind; raises `InputError` for anything else."""
        require_type("state", state, EstimatorState)
        if state.kind != part_name(self):
            raise InputError(f"state: expected one of {part_name(self)}, got one of {state.kind}")
        vars(self).update(deepcopy(dict(state.attributes)))

    def __copy__(self) -> Self:
        twin = object.__new__(type(self))
        vars(twin).update(vars(self) | self._own_attributes())
        return twin

    def handed_over(self) -> Self:
        """A copy that takes over what would be long to build again; this one is rarely needed after it."""
        return copy(self)

    # factors of providers, for those that have any

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:  # noqa: B027 -- for those with providers
        """Set the frame that providers see, and the origin (2,) of the states' positions in the world, m."""

    def ask_providers(self) -> None:  # noqa: B027
        """Take in the factors of all providers, once a frame."""

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Take in the factors of some providers at once, at the present epoch."""
        raise InputError(f"{type(self).__name__} takes no factors of providers at once")

    @property
    def others(self) -> Sequence[int] | IntArray:
        """The variables beside the nodes, by numbers of the estimator's own."""
        return ()

    @property
    def auxiliary(self) -> SceneFactorGraph:
        """A graph that has the variables beside the nodes with their values, with or without factors."""
        return SceneFactorGraph()

    def covariance_with(self, keys: Sequence[int], nodes: ArrayLike) -> FloatArray:
        """Joint covariance of variables of `auxiliary`, by key, and of some nodes, in the order given."""
        raise InputError(f"{type(self).__name__} has no variables beside the nodes")

    def _own_attributes(self) -> dict[str, Any]:
        return deepcopy({name: value for name, value in vars(self).items() if name != "providers"})
