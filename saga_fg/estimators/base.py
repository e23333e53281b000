"""What estimators have in common: all of the protocol that follows from the joint Gaussian, or that few need.

An estimator of your own is a class that derives from `EstimatorBase` and has

    time         an attribute or a property, s; `predict` adds `transition.dt` to it
    add          nodes that appear
    predict      x <- F x + b + q, q ~ N(0, Q), with `transition.F_matrix`, `transition.b` and `transition.Q_matrix`
    update       measurements, which may be a sequence of several kinds
    marginalise  nodes that disappear
    posterior    the joint Gaussian; from matrices, `BlockGaussian.from_dense` makes one

as `saga_fg.estimators.protocol.Estimator` describes them. What is read of it comes from `posterior`; copies and
snapshots copy all attributes but `providers`, so that these methods may change arrays in place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.object_factors import prior_graph
from saga_fg.estimators.partition import StateLayout
from saga_fg.estimators.protocol import Estimator
from saga_fg.graph.providers import FactorProvider
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.kernels.components import planar_marginals
from saga_fg.model.discretisation import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.types.frame import Frame

ESSENTIAL = ("time", "add", "predict", "update", "marginalise", "posterior")
"""What an estimator cannot do without."""
POSES = ("extend", "covariance_with")
"""What an estimator needs further where the vehicle's pose is a variable beside the nodes."""


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """An estimator as a value: the name of its class, and its attributes."""

    kind: str
    attributes: Mapping[str, Any]


class EstimatorBase:
    """All methods of an estimator but the essential ones. See `saga_fg.estimators.protocol.Estimator` for them."""

    lag: float = 0.0
    providers: Sequence[FactorProvider] = ()

    @property
    def time(self) -> float:
        raise NotImplementedError

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        raise NotImplementedError

    def predict(self, transition: Transition) -> None:
        raise NotImplementedError

    def update(self, measurements: Any, time: float | None = None) -> float:
        raise NotImplementedError

    def marginalise(self, nodes: ArrayLike) -> None:
        raise NotImplementedError

    def posterior(self) -> BlockGaussian:
        raise NotImplementedError

    @property
    def nodes(self) -> IntArray:
        return self.posterior().layout.nodes

    def add_unchecked(
        self, nodes: IntArray, means: FloatArray, covariances: FloatArray, labels: Mapping[int, str] | None = None
    ) -> None:
        self.add(nodes, means, covariances, labels)

    def remembered(self, nodes: ArrayLike, time: float) -> BoolArray:
        return np.zeros(len(np.asarray(nodes)), dtype=bool)

    @property
    def unsettled(self) -> IntArray:
        return np.empty(0, dtype=np.int64)

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
        x, rows = self._at(nodes)
        at = x.partition.block_places
        return planar_marginals(x.mean, x.flat, x.layout.offsets, at.start, at.size, at.offset, rows, places)

    def graph(self) -> SceneFactorGraph:
        return prior_graph(self.posterior(), self.time)

    def snapshot(self) -> Any:
        return EstimatorState(_kind(self), self._own_attributes())

    def restore(self, state: Any) -> None:
        require_type("state", state, EstimatorState)
        if state.kind != _kind(self):
            raise InputError(f"state: expected one of {_kind(self)}, got one of {state.kind}")
        vars(self).update(deepcopy(dict(state.attributes)))

    def __copy__(self) -> Self:
        twin = object.__new__(type(self))
        vars(twin).update(vars(self) | self._own_attributes())
        return twin

    def handed_over(self) -> Self:
        return copy(self)

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        pass

    def ask_providers(self) -> None:
        pass

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        raise InputError(f"{type(self).__name__} takes no factors of providers at once")

    @property
    def others(self) -> Sequence[int] | IntArray:
        return ()

    @property
    def auxiliary(self) -> SceneFactorGraph:
        return SceneFactorGraph()

    def covariance_with(self, keys: Sequence[int], nodes: ArrayLike) -> FloatArray:
        raise InputError(f"{type(self).__name__} has no variables beside the nodes")

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        """A Gaussian, and which of its rows are these nodes."""
        x = self.posterior()
        return x, x.layout.rows(nodes)

    def _own_attributes(self) -> dict[str, Any]:
        return deepcopy({name: value for name, value in vars(self).items() if name != "providers"})


def missing(estimator: Any, poses: bool = False) -> list[str]:
    """Names of the protocol that an estimator lacks; with `poses`, of those too that an estimated ego pose needs."""
    cls, named = type(estimator), [name for name in ("lag", "providers", *vars(Estimator)) if not name.startswith("_")]
    needed = {*ESSENTIAL, *(POSES if poses else ())}
    absent = [name for name in dict.fromkeys(named) if not hasattr(cls, name) and name not in vars(estimator)]
    only_refused = [n for n in ESSENTIAL + POSES if n in needed and _of_base(cls, n) and n not in vars(estimator)]
    return absent + only_refused


def live_rows(x: BlockGaussian, live: StateLayout, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
    """A Gaussian that may have nodes that have left since, and which of its rows are `nodes`."""
    rows = live.rows(nodes)
    return x, rows if len(live) == len(x.layout) else x.layout.rows(live.nodes[rows])


def _of_base(cls: type, name: str) -> bool:
    return getattr(cls, name, None) is getattr(EstimatorBase, name)


def _kind(estimator: object) -> str:
    return f"{type(estimator).__module__}:{type(estimator).__qualname__}"
