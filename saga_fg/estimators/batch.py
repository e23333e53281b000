"""The batch back end of the running graph, everything at once by Levenberg-Marquardt, and solutions as values.

Providers are asked epoch by epoch, as by `saga_fg.estimators.IncrementalSmoother`, or a graph is handed over whole;
it is solved when somebody asks for an estimate. Residual functions of one family are linearised together in NumPy
(`factors.solve`). A last step by QR brings back the digits that Cholesky leaves behind, unless cliques are wide.
"""

import contextlib
from collections.abc import Iterable, Sequence
from functools import cached_property

import gtsam
import numpy as np

from factors import FactorError, SolverSettings, linearised, marginal_moments, solve
from factors.gaussian import Elimination, block_covariances, singular_system
from saga_fg.errors import require_type
from saga_fg.graph import (
    FactorProvider,
    GraphError,
    GraphView,
    LinearisationPoint,
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
