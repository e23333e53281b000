"""iSAM2 as the solver of a running graph: which of its factors are which rows of the graph's groups.

`saga_fg.estimators.solvers` has the method. Factors on a variable are linearised anew when it has moved by

    || R (delta - delta_0) ||  >  threshold,      R^T R = P^-1

from delta_0, where its factors were linearised, in its own standard deviations (Mahalanobis distance in its marginal
covariance P). Fluid relinearisation after Kaess et al., "iSAM2", IJRR 31 (2012), section 4.1, whose threshold is in the
units of each variable. R is computed anew whenever a variable gets new factors.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Annotated, Any

import gtsam
import numpy as np
import scipy.linalg

from factors import FactorError, SingularSystemError, marginal_moments
from factors.gaussian import Elimination, block_covariances, native_factor, singular_system
from saga_fg.estimators.relinearisation import Displacements, solve_damped
from saga_fg.graph import GraphError, HeldGroup, SceneFactorGraph, UndeterminedError, insert_state, solver_error
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.settings import Positive, Range, Settings, setting

_FEW = 24  # variables that GTSAM eliminates as quickly one after the other
_MANY = 0.5  # share of the variables; iSAM2 eliminates all anew from 0.65 on, in an order of its own
_LARGE = 16  # variables of a component whose marginals cost less together than one by one

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RelinearisationSettings(Settings):
    """Settings of relinearisation."""

    threshold: Positive = setting(
        0.001, "linearise factors again when a variable moved by this many standard deviations; higher: faster"
    )
    max_iterations: Annotated[int, Range(1, 1000)] = setting(
        25, "largest number of linearisations in a frame, before damped steps take over"
    )


class _Taken(Exception):  # noqa: N818 -- it ends a query of GTSAM's that has told what is needed
    """A clique has been found."""


class Engine:
    """iSAM2, and which of its factors are which rows of the graph's groups."""

    def __init__(self, elimination: Elimination, in_time: bool = False) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization(elimination.upper())
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        parameters.enableRelinearization = False
        parameters.findUnusedFactorSlots = True
        self.isam, self.elimination, self.in_time = gtsam.ISAM2(parameters), elimination, in_time
        self.points = Displacements()
        self._delta = gtsam.VectorValues()  # increments from the base, at the last update
        self.slots: dict[int, IntArray] = {}
        self._held: dict[int, HeldGroup] = {}  # groups as they were at the last update
        self.unsettled = frozenset[int]()  # variables whose last step was longer than the threshold
        self._times: dict[int, float] = {}  # times of all variables, s, in whose order the tree has been eliminated
        self._births: dict[int, int] = {}  # of the variables that it has
        self._hints: dict[int, frozenset[int]] = {}  # keys of factors without information, by slot; see `_hinted`

    def solved(self, graph: SceneFactorGraph, settings: RelinearisationSettings) -> Engine:
        """The engine with everything that has changed in the graph, which moves to the solution."""
        start, self.unsettled = graph.point().values, frozenset()
        try:
            if not self._synchronised(graph):
                return self
            for _ in range(settings.max_iterations):
                if not self._relinearised(graph, settings.threshold):
                    return self
            log.info("at %.3f s relinearisation has not settled in %d iterations", graph.time, settings.max_iterations)
        except UndeterminedError:
            raise
        except GraphError as error:  # where it got to a factor may not be defined
            log.info("at %.3f s: %s", graph.time, error)
        graph.moved_to(start)
        restarted = Engine(graph.elimination, self.in_time)
        found = solve_damped(graph, settings.threshold)
        restarted.unsettled = found.unsettled
        restarted._synchronised(graph)
        if found.unsettled:
            some = ", ".join(str(graph.variables[key]) for key in sorted(found.unsettled)[:3])
            log.warning(
                "at %.3f s the graph has not settled, its factors may contradict each other: %d variables "
                "still move, as %s",
                graph.time,
                len(found.unsettled),
                some,
            )
            values = graph.values  # where iSAM2 has taken one step more, which may lead far away
            values.update(found.values)
            graph.moved_to(values)
        return restarted

    def holds_others(self, graph: SceneFactorGraph) -> bool:
        """Whether a key of the graph now names another variable than the one that iSAM2 has under it."""
        return any(self._births.get(key, born) != born for key, born in graph.births.items())

    def root(self, key: int, rough: bool = False) -> FloatArray:
        """R (d, d) of a variable's marginal, P = R^-1 R^-T, on increments from the base; rough: to half the digits."""
        conditional = None
        if rough or self.elimination == "cholesky":
            with contextlib.suppress(RuntimeError):
                conditional = self.isam.marginalFactor(key)
        if conditional is None:
            conditional = self.isam.marginalFactor(key, gtsam.EliminateQR)
        return np.array(conditional.R())  # R() is a view into the conditional

    def joint(self, keys: Sequence[int]) -> FloatArray | None:
        """Joint covariance of variables on increments from the base, to half the digits; None where these are lost."""
        try:
            return np.asarray(np.linalg.inv(self.isam.jointMarginalInformation(list(keys)).fullMatrix()))
        except (RuntimeError, np.linalg.LinAlgError):
            return None

    def covariance(self, keys: list[int]) -> FloatArray:
        """Joint covariance of variables on increments from the base, in the order given, as the tree has it.

        Where the tree has too few digits, all factors are eliminated anew; raises `FactorError` where that fails, too.
        """
        P = self._clique_covariance(keys)
        if P is None:
            log.debug("a joint covariance of %d variables is not in one clique, or lacks digits", len(keys))
            P = marginal_moments(self.linear(), keys, "qr")[1]
        return P

    def _clique_covariance(self, keys: list[int]) -> FloatArray | None:
        """From R of the clique at the root that holds all of `keys`, P = R^-1 R^-T; None where there is no such.

        GTSAM's own query eliminates the clique anew, one variable after the other: fifty times the work for thirty.
        """
        cliques: list[gtsam.GaussianFactorGraph] = []

        def take(clique: gtsam.GaussianFactorGraph, _: gtsam.Ordering) -> Any:
            cliques.append(clique)
            raise _Taken

        with contextlib.suppress(_Taken, RuntimeError):
            self.isam.jointBayesNet(keys, take)
        if not cliques or cliques[0].size() != 1:
            return None
        factor = cliques[0].at(0)
        dims, wanted = self.points.dims(factor.keys()), set(keys)
        if not wanted <= dims.keys() or not isinstance(factor, gtsam.JacobianFactor):
            return None
        R, kept = factor.augmentedJacobian()[:, :-1], [key for key in dims if key in wanted]
        others = [key for key in dims if key not in wanted]
        if moved := kept != list(dims)[len(others) :]:
            R = R[:, _columns(dims, [*others, *kept])]
        if moved or scipy.linalg.bandwidth(R)[0]:
            R = np.asarray(np.linalg.qr(R, mode="r"), dtype=np.float64)
        if R.shape[0] < R.shape[1]:
            return None
        first = sum(dims[key] for key in others)
        P, singular = scipy.linalg.lapack.dpotri(R[first : R.shape[1], first:])  # its upper triangle
        if singular or not np.isfinite(P).all():
            return None
        P = P + P.T
        P.flat[:: len(P) + 1] /= 2
        if kept == keys:
            return np.asarray(P)
        at = _columns({key: dims[key] for key in kept}, keys)
        return np.asarray(P[at[:, None], at])

    def linear(self) -> gtsam.GaussianFactorGraph:
        """All linear factors that it holds, the sharpest first."""
        held, linear = self.isam.getFactorsUnsafe(), gtsam.GaussianFactorGraph()
        for number in sorted(self.slots, key=lambda number: self._held[number].elimination_order):
            slots = self.slots[number]
            for slot in slots[slots >= 0].tolist():
                factor = held.at(slot)
                assert isinstance(factor, gtsam.LinearContainerFactor)
                linear.push_back(factor.factor())
        return linear

    def marginalised(self, graph: SceneFactorGraph, leaving: Set[int]) -> bool:
        """Marginalise leaves of the tree, here and in the graph; False where they are none.

        What was factors on `leaving` becomes the factors that the tree has cached for the cliques above. After False
        the engine is of no use any more.
        """
        groups = graph.groups
        if groups.keys() != self._held.keys() or any(groups[number] is not held for number, held in self._held.items()):
            return False  # it has not seen all of the graph
        if not leaving <= self._times.keys():
            return False
        latest = max(self._times[key] for key in leaving)
        if any(self._times.get(key, -math.inf) <= latest for key in graph.variables.keys() - leaving):
            return False  # some may have been eliminated before those that leave: GTSAM would crash at its next update
        keys, rows = gtsam.KeyList(), graph.index.rows_on(leaving)
        for key in leaving:
            keys.push_back(key)
        try:
            added, removed = self.isam.marginalizeLeavesWithIndices(keys)
        except RuntimeError:
            return False
        hints = {slot for slot, keys in self._hints.items() if not keys.isdisjoint(leaving)}
        if set(removed) != hints | {
            slot for number, mine in rows.items() for slot in self.slots[number][mine].tolist()
        }:
            return False
        for slot in hints:
            del self._hints[slot]
        held, factors = self.isam.getFactorsUnsafe(), []
        for slot in added:
            container = held.at(slot)
            assert isinstance(container, gtsam.LinearContainerFactor)
            factor = container.factor()
            factors.append(factor if isinstance(factor, gtsam.JacobianFactor) else gtsam.JacobianFactor(factor))
        numbers = graph.replace_rows(rows, factors, leaving)
        self.points.remove(leaving)
        for key in leaving:
            del self._times[key]
        for old in rows:
            if old in groups:
                self.slots[old] = np.where(groups[old].active, self.slots[old], -1)
            else:
                del self.slots[old]
        self.slots |= {number: np.array([slot]) for number, slot in zip(numbers, added, strict=True)}
        self._held = dict(groups)
        return True

    def _synchronised(self, graph: SceneFactorGraph) -> bool:
        """Update iSAM2 with the changes of the graph, which moves to the solution; true where a factor is nonlinear."""
        leaving = self.points.keys - graph.variables.keys()
        new = {key: graph.variable(key).dim for key in sorted(graph.variables.keys() - self.points.keys)}
        removed = self._remove_factors(graph)
        rows: list[tuple[int, IntArray]] = []
        linear: list[gtsam.JacobianFactor] = []
        point, nonlinear = graph.point(), set[int]()
        for number in sorted(graph.groups.keys() - self.slots.keys(), key=lambda n: graph.groups[n].elimination_order):
            held = graph.groups[number]
            rows.append((number, held.rows))
            linear += graph.linear(number, point)
            self.slots[number] = np.full(len(held.active), -1)
            if not held.factors.linear:
                nonlinear |= {key for row in held.rows.tolist() for key in held.factors.rows[row]}
        if alone := graph.index.without_factors():
            raise solver_error(graph.variables, graph.groups, SingularSystemError("", tuple(alone)))
        self.points.remove(leaving)
        self.points.add(new)
        self._update(graph, linear, rows, removed, new)
        self._update_sigmas(graph, nonlinear)
        return any(not held.factors.linear for held in graph.groups.values())

    def _update_sigmas(self, graph: SceneFactorGraph, keys: set[int]) -> None:
        """Compute R of variables anew, to half the digits.

        In large components the marginal of one variable costs as much as that of all, which are then computed at once:
        in a window all of them, in a graph that keeps everything those of this epoch and landmarks.
        """
        together: dict[int, FloatArray] = {}
        if self.in_time:
            together = self._window_roots(graph, keys)
        elif self.elimination == "cholesky":
            together = self._newest_roots(graph, keys)
        for key, R in together.items():
            self.points.set_root(key, R)
        if self.in_time or self.elimination == "qr":
            for key in keys - together.keys():
                self.points.set_root(key, self.root(key, rough=True))

    def _window_roots(self, graph: SceneFactorGraph, keys: set[int]) -> dict[int, FloatArray]:
        """R of variables in large components, by one Cholesky elimination of all factors; empty where that fails."""
        label = graph.index.components()
        count = Counter(label[key] for key in keys)
        large = [key for key in keys if count[label[key]] > _LARGE]
        if not large:
            return {}
        try:
            P = block_covariances(self.linear().eliminateMultifrontal(), self.points.dims(self.points.keys))
            return {key: _square_root_information(P[key]) for key in large}
        except (RuntimeError, FactorError, np.linalg.LinAlgError):
            return {}

    def _newest_roots(self, graph: SceneFactorGraph, keys: set[int]) -> dict[int, FloatArray]:
        """R of the variables of this epoch and of landmarks, from their joint covariance."""
        newest = [key for key in keys if graph.variable(key).epoch in (graph.epoch, None)]
        if not newest:
            return {}
        P = self.joint(newest)
        if P is None:
            P = marginal_moments(self.linear(), newest, "qr")[1]
        roots, start = {}, 0
        for key, dim in self.points.dims(newest).items():
            span = slice(start, start + dim)
            roots[key], start = _square_root_information(P[span, span]), span.stop
        return roots

    def _remove_factors(self, graph: SceneFactorGraph) -> list[int]:
        """Forget factors that have left; returns their indices."""
        removed: list[int] = []
        groups = graph.groups
        for number, slots in list(self.slots.items()):
            held = groups.get(number)
            if held is not None and held is self._held.get(number):
                continue
            if held is None:
                removed += slots[slots >= 0].tolist()
                del self.slots[number]
            elif (out := (slots >= 0) & ~held.active).any():
                removed += slots[out].tolist()
                self.slots[number] = np.where(out, -1, slots)
        for slot in [slot for slot, keys in self._hints.items() if not keys <= graph.variables.keys()]:
            removed.append(slot)
            del self._hints[slot]
        self._held, self._births = dict(groups), dict(graph.births)
        return removed

    def _relinearised(self, graph: SceneFactorGraph, threshold: float) -> bool:
        """Exchange the factors on variables that have moved; whether there were any."""
        moved = set(self.points.moved(self._delta, threshold))
        rows: list[tuple[int, IntArray]] = []
        linear: list[gtsam.JacobianFactor] = []
        removed: list[int] = []
        point = graph.point()
        for number in sorted({number for key in moved for number in graph.index.touching(key)}):
            held = graph.groups[number]
            if held.factors.linear:
                continue
            mine = np.array([r for r in held.rows.tolist() if not moved.isdisjoint(held.factors.rows[r])], dtype=int)
            if len(mine):
                rows.append((number, mine))
                linear += graph.linearised(held, mine, point)
                removed += self.slots[number][mine].tolist()
        if rows:
            self._update(graph, linear, rows, removed, {})
        return bool(rows)

    def _update(
        self,
        graph: SceneFactorGraph,
        linear: Sequence[gtsam.JacobianFactor],
        rows: Sequence[tuple[int, IntArray]],
        removed: list[int],
        new: Collection[int],
    ) -> None:
        """One update of iSAM2: `linear` in, which are `rows` of groups, `removed` out; and the graph is moved."""
        factors, values, base = gtsam.GaussianFactorGraph(), gtsam.Values(), graph.point().base
        for factor in linear:
            factors.push_back(factor)
        hinted = _hinted(graph, rows, set(new)) if self.in_time and new else []
        for keys in hinted:
            dims = [graph.variable(key).dim for key in keys]
            factors.push_back(native_factor(keys, dims, np.zeros((1, sum(dims) + 1), order="F")))
        for key in new:
            insert_state(values, graph.variable(key), graph.variable(key).type.read(base, key))
        # without a linearisation point: increments are those that iSAM2 counts, from the base
        added = gtsam.LinearContainerFactor.ConvertLinearGraph(factors)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = removed
        last = {*graph.carried_over.values(), *graph.newest} & graph.variables.keys()
        order, moved, groups = dict.fromkeys(last, 1), gtsam.KeyList(), gtsam.KeyGroupMap()
        if self.in_time:
            affected = set(self.isam.predictUpdateInfo(added, values, parameters)[0])
            order, again = self._eliminated_in_time(graph, last, affected, set(new))
            for key in again:
                moved.push_back(key)
            parameters.extraReelimKeys = moved
        for key, group in order.items():
            groups.insert2(key, group)
        parameters.constrainedKeys = groups
        try:
            result = self.isam.update(added, values, parameters)
            estimate, self._delta = self.isam.calculateEstimate(), self.isam.getDelta()
        except (RuntimeError, ValueError) as error:
            raise self._undetermined(graph, error) from error
        if not np.isfinite(self._delta.norm()):
            raise self._undetermined(graph, None)
        slots = list(result.getNewFactorsIndices())
        start = 0
        for number, mine in rows:
            self.slots[number][mine] = slots[start : start + len(mine)]
            start += len(mine)
        self._hints |= dict(zip(slots[start:], map(frozenset, hinted), strict=True))
        graph.moved_to(estimate)

    def _eliminated_in_time(
        self, graph: SceneFactorGraph, last: Set[int], affected: Set[int], new: Set[int]
    ) -> tuple[dict[int, int], Set[int]]:
        """Ranks of the variables that the next update eliminates, and those among them that it has to be told.

        The whole tree stays eliminated in the order of time: the update changes the `affected` cliques alone, whose
        variables are ranked without gaps, as iSAM2 asks. Where these are so many that iSAM2 may eliminate all
        variables instead, all are ranked. Those of all time, and `last`, come last.
        """
        times = {key: math.inf if key in last or one.time is None else one.time for key, one in graph.variables.items()}
        chosen: Set[int] = times.keys() & (affected | new)
        if not times.keys() - new <= self._times.keys() or len(chosen) > _MANY * len(times):
            chosen = times.keys()
        self._times = times
        rank = {time: k for k, time in enumerate(sorted({times[key] for key in chosen}))}
        return {key: rank[times[key]] for key in chosen}, chosen - new

    def _undetermined(self, graph: SceneFactorGraph, error: Exception | None) -> GraphError:
        point, linear = graph.point(), gtsam.GaussianFactorGraph()
        for number in graph.groups:
            for factor in graph.linear(number, point):
                linear.push_back(factor)
        return solver_error(graph.variables, graph.groups, singular_system(linear, error))


