"""Whole recordings at once: the batch smoother, and the batch back end of the running graph.

The batch smoother: a whole recording, every state given everything measured.

All factors since the start are solved at once, with the means and covariances of every node at every epoch, in
whichever order of elimination takes least time (`saga_fg.estimators.sparse_elimination`). Robust losses are solved by
iteratively reweighted least squares, or by graduated non-convexity, which finds outliers without a good start
(`saga_fg.estimators.graduated`).

The batch back end of the running graph: everything at once, nothing marginalised, by Levenberg-Marquardt.

Providers are asked epoch by epoch, as by `saga_fg.estimators.IncrementalSmoother`, or a graph is handed over whole;
it is solved when somebody asks for an estimate. Residual functions of one family are linearised together in NumPy
(`factors.solve`); losses that ask for graduated non-convexity get it (`saga_fg.estimators.graduated`). A last step by
QR brings back the digits that Cholesky leaves behind, unless cliques are wide.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from factors import FactorError, Robust, SolverSettings, linearised
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.backward import GaussNewtonSettings
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import checked_most
from saga_fg.estimators.epoch import Epoch
from saga_fg.estimators.graduated import GraduatedNonConvexity, solve_graduated
from saga_fg.estimators.graph_window import GraphSolution
from saga_fg.estimators.measurements import Observations, RecordedMeasurements
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.recording import Recording, RecordingState
from saga_fg.estimators.sparse_elimination import NoSolution, Order, SparseSolution, cheapest_order
from saga_fg.estimators.windowed import RecordedSmoother, SmoothedState
from saga_fg.graph.factor_checks import solver_error
from saga_fg.graph.providers import FactorProvider, GraphView, ask, predictors
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import GraphError, LinearisationPoint
from saga_fg.model.discretisation import Transition
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.frame import Frame

log = logging.getLogger(__name__)

_MAX_STAGES = 200  # of graduated non-convexity


@dataclass(frozen=True, eq=False)
class BatchState:
    """The smoother as a value: the recording, and whether graduated non-convexity has weighed all of it."""

    recording: RecordingState
    graduated: bool


class BatchSmoother(RecordedSmoother):
    """The exact smoother over everything. See `saga_fg.estimators.protocol.Estimator` for the methods.

    settings     of Gauss-Newton, for what is nonlinear or robust
    likelihoods  whether `update` returns the likelihood of what it takes in; without, nothing is computed before an
                 estimate is asked for, and `update` returns NaN
    order        of elimination: "time", "colamd", "metis", or "auto" for the cheapest (that of time where something is
                 nonlinear). Where sparse elimination has not the digits, and for joint covariances, it is that of time
    max_component largest number of nodes that are smoothed jointly, in the order of time: where more are connected, the
                 weakest interactions take over the neighbour's mean and variance only; None: any number, exact

    `mean`, `covariance` and their like speak of the newest epoch, `smoothed` of all epochs.
    """

    def __init__(
        self,
        settings: GaussNewtonSettings | None = None,
        likelihoods: bool = True,
        order: Literal["auto"] | Order = "auto",
        max_component: int | None = None,
    ) -> None:
        if order not in ("auto", *get_args(Order)):
            raise InputError(f"order: expected one of auto, {', '.join(get_args(Order))}, got {order!r}")
        self._settings = settings or GaussNewtonSettings()
        self._recording = Recording(self._settings, lazy=not likelihoods)
        self._most = checked_most(max_component)
        self._wanted = order if max_component is None else "time"
        self._order: Order | None = None  # of the recording as it is
        self._sparse: SparseSolution | None = None  # its solution, where that is not in the order of time
        self._graduated = True  # whether the weights of graduated non-convexity are those of the whole recording

    def add(
        self, nodes: ArrayLike, means: ArrayLike, covariances: ArrayLike, labels: Mapping[int, str] | None = None
    ) -> None:
        super().add(nodes, means, covariances, labels)
        self._clear_cache()

    def predict(self, transition: Transition) -> None:
        super().predict(transition)
        self._clear_cache()

    def update(
        self,
        measurements: Measurements | Observations | Sequence[Measurements | Observations],
        time: float | None = None,
        robust: Robust | GraduatedNonConvexity | None = None,
    ) -> float:
        """Take in measurements, as `RecordedSmoother.update`; a loss may be reached by graduated non-convexity."""
        likelihood = self._take_in(measurements, time, robust)
        self._graduated &= not isinstance(robust, GraduatedNonConvexity)
        self._clear_cache()
        return likelihood

    @property
    def order(self) -> Order:
        """The order of elimination in which this recording is solved."""
        if self._order is None:
            recording = self._recording
            if self._wanted != "auto":
                self._order = self._wanted
            elif recording.linear:
                self._order = cheapest_order(recording.epochs, recording.layouts)
            else:  # the filter finds a better start than the dynamics alone
                self._order = "time"
        return self._order

    def smoothed(self, covariances: bool = True, joint: bool = False) -> tuple[SmoothedState, ...]:
        """Every epoch, oldest first.

        Without `covariances` means only, which costs much less; with `joint` the joint covariances of each epoch's
        nodes too, which takes more memory.
        """
        self._graduate()
        recording, sparse = self._recording, None if joint else self._solution()
        if sparse is None:
            return self._smoothed(covariances, joint)
        try:
            P = sparse.covariances(recording.layouts) if covariances else None
        except FactorError as reason:
            self._give_up(reason)
            return self._smoothed(covariances, joint)
        return tuple(
            SmoothedState(epoch.time, layout, mean, None if P is None else P[k])
            for k, (epoch, layout, mean) in enumerate(
                zip(recording.epochs, recording.layouts, sparse.means, strict=True)
            )
        )

    def weights(self) -> list[list[FloatArray]]:
        """For each epoch, for each of its updates, (m,) how much each measurement counts: 1 fully, 0 not at all."""
        self._graduate()
        epochs, layouts = self._recording.epochs, self._recording.layouts
        return [
            [recorded.weights_at(layout, mean) for recorded in epoch.measurements]
            for epoch, layout, mean in zip(epochs, layouts, self._means(), strict=True)
        ]

    def graph(self) -> SceneFactorGraph:
        """The recording as a running graph; outliers found by graduated non-convexity count by their weights."""
        self._graduate()
        return self._recording.graph(self._means())

    def snapshot(self) -> BatchState:
        """The whole state, as a value."""
        return BatchState(self._recording.snapshot(), self._graduated)

    def restore(self, state: BatchState) -> None:
        """Continue from a snapshot, bit-identically."""
        require_type("state", state, BatchState)
        self._recording.restore(state.recording)
        self._graduated = state.graduated
        self._clear_cache()

    def posterior(self) -> BlockGaussian:
        self._graduate()
        return super().posterior()

    def _graduate(self) -> None:
        """Find the weights of graduated non-convexity, from all ones."""
        if self._graduated:
            return
        losses = {recorded.robust for recorded in _all_measurements(self._recording.epochs)}
        kinds = [loss for loss in losses if isinstance(loss, GraduatedNonConvexity)]
        weights = {loss: np.ones(len(self._distances(loss))) for loss in kinds}
        self._weigh(weights)
        distances = {loss: self._distances(loss) for loss in kinds}
        mu: dict[GraduatedNonConvexity, float | None] = {loss: loss.first(distances[loss]) for loss in kinds}
        for stage in range(_MAX_STAGES):
            before = weights
            weights = {loss: loss.weights(loss.last if at is None else at, distances[loss]) for loss, at in mu.items()}
            settled = all(at is None for at in mu.values())
            if settled and all(np.abs(weights[loss] - before[loss]).max(initial=0.0) < 1e-6 for loss in kinds):
                break
            self._weigh(weights)
            distances = {loss: self._distances(loss) for loss in kinds}
            mu = {loss: at if at is None else loss.next(at, weights[loss]) for loss, at in mu.items()}
            log.debug("stage %d of graduated non-convexity: mu %s", stage + 1, list(mu.values()))
        else:
            log.warning("graduated non-convexity has not settled in %d stages", _MAX_STAGES)
        self._graduated = True

    def _distances(self, loss: GraduatedNonConvexity) -> FloatArray:
        """Distances of all residuals under this loss, standard deviations."""
        epochs, layouts = self._recording.epochs, self._recording.layouts
        parts = [
            recorded.distances(layout, mean)
            for epoch, layout, mean in zip(epochs, layouts, self._means(), strict=True)
            for recorded in epoch.measurements
            if recorded.robust == loss
        ]
        return np.concatenate([np.empty(0), *parts])

    def _weigh(self, weights: dict[GraduatedNonConvexity, FloatArray]) -> None:
        """Set the weights of all measurements under each loss, in their order."""
        used = dict.fromkeys(weights, 0)
        epochs: list[Epoch] = []
        for epoch in self._recording.epochs:
            measurements = []
            for recorded in epoch.measurements:
                loss, count = recorded.robust, len(recorded.measured)
                if isinstance(loss, GraduatedNonConvexity):
                    recorded = recorded.with_weights(weights[loss][used[loss] : used[loss] + count])
                    used[loss] += count
                measurements.append(recorded)
            epochs.append(replace(epoch, measurements=tuple(measurements)))
        self._recording.reweigh(epochs)
        self._sparse = None

    def _means(self) -> Sequence[FloatArray]:
        """Joint mean of every epoch."""
        sparse = self._solution()
        return self._recording.means() if sparse is None else sparse.means

    def _solution(self) -> SparseSolution | None:
        """The solution in a sparse order, None where that of time is better or the only one."""
        if self.order != "time" and self._sparse is None:
            try:
                self._sparse = SparseSolution.of(self._recording, self.order, self._settings.max_iterations)
            except (NoSolution, FactorError, GraphError) as reason:
                self._give_up(reason)
        return self._sparse

    def _give_up(self, reason: Exception) -> None:
        """Fall back to elimination in the order of time."""
        log.info("eliminated in the order of time: %s", reason)
        self._order, self._sparse = "time", None

    def _clear_cache(self) -> None:
        self._order = self._sparse = None


def _all_measurements(epochs: Sequence[Epoch]) -> Iterable[RecordedMeasurements]:
    return (recorded for epoch in epochs for recorded in epoch.measurements)


class BatchSolver:
    """The graph of some providers, solved as a whole.

    providers   asked once an epoch, in this order. What they see of the states is where these begin, or were at the
                last solution; asking for a covariance solves what there is so far
    graph       to begin with, by default an empty one; it is copied
    settings    of Levenberg-Marquardt

    Every method raises `GraphError`, for what the graph does not take, and then the solver is as it was before.
    """

    def __init__(
        self,
        providers: Sequence[FactorProvider] = (),
        graph: SceneFactorGraph | None = None,
        settings: SolverSettings | None = None,
    ) -> None:
        self.providers = tuple(providers)
        self.origin = np.zeros(2)  # origin of the positions of objects, world, m
        self._settings = settings or SolverSettings()
        self._graph = SceneFactorGraph()
        self._solution: GraphSolution | None = None
        self._shared = False  # a caller may hold the graph, so that its values are copied before a change
        if graph is not None:
            self.restore(graph)

    @property
    def time(self) -> float:
        """Time of the newest epoch, s."""
        return self._graph.time

    def step(self, time: float, providers: Sequence[FactorProvider] | None = None, frame: Frame | None = None) -> None:
        """Begin the epoch at `time`, s, and ask the providers, by default those of the solver.

        frame: the input of the epoch
        """
        asked = self.providers if providers is None else providers
        unchanged, begun = (self._graph, self._solution, self._shared), predictors(asked)
        self._ask(time, begun or asked, frame)
        if begun:
            try:
                self._ask(None, asked, frame)
            except GraphError:
                self._graph, self._solution, self._shared = unchanged
                self._graph.erase_unknown_values()
                raise

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Ask some more providers at the present epoch."""
        self._ask(None, providers)

    def marginalise(self, keys: Iterable[int]) -> None:
        """Integrate variables out, linearised at the solution; their information on others stays."""
        graph = self.graph().copy()
        graph.marginalise(keys)
        self._replace_graph(graph)

    def solve(self) -> GraphSolution:
        """Minimise, unless nothing has changed; raises `UndeterminedError` naming the variables that are not."""
        if self._solution is None:
            graph = self._graph.copy()
            graph.erase_unknown_values()  # when a provider asks, others have added some already
            self._solution = _minimise(graph, self._settings)
            self._graph = graph
        return self._solution

    def graph(self) -> SceneFactorGraph:
        """The graph itself, solved: its variables, factors and values. To be read, not changed."""
        self.solve()
        self._shared = True
        return self._graph

    def state(self, key: int) -> object:
        """Value of a variable: a vector, or a pose."""
        return self.graph().state(key)

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance (d, d) of a variable; of a pose in its own frame, as GTSAM's."""
        self._graph.variable(key)
        return self.solve().marginal(key)

    def joint_covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of variables in the order given."""
        for key in keys:
            self._graph.variable(key)
        return self.solve().covariance(keys)

    def snapshot(self) -> SceneFactorGraph:
        """The graph as a value, which can be pickled."""
        return self._graph.copy()

    def restore(self, graph: SceneFactorGraph) -> None:
        """Continue from a graph, of whichever back end."""
        require_type("graph", graph, SceneFactorGraph)
        self._replace_graph(graph.copy())

    def _ask(self, time: float | None, providers: Sequence[FactorProvider], frame: Frame | None = None) -> None:
        known = self._graph
        graph = known.copy(share_values=not self._shared)
        view = GraphView(graph, self.covariance, self.origin, frame)
        try:
            if time is not None:
                graph.advance(time)
            for provider in providers:
                ask(provider, graph, view)
        except GraphError:
            known.erase_unknown_values()
            raise
        self._replace_graph(graph)

    def _replace_graph(self, graph: SceneFactorGraph) -> None:
        self._graph, self._solution, self._shared = graph, None, False


def _minimise(graph: SceneFactorGraph, settings: SolverSettings) -> GraphSolution:
    """The minimum, to which the graph moves."""
    native, ours = graph.solver_inputs()
    try:
        found = solve_graduated(native, ours, graph.values, settings)
        rough = GraphSolution(
            LinearisationPoint(graph.variables, found.values, found.values), found.linear, found.converged
        )
        graph.moved_to(found.values.retract(rough.step))
        values = graph.values
        return GraphSolution(
            LinearisationPoint(dict(graph.variables), values, values), linearised(native, ours, values), found.converged
        )
    except FactorError as error:
        raise solver_error(graph.variables, graph.groups, error) from error
