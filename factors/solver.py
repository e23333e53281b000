"""Nonlinear least squares over GTSAM's factors and ours together: Gauss-Newton's steps, damped or shortened.

    minimise  E(x) = sum_i rho_i( || r_i(x) ||_{R_i} )

Each iteration linearises at x, GTSAM's own factors in C++ and ours by their `linearise`, solves for the step

    (H + lambda I) delta = g,     H = A^T A,  g = A^T b     (GTSAM's multifrontal elimination)

and moves to x + delta. Robust factors enter with the weights of the present x (iteratively reweighted least squares).
Of ours, those that come together (`ResidualFactors`) take one call for all; the same factors as `CustomFactor`s in
GTSAM's optimisers took 25 times as long with a hundred nodes, and are refused here.

Levenberg-Marquardt starts at lambda = 0, that is as Gauss-Newton, and damps only steps that fail to lower E
(Nocedal and Wright, Numerical Optimization, 2nd ed. 2006, section 10.3). The line search goes a share a of the
Gauss-Newton step, halved until it lowers E by what Armijo's rule asks for (the same, section 3.1),

    E(x + a delta) <= E(x) - c a delta^T H delta,     c = 1e-4

which damps a step that overshoots without turning it away from where sharp factors allow it to go. All stop when the
next step is short: its length in posterior standard deviations is sqrt(delta^T H delta), which knows no units.
"""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, get_args

import gtsam
import numpy as np

from factors.gaussian import block_covariances, check_dimensions, marginal_moments, singular_system
from factors.validation import FactorError, FloatArray, SingularSystemError, format_keys

_LOG = logging.getLogger(__name__)
_EXACT = 1e-12  # relative agreement of the error with its prediction from which a problem counts as linear
_ROUNDING = 1e-9  # relative, of an error, at the most
_MAX_DAMPING = 1e12
_PIVOT = 1e-14  # relative to its column
_ARMIJO = 1e-4  # c of Armijo's rule
_MIN_SHARE = 2.0**-30  # of a step; where less is needed, it does not lower the error

Method = Literal["levenberg-marquardt", "line-search"]


