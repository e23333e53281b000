"""Relinearisation: how far variables have moved, damped steps where plain ones do not settle, and what has not then.

Gauss-Newton overshoots where residuals are large and curved, and can go to and fro between two points for ever. Each
component of the graph with a nonlinear factor is then solved by itself: by Gauss-Newton with a line search, and by
Levenberg-Marquardt from there where that does not settle either (`factors.solver`). A variable has not settled if its
next step is still longer than the threshold,

    sqrt( delta_k^T P_kk^-1 delta_k )  >  threshold

in standard deviations of its marginal covariance P_kk. The others of its component have, even so.
"""

import contextlib
from collections.abc import Iterable, KeysView, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import FactorError, SingularSystemError, Solution, SolverSettings, solve
from saga_fg.graph import ActiveRows, HeldGroup, SceneFactorGraph, insert_state, solver_error
from saga_fg.numerics import FloatArray, IntArray

_MAX_STEPS = 60
_LEAST_TOLERANCE = 1e-4  # sigma; Levenberg-Marquardt's last steps are shorter than rounding lets them be below

Part = list[tuple[HeldGroup, IntArray]]  # rows of groups


@dataclass(frozen=True, eq=False)
class DampedSolution:
    """unsettled: keys of the variables that have not settled; values: of the components that have any of them."""

    unsettled: frozenset[int]
    values: gtsam.Values


def solve_damped(graph: SceneFactorGraph, threshold: float) -> DampedSolution:
    """Move the variables of all components that have a nonlinear factor to their minima, as far as these are found.

    threshold: length of the last step, in standard deviations. Raises `GraphError`.
    """
    values, unsettled, found = graph.values, set[int](), gtsam.Values()
    for part in _parts(graph):
        solution = _solution(graph, part, threshold)
        values.update(solution.values)
        if not solution.converged and (mine := unsettled_keys(solution, threshold)):
            unsettled |= mine
            found.insert(solution.values)
    graph.moved_to(values)
    return DampedSolution(frozenset(unsettled), found)


def unsettled_keys(solution: Solution, threshold: float) -> set[int]:
    """Variables whose next step is longer than the threshold, in standard deviations; all where there is no step."""
    step, every = solution.step, set(solution.values.keys())
    if step is None:
        return every
    try:
        marginals = solution.marginals()
        length2 = {key: step.at(key) @ np.linalg.solve(P, step.at(key)) for key, P in marginals.items()}
    except (RuntimeError, np.linalg.LinAlgError):
        return every
    return {key for key, square in length2.items() if not square <= threshold**2}


def _parts(graph: SceneFactorGraph) -> list[Part]:
    """Components of the graph with a nonlinear factor."""
    label, parts = graph.index.components(), dict[int, Part]()
    for held in graph.index.sharpest_first():
        rows = held.rows
        of_row = np.array([label[held.factors.rows[row][0]] for row in rows.tolist()], dtype=np.int64)
        for number in np.unique(of_row).tolist():
            parts.setdefault(number, []).append((held, rows[of_row == number]))
    return [part for part in parts.values() if any(not held.factors.linear for held, _ in part)]


def _solution(graph: SceneFactorGraph, part: Part, threshold: float) -> Solution:
    (native, ours), start = graph.solver_inputs(part), gtsam.Values()
    for key in {key for held, rows in part for row in rows.tolist() for key in held.factors.rows[row]}:
        insert_state(start, graph.variable(key), graph.state(key))
    try:
        return _damped(native, ours, start, threshold)
    except FactorError as error:
        raise solver_error(graph.variables, graph.groups, error) from error


def _damped(
    native: gtsam.NonlinearFactorGraph, ours: Sequence[ActiveRows], start: gtsam.Values, threshold: float
) -> Solution:
    with contextlib.suppress(SingularSystemError):  # on the way: Levenberg-Marquardt may get round that
        solution = solve(native, ours, start, SolverSettings("line-search", _MAX_STEPS, threshold))
        if solution.converged:
            return solution
        start = solution.values
    return solve(native, ours, start, SolverSettings(tolerance=max(threshold / 10, _LEAST_TOLERANCE)))


class Displacements:
    """Variables with delta_0 (d,), where their factors were linearised, and R (d, d), in rows without gaps.

    Rows are as wide as the largest variable; what a smaller one does not fill is zero.
    """

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._row: dict[int, int] = {}
        self._dims: dict[int, int] = {}
        self._at, self._root = np.zeros((16, 0)), np.zeros((16, 0, 0))

    def add(self, dims: Mapping[int, int]) -> None:
        """New variables at their base."""
        first, (rows, width) = len(self._keys), self._at.shape
        more = 2 * len(dims) + rows if first + len(dims) > rows else 0
        wider = max([width, *dims.values()]) - width
        if more or wider:
            self._at = np.pad(self._at, ((0, more), (0, wider)))
            self._root = np.pad(self._root, ((0, more), (0, wider), (0, wider)))
        self._keys += dims
        self._row |= dict(zip(dims, range(first, len(self._keys)), strict=True))
        self._dims |= dims

    def remove(self, keys: Iterable[int]) -> None:
        """Forget variables; the last one takes the row of each."""
        for key in keys:
            row, last = self._row.pop(key), self._keys.pop()
            del self._dims[key]
            end = len(self._keys)
            if last != key:
                self._keys[row], self._row[last] = last, row
                self._at[row], self._root[row] = self._at[end], self._root[end]
            self._at[end], self._root[end] = 0.0, 0.0

    def dims(self, keys: Iterable[int]) -> dict[int, int]:
        """Dimensions of variables, by key in their order."""
        return {key: self._dims[key] for key in keys}

    @property
    def keys(self) -> KeysView[int]:
        """All variables."""
        return self._dims.keys()

    def set_root(self, key: int, R: FloatArray) -> None:
        """Set R of a variable."""
        self._root[self._row[key], : len(R), : len(R)] = R

    def moved(self, delta: gtsam.VectorValues, threshold: float) -> list[int]:
        """Variables that are farther off than the threshold; their linearisation point is reset."""
        if not self._keys:
            return []
        n, now = len(self._keys), np.zeros_like(self._at[: len(self._keys)])
        dims = np.array([self._dims[key] for key in self._keys])
        now[np.arange(now.shape[1]) < dims[:, None]] = delta.vector(self._keys)
        way = (self._root[:n] @ (now - self._at[:n])[:, :, None])[:, :, 0]
        rows = np.flatnonzero(np.linalg.norm(way, axis=1) > threshold)
        self._at[rows] = now[rows]
        return [self._keys[row] for row in rows.tolist()]
