"""The batch back end of the running graph: everything at once, nothing marginalised, by Levenberg-Marquardt.

Providers are asked epoch by epoch, as by `saga_fg.estimators.IncrementalSmoother`, or a graph is handed over whole;
it is solved when somebody asks for an estimate. Residual functions of one family are linearised together in NumPy
(`factors.solve`). A last step by QR brings back the digits that Cholesky leaves behind, unless cliques are wide.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from factors import FactorError, SolverSettings, linearised, solve
from saga_fg.errors import require_type
from saga_fg.estimators.solution import GraphSolution
from saga_fg.graph.factor_checks import solver_error
from saga_fg.graph.providers import FactorProvider, GraphView, ask, predictors
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import GraphError, LinearisationPoint
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.frame import Frame


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

    def marginalise(self, keys: Iterable[int]) -> None:
        """Integrate variables out, linearised at the solution; their information on others stays."""
        graph = self.graph().copy()
        graph.marginalise(keys)
        self._replace_graph(graph)

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
