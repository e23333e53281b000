"""Solvers of the running graph: everything at once by Levenberg-Marquardt, or epoch by epoch by iSAM2.

The batch back end. Providers are asked epoch by epoch, as by `saga_fg.estimators.IncrementalSmoother`, or a graph is
handed over whole; it is solved when somebody asks for an estimate. Residual functions of one family are linearised
together in NumPy (`factors.solve`). A last step by QR brings back the digits that Cholesky leaves behind, unless
cliques are wide.

`gtsam.ISAM2` as the engine: any factors, one variable a node and epoch, fluid relinearisation.

iSAM2 gets linear factors on increments from the base of every variable (`saga_fg.graph.variables`) and never
linearises itself: no callback runs in an update, and a factor that raises does so before. When a variable has moved by
more than `threshold` of its own standard deviations from where its factors were linearised, these are linearised
anew, families in NumPy all at once, and exchanged: the old ones out, the new ones in (Kaess et al., "iSAM2", IJRR 31,
2012). Robust losses are weighted anew with it (iteratively reweighted least squares). Where that does not
settle, as after a poor start, damped steps solve the graph (`saga_fg.estimators.relinearisation`), and iSAM2 begins
anew from there.

Epochs older than `lag` are marginalised: their factors go out, the prior that they leave on their neighbours comes in,
and iSAM2 drops the variables without factors. Between the two they need not be leaves of the Bayes tree, which
GTSAM's `marginalizeLeaves` asks for, and the prior is a factor of the graph like any other.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import cached_property

import gtsam
import numpy as np

from factors import FactorError, SolverSettings, linearised, marginal_moments, solve
from factors.gaussian import Elimination, block_covariances, singular_system
from saga_fg.errors import InputError, require_type
from saga_fg.estimators.interval_dynamics import joint_gaussian
from saga_fg.estimators.isam2_engine import Engine, RelinearisationSettings
from saga_fg.estimators.partition import BlockGaussian, StateLayout
from saga_fg.graph import (
    Condensation,
    FactorProvider,
    GraphError,
    GraphView,
    LinearisationPoint,
    OtherVariables,
    SceneFactorGraph,
    ask,
    predictors,
    solver_error,
)
from saga_fg.numerics import FloatArray
from saga_fg.types import Frame

_WIDE = 400  # dimensions of a clique from which QR takes ten times as long as Cholesky


class GraphSolution:
    """values: where all variables are; converged: whether the last step was short enough.

    point: the values with their bases; linear: all factors, on increments from the bases
    """

    def __init__(self, point: LinearisationPoint, linear: gtsam.GaussianFactorGraph, converged: bool) -> None:
        self._point, self._linear = point, linear
        self.values, self.converged = point.values, converged

    def covariance(self, keys: Iterable[int]) -> FloatArray:
        """Joint covariance (D, D) of variables in the order given; of poses in their own frames, as GTSAM's."""
        wanted = list(keys)
        return self._point.transported(wanted, marginal_moments(self._linear, wanted, self._eliminated[1])[1])

    def marginal(self, key: int) -> FloatArray:
        """Covariance (d, d) of one variable, by elimination of everything once for all variables that are asked for."""
        return self._point.transported([key], self._marginals[key])

    @property
    def step(self) -> gtsam.VectorValues:
        """Step from the linearisation point to the minimum. Raises `SingularSystemError`."""
        step = self._eliminated[0].optimize()
        if not np.isfinite(step.norm()):
            raise singular_system(self._linear)
        return step

    @cached_property
    def _marginals(self) -> dict[int, FloatArray]:
        dims = {key: variable.dim for key, variable in self._point.variables.items()}
        return block_covariances(self._eliminated[0], dims)

    @cached_property
    def _eliminated(self) -> tuple[gtsam.GaussianBayesTree, Elimination]:
        """By QR where cliques are narrow, else by Cholesky, which has half the digits and is ten times as fast."""
        with contextlib.suppress(RuntimeError):
            tree = self._linear.eliminateMultifrontal()
            if width(tree) > _WIDE:
                return tree, "cholesky"
        try:
            order = gtsam.Ordering.ColamdGaussianFactorGraph(self._linear)
            return self._linear.eliminateMultifrontal(order, gtsam.EliminateQR), "qr"
        except RuntimeError as error:
            raise singular_system(self._linear, error) from error


def linear_solution(graph: SceneFactorGraph) -> GraphSolution:
    """The factors of a graph as they are linearised where its variables are; the step counts from their base."""
    linear, point = gtsam.GaussianFactorGraph(), graph.point()
    for number in sorted(graph.groups, key=lambda number: graph.groups[number].elimination_order):
        for factor in graph.linear(number, point):
            linear.push_back(factor)
    return GraphSolution(point, linear, True)


