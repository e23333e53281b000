"""The tracker's filter as a running graph, in which factors of users' own take part.

The calls of an estimator become providers of an `IncrementalSmoother`: `add` adds new objects, `predict` an epoch
with its interaction factors, `update` detections. Between them users' providers are asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import require_type
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.filter_steps import corrected
from saga_fg.estimators.incremental_smoother import IncrementalSmoother
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.joint_gaussian import by_covariance, lossy, replace_by_prior
from saga_fg.estimators.layout import StateLayout, checked_prior
from saga_fg.estimators.measurements import Observations, RecordedMeasurements
from saga_fg.estimators.object_factors import DetectionFactors, Interactions, NewObjects
from saga_fg.estimators.protocol import LatestMarginals, Measurements
from saga_fg.graph.keys import MAP_NODE, OBJECT, node_key
from saga_fg.graph.providers import FactorProvider, predictors
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.types.frame import Frame


@dataclass(frozen=True, eq=False)
class GraphState:
    """The filter as a value: the graph; its nodes, in order; their variables, by id; variables beside them that stay
    until providers are asked again; those of nodes that have left since the epoch began."""

    graph: SceneFactorGraph
    layout: StateLayout
    keys: Mapping[int, int]
    auxiliary: tuple[int, ...]
    left: tuple[int, ...]


class GraphFilter(LatestMarginals):
    """The joint state of all tracks in a running graph. See `saga_fg.estimators.protocol.Estimator` for the methods.

    providers  asked by `ask_providers`, once a frame
    lag        s; how long epochs stay in the graph, at least until all providers have been asked at the next one
    relinearised  keep the epoch before until the next one in any case, so that nonlinear motion is linearised anew
               where measurements put it; else it is linearised at the prediction, as by the extended Kalman filter

    Estimates are those of the newest states, at any lag. A node whose state an interval leaves unchanged keeps its
    variable. States whose noise is so small that factors would lose digits are predicted by covariances.
    """

    def __init__(self, providers: Sequence[FactorProvider] = (), lag: float = 0.0, relinearised: bool = False) -> None:
        self.providers, self._lag = tuple(providers), lag
        self._relinearised = relinearised or bool(providers)
        self._smoother = IncrementalSmoother(lag=lag)
        self._smoother.step(0.0)
        self._layout = StateLayout()
        self._keys: Mapping[int, int] = {}
        self._auxiliary: tuple[int, ...] = ()  # variables beside the nodes, of the epoch when providers were last asked
        self._left: tuple[int, ...] = ()  # variables of nodes that have left since the epoch began
        self._posterior: BlockGaussian | None = None  # until the graph changes

    def __copy__(self) -> GraphFilter:
        twin = GraphFilter(self.providers, self._lag, self._relinearised)
        twin.__dict__ |= self.__dict__
        twin._smoother = self._smoother.handed_over()
        return twin

    @property
    def nodes(self) -> IntArray:
        return self._layout.nodes

    @property
    def time(self) -> float:
        return self._smoother.time

    def set_frame(self, frame: Frame | None, origin: FloatArray) -> None:
        """Set the frame that providers see, and the origin (2,) of the states' positions in the world, m."""
        self._smoother.origin, self._smoother.frame = origin, frame
        graph = self._smoother.graph()
        if graph.epoch == 0 and not graph.variables:
            self.extend(predictors(self.providers))

    def ask_providers(self) -> None:
        """Let the users' providers add their factors, on the nodes that have not left."""
        smoother = self._smoother_to_change()
        smoother.marginalise(key for key in self._left if key in smoother.graph().variables)
        smoother.extend(self.providers)
        smoother.forget(self._keys.values())
        self._auxiliary = self._auxiliary_now()

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Let some providers add their factors at the present epoch."""
        self._smoother_to_change().extend(providers)

    @property
    def others(self) -> list[int]:
        """Keys of the variables beside the nodes: poses, landmarks."""
        every = self._smoother.graph().variables
        return [key for key, one in every.items() if one.epoch is None or one.kind not in (OBJECT, MAP_NODE)]

    def covariance_with(self, keys: Sequence[int], nodes: ArrayLike) -> FloatArray:
        """Joint covariance of other variables and some nodes, in the order given."""
        mine = [self._keys[node] for node in np.asarray(nodes).tolist()]
        return self._smoother.joint_covariance([*keys, *mine])

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        mean, covariance = checked_prior(nodes, means, covariances)
        layout = self._layout.extended(nodes, mean.shape[1])
        added = layout.nodes[len(self._layout) :]
        smoother = self._smoother_to_change()
        keys = {node: node_key(node, smoother.graph().epoch) for node in added.tolist()}
        back = [key for key in keys.values() if key in smoother.graph().variables]
        if back:  # removed and added at the same epoch: iSAM2 has to forget them first
            smoother.marginalise(back)
            smoother.extend([])
            self._left = tuple(key for key in self._left if key not in back)
        smoother.extend([NewObjects(added, mean, covariance, labels or {})])
        self._layout, self._keys = layout, {**self._keys, **keys}

    def predict(self, transition: Transition) -> None:
        require_type("transition", transition, Transition)
        interval = IntervalDynamics(transition)
        interval.check(self._layout)
        x, nodes = self.posterior(), self._layout.nodes
        dynamics = interval.linearised(self._layout, x.mean)
        still = dynamics.unchanged
        if transition.dt == 0 and still.all():
            return
        carried_over, epoch = set(nodes[still].tolist()), self._smoother.graph().epoch + 1
        keys = {n: key if n in carried_over else node_key(n, epoch) for n, key in self._keys.items()}
        chosen = lossy(x, dynamics, still, window=self._lag > 0)
        unused = np.isin(transition.nodes, nodes[still | chosen])
        change = self._predict_by_covariance(dynamics, chosen, keys) if chosen.any() else None
        smoother = self._smoother_to_change()
        smoother.forget({*self._keys.values(), *self._auxiliary})
        moved = Interactions(_with_noise(transition, unused) if unused.any() else transition, self._keys, carried_over)
        begun = [moved, *predictors(self.providers)]
        smoother.begin(self.time + transition.dt, begun, [self._keys[node] for node in carried_over], change)
        self._keys, self._left = keys, ()
        self._auxiliary += self._auxiliary_now()
        if not self._relinearised:  # nobody is to be asked for factors on the epoch before
            smoother.forget(keys.values())

    def update(self, *measurements: Measurements | Observations) -> float:
        """Take in measurements, several kinds of them by one solution."""
        kinds = [RecordedMeasurements(each) for each in measurements]
        for recorded in kinds:
            recorded.check(self._layout)
        kinds = [recorded for recorded in kinds if len(recorded.measured)]
        if not kinds:
            return 0.0
        x, log_likelihood = self.posterior(), 0.0
        for recorded in kinds:
            x, likelihood = corrected(x, recorded.linearised(x.layout, x.mean))
            log_likelihood += likelihood
        self._smoother_to_change().extend([DetectionFactors(recorded.measured, self._keys) for recorded in kinds])
        return log_likelihood

    def marginalise(self, nodes: ArrayLike) -> None:
        """Nodes that disappear have no state at the next epoch; their information on their neighbours stays."""
        rows = self._layout.rows(nodes)
        self._left += tuple(self._keys[node] for node in self._layout.nodes[rows].tolist())
        self._layout = self._layout.without(rows)
        self._keys = {node: self._keys[node] for node in self._layout.nodes.tolist()}
        self._posterior = None

    def posterior(self) -> BlockGaussian:
        """The joint Gaussian of all nodes."""
        if self._posterior is None:
            self._posterior = self._joint()
        return self._posterior

    def graph(self) -> SceneFactorGraph:
        """The running graph itself."""
        return self._smoother.graph()

    def snapshot(self) -> GraphState:
        """The whole state as a value, which can be pickled. iSAM2 begins anew from it: both go on to the same bits."""
        state = GraphState(self._smoother.snapshot(), self._layout, self._keys, self._auxiliary, self._left)
        self.restore(state)
        return state

    def restore(self, state: GraphState) -> None:
        """Continue from a snapshot."""
        require_type("state", state, GraphState)
        self._smoother_to_change().restore(state.graph)
        self._layout, self._keys = state.layout, state.keys
        self._auxiliary, self._left = state.auxiliary, state.left

    def _auxiliary_now(self) -> tuple[int, ...]:
        """Variables of the present epoch beside the nodes."""
        graph, nodes = self._smoother.graph(), set(self._keys.values())
        return tuple(k for k, one in graph.variables.items() if one.epoch == graph.epoch and k not in nodes)

    def _predict_by_covariance(
        self, dynamics: Dynamics, chosen: BoolArray, keys: Mapping[int, int]
    ) -> Callable[[SceneFactorGraph], None]:
        """Return the change of the graph that predicts the components of the `chosen` nodes (n,) by covariances."""
        every = self._smoother.graph().variables
        auxiliary = {key: key for key, one in every.items() if one.epoch is None or key in self._auxiliary}
        x = self._joint(auxiliary)
        others = np.arange(len(self._layout), len(x.layout))
        moved = by_covariance(x, dynamics.with_static(x.layout, others), chosen)
        earlier, now = ({**auxiliary, **nodes} for nodes in (self._keys, keys))
        return lambda graph: replace_by_prior(graph, moved, earlier, now)

    def _joint(self, auxiliary: Iterable[int] = ()) -> BlockGaussian:
        """The joint Gaussian of all nodes, then of other variables, by increments from the base."""
        layout, every = self._layout, self._smoother.graph().variables
        for key in auxiliary:
            layout = layout.extended([key], every[key].dim)
        keys = {**dict.fromkeys(auxiliary), **self._keys}
        return self._smoother.joint_gaussian(layout, [keys[node] or node for node in layout.nodes.tolist()])

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        return self.posterior(), self._layout.rows(nodes)

    def _smoother_to_change(self) -> IncrementalSmoother:
        self._posterior = None
        return self._smoother


def _with_noise(transition: Transition, rows: BoolArray) -> Transition:
    """Give some nodes (n,) noise of variance 1, so that their factors, which are not used, can be made."""
    Q = [
        replace(group, values=np.where(rows[group.target][:, None, None], np.eye(group.values.shape[1]), group.values))
        for group in transition.Q
    ]
    return replace(transition, Q=tuple(Q))