def _hinted(graph: SceneFactorGraph, rows: Sequence[tuple[int, IntArray]], new: Set[int]) -> list[list[int]]:
    """Variables to eliminate together: those of an interval that hang together, before it and after.

    Each of them is tied to one more of those after the interval, and GTSAM makes cliques of those alone whose
    separators are the same: n cliques, with a QR of all n states for each. A factor without information on all of them
    makes it one: a sixth of the time for 30 nodes, a tenth for 60.
    """
    label, together = graph.index.components(), dict[tuple[int, int], set[int]]()
    epoch = {key: -1 if one.epoch is None else one.epoch for key, one in graph.variables.items()}
    for number, mine in rows:
        keys_of = graph.groups[number].factors.rows
        for row in mine.tolist():
            if not new.isdisjoint(keys := keys_of[row]):
                together.setdefault((label[keys[0]], max(map(epoch.__getitem__, keys))), set()).update(keys)
    return [sorted(keys) for keys in together.values() if len(keys) > _FEW]


def _square_root_information(P: FloatArray) -> FloatArray:
    """R (d, d), P^-1 = R^T R. Raises `LinAlgError` where P is not positive definite."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(P)))


def _columns(dims: Mapping[int, int], keys: Iterable[int]) -> IntArray:
    """The columns of `keys` among those of variables of `dims`, which stand one after the other."""
    start = dict(zip(dims, itertools.accumulate(dims.values(), initial=0), strict=False))
    return np.array([column for key in keys for column in range(start[key], start[key] + dims[key])], dtype=np.int64)