def width(tree: gtsam.GaussianBayesTree) -> int:
    """Dimensions of the largest clique."""
    widest, below = 0, list(tree.roots())
    while below:
        clique = below.pop()
        widest = max(widest, clique.conditional().cols() - 1)
        below += [clique[k] for k in range(clique.nrChildren())]
    return widest


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
        unchanged, begun = (self._graph, self._solution), predictors(asked)
        self._ask(time, begun or asked, frame)
        if begun:
            try:
                self._ask(None, asked, frame)
            except GraphError:
                self._graph, self._solution = unchanged
                raise

    def extend(self, providers: Sequence[FactorProvider]) -> None:
        """Ask some more providers at the present epoch."""
        self._ask(None, providers)

    def solve(self) -> GraphSolution:
        """Minimise, unless nothing has changed; raises `UndeterminedError` naming the variables that are not."""
        if self._solution is None:
            graph = self._graph.copy()
            self._solution = _minimise(graph, self._settings)
            self._graph = graph
        return self._solution

    def graph(self) -> SceneFactorGraph:
        """The graph itself, solved: its variables, factors and values. To be read, not changed."""
        self.solve()
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
        graph = self._graph.copy()
        view = GraphView(graph, self.covariance, self.origin, frame)
        if time is not None:
            graph.advance(time)
        for provider in providers:
            ask(provider, graph, view)
        self._replace_graph(graph)

    def _replace_graph(self, graph: SceneFactorGraph) -> None:
        self._graph, self._solution = graph, None


def _minimise(graph: SceneFactorGraph, settings: SolverSettings) -> GraphSolution:
    """The minimum, to which the graph moves."""
    native, ours = graph.solver_inputs()
    try:
        found = solve(native, ours, graph.values, settings)
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


