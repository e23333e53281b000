"""The window of a running graph: its epochs with what came at each, and solutions of it as values.

The epochs of a running graph within a window, with what came at each, so that what comes late goes in its place.

A measurement of the past takes the filter back to the epoch before it: the interval that contains its time is
discretised anew over both parts, with the edges as they were recorded, and all that came since comes again. That is
exact wherever the filter is, and asks nothing of a solver but to begin from an earlier state.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors import marginal_moments
from factors.gaussian import Elimination, block_covariances, singular_system
from saga_fg.errors import InputError
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import LinearisationPoint
from saga_fg.model.discretisation import Transition
from saga_fg.numerics.arrays import BoolArray, FloatArray, checked

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


SAME_TIME = 1e-9  # s
LEFT = "marginalise"  # the call by which nodes leave


@dataclass(frozen=True, eq=False)
class Call:
    """A call that changed the filter: a method with its arguments."""

    method: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class WindowEpoch:
    """An epoch of the window: its number in the graph, its time, s; keys of the objects' variables there, by id.

    calls        that came at this epoch, in their order
    state        of the filter after them; with the transition to the next epoch, None for the newest
    """

    number: int
    time: float
    keys: Mapping[int, int]
    calls: tuple[Call, ...] = ()
    state: Any = None
    transition: Transition | None = None


@dataclass(frozen=True, eq=False)
class GraphWindow:
    """The epochs, oldest first."""

    epochs: tuple[WindowEpoch, ...]

    @property
    def newest(self) -> WindowEpoch:
        """The present epoch."""
        return self.epochs[-1]

    @property
    def start(self) -> float:
        """Time of the oldest epoch, s."""
        return self.epochs[0].time

    def called(self, method: str, *arguments: Any) -> GraphWindow:
        """Note a call."""
        newest = self.newest
        return GraphWindow((*self.epochs[:-1], replace(newest, calls=(*newest.calls, Call(method, arguments)))))

    @property
    def without_states(self) -> GraphWindow:
        """The epochs without the states in which they were left, each of which would hold all earlier ones."""
        return GraphWindow(tuple(replace(one, state=None) for one in self.epochs))

    def with_states(self, window: GraphWindow) -> GraphWindow:
        """The epochs that are in another window, too, with the states that they have there."""
        states = {one.number: one.state for one in window.epochs}
        return GraphWindow(tuple(replace(one, state=states[one.number]) for one in self.epochs if one.number in states))

    def left(self, state: Any, transition: Transition) -> GraphWindow:
        """Note the state in which the newest epoch is left, and the transition from there."""
        return GraphWindow((*self.epochs[:-1], replace(self.newest, state=state, transition=transition)))

    def begun(self, epoch: WindowEpoch, since: float) -> GraphWindow:
        """Begin the next epoch; since: what is older is forgotten but for the last, s."""
        first = max((k for k, one in enumerate(self.epochs) if one.time <= since + SAME_TIME), default=0)
        return GraphWindow((*self.epochs[first:], epoch))

    def with_keys(self, taken: Mapping[int, Mapping[int, int]]) -> GraphWindow:
        """Note the variables of objects, by id, by the number of their epoch."""
        return GraphWindow(tuple(replace(one, keys={**one.keys, **taken.get(one.number, {})}) for one in self.epochs))

    def without(self, nodes: set[int]) -> GraphWindow:
        """Forget the variables of objects."""
        epochs = (replace(one, keys={n: key for n, key in one.keys.items() if n not in nodes}) for one in self.epochs)
        return GraphWindow(tuple(epochs))

    def place(self, time: float, start: float) -> int:
        """The newest epoch that is not after `time`. Raises `InputError` for one before `start` or after the newest."""
        time, newest = float(checked("time", time, ())), self.newest.time
        if time > newest + SAME_TIME:
            raise InputError(f"time: {time:.6f} s is after the newest epoch, {newest:.6f} s; predict first")
        if time < start - SAME_TIME:
            raise InputError(f"time: {time:.6f} s is before what is remembered, which begins at {start:.6f} s")
        return max(k for k, epoch in enumerate(self.epochs) if epoch.time <= time + SAME_TIME)

    def there(self, nodes: ArrayLike, k: int) -> BoolArray:
        """(m,) which nodes have been there since the end of epoch k."""
        ids, state = np.asarray(nodes), self.epochs[k].state
        gone = [call.arguments[0] for epoch in self.epochs[k + 1 :] for call in epoch.calls if call.method == LEFT]
        found = ~np.isin(ids, np.concatenate([np.empty(0, dtype=np.int64), *map(np.atleast_1d, gone)]))
        return found if state is None else found & np.isin(ids, state.layout.nodes)
