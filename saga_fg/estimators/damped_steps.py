"""Damped steps for what plain relinearisation does not settle, component by component, and what has not settled then.

Gauss-Newton overshoots where residuals are large and curved, and can go to and fro between two points for ever. Each
component of the graph with a nonlinear factor is then solved by itself: by Gauss-Newton with a line search, and by
Levenberg-Marquardt from there where that does not settle either (`factors.solver`). A variable has not settled if its
next step is still longer than the threshold,

    sqrt( delta_k^T P_kk^-1 delta_k )  >  threshold

in standard deviations of its marginal covariance P_kk. The others of its component have, even so.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import FactorError, SingularSystemError, Solution, SolverSettings, solve
from saga_fg.graph.factor_checks import solver_error
from saga_fg.graph.factor_groups import ActiveRows, HeldGroup
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import insert_state
from saga_fg.numerics.arrays import IntArray

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