class IncrementalSmoother:
    """The running graph of some providers, solved after every frame.

    providers   asked once a frame, in this order
    lag         s; epochs leave but for the last that is at least so old: 0 is a filter, None keeps everything. What has
                one variable for all time stays until it is marginalised by hand
    settings    of relinearisation
    elimination "qr", or "cholesky": several times as fast where many variables hang together, with half the digits;
                once priors are left by what is marginalised, their width decides

    Every method raises `GraphError`, for what the graph does not take, and then the smoother is as it was before.
    """

    def __init__(
        self,
        providers: Sequence[FactorProvider] = (),
        lag: float | None = 0.0,
        settings: RelinearisationSettings | None = None,
        elimination: Elimination = "qr",
    ) -> None:
        if lag is not None and not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, or None, got {lag!r}")
        self.providers = tuple(providers)
        self.origin = np.zeros(2)  # that positions of objects are counted from, in the world, m
        self.frame: Frame | None = None  # of the present epoch
        self._lag, self._settings = lag, settings or RelinearisationSettings()
        self._graph = SceneFactorGraph(elimination)
        self._engine: Engine | None = None
        self._times: list[float] = []
        self._changed = False  # since it was solved
        self._unsettled = frozenset[int]()

    @property
    def time(self) -> float:
        """Time of the newest epoch, s."""
        return self._graph.time

    @property
    def unsettled(self) -> frozenset[int]:
        """Keys of the variables that had not settled when the graph was last solved; empty where all have."""
        return self._unsettled & self._graph.variables.keys()

    def graph(self) -> SceneFactorGraph:
        """The running graph itself: its variables, factors and values. To be read, not changed."""
        return self._graph

    def step(self, time: float, providers: Sequence[FactorProvider] | None = None, frame: Frame | None = None) -> None:
        """Begin the epoch at `time`, s, ask the providers, by default those of the smoother, and solve.

        frame: the input of the epoch
        """
        unchanged, times, asked = self._graph, self._times, self.providers if providers is None else providers
        self.frame = frame
        begun = predictors(asked)
        try:
            self.begin(time, begun or asked)
            if begun:
                self.extend(asked)
            self.forget()
        except GraphError:
            self._graph, self._times, self._engine = unchanged, times, None
            raise

    def begin(
        self,
        time: float,
        providers: Sequence[FactorProvider],
        carried_over: Iterable[int] = (),
        change: Callable[[SceneFactorGraph], None] | None = None,
        others: OtherVariables | None = None,
    ) -> None:
        """Begin an epoch as `step`, but keep all that is older than the lag.

        carried_over: variables that are those of the new epoch, too; change: of the graph, after the first provider;
        others: variables apart from the graph, which providers see
        """
        graph = self._graph.copy()
        graph.advance(time, carried_over)
        self._ask(graph, providers, change, others)
        self._move_to(graph)
        self._times = [*self._times, graph.time]

    def forget(self, kept: Collection[int] = (), since: float | None = None) -> None:
        """Marginalise all epochs before the last until `since`, s, by default `lag` ago, but for variables `kept`."""
        if since is None:
            if self._lag is None:
                return
            since = self.time - self._lag
        first = sum(t <= since for t in self._times[1:])
        self.marginalise([key for key in self._graph.older_than(self._times[first]) if key not in kept])
        self._times = self._times[first:]

    def extend(
        self,
        providers: Sequence[FactorProvider],
        others: OtherVariables | None = None,
        settings: RelinearisationSettings | None = None,
    ) -> None:
        """Ask some more providers at the present epoch, and solve again.

        others: variables apart from the graph, which they see; settings: of this solution alone
        """
        graph = self._graph.copy()
        self._ask(graph, providers, others=others)
        self._move_to(graph, settings)

    def change(self, change: Callable[[SceneFactorGraph], None]) -> None:
        """Change the graph; the next solution has it."""
        graph = self._graph.copy()
        change(graph)
        self._graph, self._changed = graph, True

    def clear(self, elimination: Elimination) -> None:
        """Take out all variables and factors; the epoch stays. elimination: from now on."""
        graph = self._graph.copy()
        graph.elimination = elimination
        graph.drop(set(graph.variables))
        self._graph, self._engine, self._changed = graph, None, False
        self._times = self._times[-1:]

    def marginalise(self, keys: Iterable[int], into: Condensation | None = None) -> None:
        """Integrate variables out; their information on others stays, in the factors that `into` makes of it."""
        leaving = set(keys)
        if not leaving:
            return
        graph, engine = self._graph.copy(), self._engine
        self._engine = None  # it is begun anew, should this fail
        if engine is None or into is not None or not engine.in_time or not engine.marginalised(graph, leaving):
            graph.marginalise(leaving, into)
        self._graph, self._engine = graph, engine

    @property
    def nonlinear(self) -> bool:
        """Whether some factor is nonlinear: then a change may move the linearisation point of any variable."""
        return any(not held.factors.linear for held in self._graph.groups.values())

    def state(self, key: int) -> object:
        """Value of a variable: a vector, or a pose."""
        return self._graph.state(key)

    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance (d, d) of a variable; of a pose in its own frame, as GTSAM's."""
        self._graph.variable(key)
        root = np.asarray(np.linalg.inv(self._ready().root(key)))
        D = self._graph.point().transport(key)
        root = root if D is None else D @ root
        return root @ root.T

    def joint_covariance(self, keys: Sequence[int], rough: bool = False) -> FloatArray:
        """Joint covariance of variables in the order given; rough: to half the digits, from their part of the tree."""
        for key in keys:
            self._graph.variable(key)
        P = self._ready().joint(keys) if rough else None
        return self.solution().covariance(keys) if P is None else self._graph.point().transported(keys, P)

    def solution(self) -> GraphSolution:
        """The present solution as a value."""
        engine, graph = self._ready(), self._graph
        return GraphSolution(
            LinearisationPoint(dict(graph.variables), graph.base, graph.values), engine.linear(), not engine.unsettled
        )

    def joint_gaussian(self, layout: StateLayout, keys: Sequence[int]) -> BlockGaussian:
        """The joint Gaussian of variables by components, as `saga_fg.estimators.interval_dynamics` has it."""
        engine, graph = self._ready(), self._graph
        return joint_gaussian(graph, engine.covariance, layout, keys)

    def copied(self, taking_over: bool) -> IncrementalSmoother:
        """Return a smoother of the same graph; one of the two builds another iSAM2 when it is needed.

        taking_over: that is this one, and the copy goes on with the present iSAM2
        """
        twin = copy.copy(self)
        twin._times = list(self._times)
        (self if taking_over else twin)._engine = None
        return twin

    def snapshot(self) -> SceneFactorGraph:
        """The graph as a value, which can be pickled."""
        return self._graph.copy()

    def restore(self, graph: SceneFactorGraph) -> None:
        """Continue from a snapshot; iSAM2 is built anew."""
        require_type("graph", graph, SceneFactorGraph)
        self._graph, self._engine = graph.copy(), None
        times = {one.time for one in graph.variables.values() if one.time is not None}
        self._times = sorted(times | ({graph.time} if graph.epoch >= 0 else set()))

    def _ask(
        self,
        graph: SceneFactorGraph,
        providers: Sequence[FactorProvider],
        change: Callable[[SceneFactorGraph], None] | None = None,
        others: OtherVariables | None = None,
    ) -> None:
        view = GraphView(graph, self.covariance, self.origin, self.frame, others)
        for k, provider in enumerate(providers):
            ask(provider, graph, view)
            if k == 0 and change is not None:
                change(graph)

    def _move_to(self, graph: SceneFactorGraph, settings: RelinearisationSettings | None = None) -> None:
        self._engine = self._solve(graph, settings or self._settings)
        self._graph, self._changed = graph, False

    def _ready(self) -> Engine:
        """iSAM2 with the graph as it is."""
        if self._engine is None or self._changed:
            self._move_to(self._graph.copy())
        assert self._engine is not None
        return self._engine

    def _solve(self, graph: SceneFactorGraph, settings: RelinearisationSettings) -> Engine:
        """iSAM2 with the graph, which moves to the solution."""
        engine, self._engine = self._engine, None  # it is begun anew, should it fail
        start = graph.point().values
        if engine is None or engine.elimination != graph.elimination or engine.holds_others(graph):
            engine = Engine(graph.elimination, in_time=self._lag is not None)
        try:
            engine = engine.solved(graph, settings)
        except GraphError:
            if graph.elimination == "qr":
                raise
            graph.moved_to(start)  # Cholesky has half the digits
            engine = Engine("qr", in_time=self._lag is not None).solved(graph, settings)
        self._unsettled = engine.unsettled
        return engine