class Linearisable(Protocol):
    """Factors that GTSAM does not evaluate itself."""

    @property
    def keys(self) -> tuple[int, ...]: ...

    def error(self, values: gtsam.Values) -> float:
        """Return the cost, -log phi, at `values`."""

    def linearise(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """Return the factors on the increments from `values`."""


@dataclass(frozen=True)
class SolverSettings:
    """method: "levenberg-marquardt" or "line-search"; max_iterations: linearisations; tolerance: length
    of the step, in posterior standard deviations, below which the solution counts as reached; relative_tolerance:
    decrease of the error by a step, as a share of it, below which it does, too; damping: first lambda, tried when a
    plain step fails.
    """

    method: Method = "levenberg-marquardt"
    max_iterations: int = 100
    tolerance: float = 1e-6
    relative_tolerance: float = 0.0
    damping: float = 1e-4

    def __post_init__(self) -> None:
        if self.method not in (known := get_args(Method)):
            raise FactorError(f"method: expected one of {', '.join(known)}, got {self.method!r}")
        if self.max_iterations < 1 or not self.tolerance > 0 or not self.damping > 0:
            raise FactorError("settings: expected max_iterations >= 1, tolerance > 0 and damping > 0")
        if not self.relative_tolerance >= 0:
            raise FactorError(f"relative_tolerance: expected a number >= 0, got {self.relative_tolerance:g}")


@dataclass(frozen=True, eq=False)
class Solution:
    """values: the minimum; error: E there; iterations: linearisations it took; converged: whether the last step was
    short enough; graph, factors: what was minimised.
    """

    values: gtsam.Values
    error: float
    iterations: int
    converged: bool
    graph: gtsam.NonlinearFactorGraph
    factors: Sequence[Linearisable]

    @cached_property
    def linear(self) -> gtsam.GaussianFactorGraph:
        """The factors on increments from `values`, for covariances and for passing on."""
        return linearised(self.graph, self.factors, self.values)

    def covariance(self, keys: Iterable[int]) -> FloatArray:
        """Return the joint covariance (D, D) of `keys`, in this order, in the limit of small errors."""
        return marginal_moments(self.linear, keys)[1]

    def marginal(self, key: int) -> FloatArray:
        """Return the covariance (d, d) of one variable; all is eliminated once, for all that are asked for."""
        try:
            return np.asarray(self._tree.marginalCovariance(key))
        except RuntimeError:  # Cholesky squares the condition number, which objects hardly seen make large
            return marginal_moments(self.linear, [key], "qr")[1]

    def marginals(self) -> dict[int, FloatArray]:
        """Return the covariances (d, d) of all variables, by key."""
        try:
            tree = self._tree
        except RuntimeError:
            tree = self.linear.eliminateMultifrontal(function=gtsam.EliminateQR)
        return block_covariances(tree, self.values.dims())

    @cached_property
    def step(self) -> gtsam.VectorValues | None:
        """The next Gauss-Newton step, None where the system is singular."""
        return _step(self.linear, gtsam.Ordering.ColamdGaussianFactorGraph(self.linear), 0.0)

    @cached_property
    def _tree(self) -> gtsam.GaussianBayesTree:
        return self.linear.eliminateMultifrontal()


def solve(
    graph: gtsam.NonlinearFactorGraph,
    factors: Sequence[Linearisable],
    start: gtsam.Values,
    settings: SolverSettings | None = None,
) -> Solution:
    """Return the minimum of GTSAM's factors in `graph` and ours in `factors` together, from `start`.

    Linear factors go into the graph by `nonlinear_graph`. Not converging is no exception: look at `Solution.converged`.
    Raises `FactorError` when variables and factors do not fit together, a factor fails at `start`, or is a
    `gtsam.CustomFactor`, and `SingularSystemError`, naming the variables, when the factors do not determine the
    solution.
    """
    settings = settings or SolverSettings()
    check_variables(graph, factors, start)
    values, error = start, _error(graph, factors, start)
    if not np.isfinite(error):
        raise FactorError(f"the error at the start is {error}: a factor holds a number that is not finite")
    damping = 0.0
    ordering = None
    for iteration in range(1, settings.max_iterations + 1):
        linear = _linearised(graph, factors, values)
        if ordering is None:
            ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        if settings.method == "line-search":
            move = _searched(graph, factors, linear, ordering, values, error, settings)
        else:
            move = _move(graph, factors, linear, ordering, values, error, damping, settings)
        if move is None:  # no damping helps: error and linearisation contradict each other
            return Solution(values, error, iteration, False, graph, factors)
        _LOG.debug("iteration %d: error %.9g, damping %.3g", iteration, move.error, move.damping)
        reached = (
            move.length <= settings.tolerance or move.exact or error - move.error < settings.relative_tolerance * error
        )
        values, error, damping = move.values, move.error, move.damping
        if damping == 0 and reached:
            return Solution(values, error, iteration, True, graph, factors)
        damping = damping / 10 if damping > settings.damping else 0.0
    return Solution(values, error, settings.max_iterations, False, graph, factors)


def linearised(
    graph: gtsam.NonlinearFactorGraph, factors: Iterable[Linearisable], values: gtsam.Values
) -> gtsam.GaussianFactorGraph:
    """Return all factors linearised at `values`, on increments from there.

    Raises `FactorError` for a `gtsam.CustomFactor`.
    """
    _native(graph)
    return _linearised(graph, factors, values)


def _linearised(
    graph: gtsam.NonlinearFactorGraph, factors: Iterable[Linearisable], values: gtsam.Values
) -> gtsam.GaussianFactorGraph:
    linear = graph.linearize(values)
    for factor in factors:
        linear.push_back(factor.linearise(values))
    return linear


def check_variables(graph: gtsam.NonlinearFactorGraph, factors: Iterable[Linearisable], values: gtsam.Values) -> None:
    """Raise `FactorError` unless factors and values speak of the same variables, and wrapped linear ones fit them.

    A variable without a single factor is a `SingularSystemError`.
    """
    dims = values.dims()
    used = {*graph.keyVector(), *(key for factor in factors for key in factor.keys)}
    missing = sorted(used - dims.keys())
    if missing:
        raise FactorError(f"values: expected {format_keys(missing)}, which factors speak of")
    free = sorted(dims.keys() - used)
    if free:
        raise SingularSystemError(f"no factor speaks of {format_keys(free)}", tuple(free))
    wrapped = [factor for factor in _native(graph) if isinstance(factor, gtsam.LinearContainerFactor)]
    check_dimensions((factor.factor() for factor in wrapped), dims)  # which GTSAM checks of its other factors


def _native(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    """The factors of a graph; GTSAM would crash where the function of a `CustomFactor` leaves a Jacobian unset."""
    factors = [graph.at(i) for i in range(graph.size()) if graph.exists(i)]
    for factor in factors:
        if isinstance(factor, gtsam.CustomFactor):
            raise FactorError(
                f"CustomFactor of {format_keys(factor.keys())}: expected a `residual_factor` in its place"
            )
    return factors


@dataclass(frozen=True)
class _Move:
    """values, error: where the step led, length: of the step, in sigmas, or infinite where it is
    longer than the tolerance for sure, damping: that it took, exact: whether the error came out as the linearisation
    had said, which means that there is nothing nonlinear.
    """

    values: gtsam.Values
    error: float
    length: float
    damping: float
    exact: bool


def _move(
    graph: gtsam.NonlinearFactorGraph,
    factors: Sequence[Linearisable],
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
    error: float,
    damping: float,
    settings: SolverSettings,
) -> _Move | None:
    """Return the first step, damped as much as it takes, that does not raise the error; None when none does."""
    undetermined = False
    while damping <= _MAX_DAMPING:
        step = _step(linear, ordering, damping)
        if step is None:
            undetermined |= damping == 0
        else:
            moved = values.retract(step)
            moved_error = _error_or_infinity(graph, factors, moved)
            gained = error - moved_error > max(settings.tolerance**2, _ROUNDING * error)  # twice what such a step gains
            length = float("inf") if gained else _length(linear, step, damping)
            if undetermined and length <= settings.tolerance and damping <= settings.damping:
                raise singular_system(linear)  # standing still, but only the damping says where
            unchanged = max(_EXACT, settings.relative_tolerance if damping == 0 else 0.0)
            if moved_error <= error * (1 + unchanged) or (length <= settings.tolerance and damping == 0):
                exact = abs(moved_error - linear.error(step)) <= _EXACT * error
                return _Move(moved, moved_error, length, damping, exact)
        damping = max(10 * damping, settings.damping)
    if undetermined:
        raise singular_system(linear)
    return None


def _searched(
    graph: gtsam.NonlinearFactorGraph,
    factors: Sequence[Linearisable],
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
    error: float,
    settings: SolverSettings,
) -> _Move | None:
    """Return the largest share of the step, halved, that lowers the error enough; None when none does."""
    step = _step(linear, ordering, 0.0)
    if step is None:
        raise singular_system(linear)
    length, share = _length(linear, step, 0.0), 1.0
    while share >= _MIN_SHARE:
        moved = values.retract(step if share == 1 else step.scale(share))
        moved_error = _error_or_infinity(graph, factors, moved)
        if moved_error <= error * (1 + _EXACT) - _ARMIJO * share * length**2:
            exact = share == 1 and abs(moved_error - linear.error(step)) <= _EXACT * error
            return _Move(moved, min(moved_error, error), length, 0.0, exact)  # rounding alone makes it larger
        share /= 2
    return _Move(values, error, length, 0.0, False) if length <= settings.tolerance else None


def _error(graph: gtsam.NonlinearFactorGraph, factors: Iterable[Linearisable], values: gtsam.Values) -> float:
    try:
        native = graph.error(values)
    except FactorError:
        raise
    except (RuntimeError, ValueError) as error:
        raise FactorError(f"GTSAM could not evaluate the graph: {error}") from error
    return native + sum(factor.error(values) for factor in factors)


def _error_or_infinity(
    graph: gtsam.NonlinearFactorGraph, factors: Iterable[Linearisable], values: gtsam.Values
) -> float:
    try:
        return _error(graph, factors, values)
    except FactorError:  # a step too far, to where a factor is undefined
        return float("inf")


def _step(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, damping: float) -> gtsam.VectorValues | None:
    """Return the damped step, or None when the system is singular."""
    system = linear
    if damping > 0:
        system = gtsam.GaussianFactorGraph()
        system.push_back(linear)
        zero, rows = linear.gradientAtZero(), {}
        for i in range(ordering.size()):
            key = ordering.at(i)
            if (dim := zero.dim(key)) not in rows:
                rows[dim] = np.sqrt(damping) * np.eye(dim), np.zeros(dim), gtsam.noiseModel.Unit.Create(dim)
            system.push_back(gtsam.JacobianFactor(key, *rows[dim]))
    step: gtsam.VectorValues | None
    try:
        step = system.optimize(ordering)
    except RuntimeError:  # Cholesky squares the condition number
        step = _step_by_qr(system, ordering)
    return step if step is not None and np.isfinite(step.norm()) else None


def _step_by_qr(system: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues | None:
    """Return the step, or None where a pivot is but rounding: |r_ii| is how far column i of A is from those before."""
    try:
        tree = system.eliminateMultifrontal(ordering, gtsam.EliminateQR)
    except RuntimeError:
        return None
    step, keys = tree.optimize(), sorted(system.keyVector())
    ends = np.cumsum([step.dim(key) for key in keys])
    _, column, entries = system.sparseJacobian_()
    lengths = np.sqrt(np.bincount(column.astype(int) - 1, entries**2, ends[-1] + 1)).tolist()
    of_key = {key: lengths[end - step.dim(key) : end] for key, end in zip(keys, ends.tolist(), strict=True)}
    cliques = list(tree.roots())
    pivots: list[float] = []
    columns: list[float] = []
    while cliques:
        clique = cliques.pop()
        conditional = clique.conditional()
        pivots += conditional.R().diagonal().tolist()
        for key in conditional.keys():  # noqa: SIM118
            if len(columns) < len(pivots):  # the others are eliminated later
                columns += of_key[key]
        cliques += [clique[k] for k in range(clique.nrChildren())]
    determined = np.abs(pivots) > _PIVOT * np.array(columns)
    return step if determined.all() else None


def _length(linear: gtsam.GaussianFactorGraph, step: gtsam.VectorValues, damping: float) -> float:
    """Return sqrt(delta^T H delta); (H + lambda I) delta = g makes that g^T delta - lambda delta^T delta."""
    square = -linear.gradientAtZero().dot(step) - (damping * step.dot(step) if damping > 0 else 0.0)
    return float(np.sqrt(max(square, 0.0)))
