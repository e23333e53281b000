r"""Sparse elimination of a whole recording at once, in the order that would take least time.

    time              epoch by epoch: a chain of dense joint states, carried out as filter and smoother
    colamd, metis     sparse elimination of all states at once, one variable a node and epoch, by GTSAM

Elimination in time costs the cube of a component's size at every epoch, whatever its graph. Where a component is a
long queue rather than a crowd, cutting it across space is cheaper by orders of magnitude; where everybody interacts
with everybody it is dearer. The sparse orders are eliminated symbolically, which gives the size of every clique (f
variables with s that remain: f^3/3 + f^2 s + f s^2 multiplications), and the seconds follow from measured speeds.

GTSAM eliminates the linearised factors to a Bayes tree; means come by back substitution, covariances from the roots
down (`saga_fg.estimators.graph_window`). Linear problems are solved twice, the second time for the digits that the
first left; nonlinear and robust ones until steps are short.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import gtsam
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from factors import GaussianFactors, Linearisable, ResidualFactors, linearised, nonlinear_graph
from factors.gaussian import block_covariances
from saga_fg.estimators.backward import AndersonAcceleration, MarginalCovariances
from saga_fg.estimators.epoch import Epoch
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.object_factors import recording_factors
from saga_fg.estimators.partition import StateLayout
from saga_fg.estimators.recording import Recording
from saga_fg.numerics.arrays import FloatArray, IntArray

log = logging.getLogger(__name__)

Order = Literal["time", "colamd", "metis"]

_SHORT = 1e-8  # length of a step, in posterior standard deviations of all states together
_DIGITS = 1e-10  # share of a step that elimination may get wrong
_SWEEP_SPEED, _SWEEP_CALLS = 3e10, 2e-3  # multiplications a second; seconds an epoch
_SWEEP_WORK = 8  # multiplications an epoch over the cube of a component's size, filter and smoother
_SPARSE_SPEED, _SPARSE_CALLS = 5e9, 1e-4  # multiplications a second; seconds a factor and clique
_SPARSE_WORK = 3  # over those of the elimination itself: covariances, and once more for the last digits
_WORTH_A_LOOK = 0.5  # seconds of elimination in time above which the others are looked at


class NoSolution(Exception):  # noqa: N818 -- it is no error of the caller's
    """Elimination has too few digits for this recording."""


@dataclass(eq=False)
class SparseSolution:
    """Means of every epoch, and the tree from which covariances can be had."""

    means: list[FloatArray]
    keys: list[dict[int, int]]  # of each epoch's nodes
    dims: dict[int, int]
    tree: gtsam.GaussianBayesTree
    known: list[MarginalCovariances] | None = None

    @staticmethod
    def of(recording: Recording, order: Order, max_iterations: int) -> SparseSolution:
        """Raises `NoSolution`, `FactorError` or `GraphError` where it cannot be had in this order."""
        means = recording.rough_means()
        recorded = recording_factors(recording.prior, recording.epochs, recording.layouts, means)
        states, dims, start = dict[int, FloatArray](), dict[int, int](), gtsam.Values()
        for one, layout, mean in zip(recorded, recording.layouts, means, strict=True):
            states |= zip(one.keys.values(), np.split(mean, layout.offsets[1:-1]), strict=False)
        for key, state in states.items():
            start.insert(key, state)
            dims[key] = len(state)
        factors = [factor for one in recorded for kind in one.factors.values() for factor in kind]
        native = [factor for factor in factors if isinstance(factor, gtsam.JacobianFactor)]
        stacks = [factor for factor in factors if isinstance(factor, GaussianFactors)]
        linear = nonlinear_graph([*native, *(one for stack in stacks for one in stack.native())], dims)
        others = [factor for factor in factors if isinstance(factor, ResidualFactors)]
        values, tree = solved_tree(linear, others, start, order, max_iterations)
        keys = [one.keys for one in recorded]
        solved = [np.concatenate([np.empty(0), *(values.atVector(key) for key in own.values())]) for own in keys]
        return SparseSolution(solved, keys, dims, tree)

    def covariances(self, layouts: Sequence[StateLayout]) -> list[MarginalCovariances]:
        """Marginals of all nodes, by epoch."""
        if self.known is None:
            blocks = block_covariances(self.tree, self.dims)
            self.known = [
                MarginalCovariances.of(layout, partial(_blocks_of, blocks, keys, layout))
                for keys, layout in zip(self.keys, layouts, strict=True)
            ]
        return self.known


def _blocks_of(
    blocks: Mapping[int, FloatArray], keys: Mapping[int, int], layout: StateLayout, rows: IntArray
) -> FloatArray:
    return np.array([blocks[keys[node]] for node in layout.nodes[rows].tolist()])


def solved_tree(
    graph: gtsam.NonlinearFactorGraph,
    factors: Sequence[Linearisable],
    values: gtsam.Values,
    order: Order,
    max_iterations: int,
) -> tuple[gtsam.Values, gtsam.GaussianBayesTree]:
    """The minimum of the linear factors in `graph` and others, and the Bayes tree there. Raises `NoSolution`.

    Of a linear problem the first step should be all; what is left of it tells how many digits elimination has.
    """
    ordering, accelerated, linear_problem = None, AndersonAcceleration(), not factors
    first = length = np.inf
    for iteration in range(max_iterations):
        linear = linearised(graph, factors, values)
        ordering = ordering or _ordering(linear, order)
        try:
            tree = linear.eliminateMultifrontal(ordering)
        except RuntimeError as error:
            raise NoSolution(" ".join(str(error).split())[:200]) from error
        step = tree.optimize()
        length = float(np.sqrt(max(0.0, -linear.gradientAtZero().dot(step))))
        log.debug("iteration %d: step of %.3g standard deviations", iteration + 1, length)
        if not np.isfinite(length):
            raise NoSolution("a step is not finite")
        if iteration == 0:
            first = max(length, 1.0)
        elif iteration == 1 and linear_problem and length > _DIGITS * first:
            raise NoSolution(f"of a step of {first:.3g} standard deviations {length:.2g} were wrong")
        if length <= _SHORT and iteration > 0:
            return values.retract(step), tree
        values = values.retract(step) if linear_problem else _mixed(values, step, accelerated)
    raise NoSolution(f"no convergence in {max_iterations} iterations; the last step is {length:.2g} sigma")


def _mixed(values: gtsam.Values, step: gtsam.VectorValues, accelerated: AndersonAcceleration) -> gtsam.Values:
    """Next linearisation point."""
    keys = list(values.keys())
    sizes = [len(values.atVector(key)) for key in keys]
    x = np.concatenate([values.atVector(key) for key in keys])
    point = accelerated.next(x, x + step.vector(keys), np.ones(len(x)))
    mixed = gtsam.Values()
    for key, part in zip(keys, np.split(point, np.cumsum(sizes)[:-1]), strict=True):
        mixed.insert(key, part)
    return mixed


def cheapest_order(epochs: Sequence[Epoch], layouts: Sequence[StateLayout]) -> Order:
    """The order that would take least time."""
    estimates: dict[Order, float] = {"time": _seconds_in_time(epochs, layouts)}
    if estimates["time"] > _WORTH_A_LOOK:
        factors, dims = _structure(epochs, layouts)
        graph = _symbolic(factors)
        sparse: tuple[Order, ...] = ("colamd", "metis")
        for name in sparse:
            work, cliques = _work(graph.eliminateMultifrontal(sparse_ordering(factors, name)), dims)
            calls = _SPARSE_CALLS * (len(factors) + cliques)
            estimates[name] = calls + _SPARSE_WORK * work / _SPARSE_SPEED
    log.debug("seconds by order of elimination: %s", {name: round(s, 3) for name, s in estimates.items()})
    return min(estimates, key=lambda name: estimates[name])


def _seconds_in_time(epochs: Sequence[Epoch], layouts: Sequence[StateLayout]) -> float:
    """Seconds of filter and smoother over components joined through all epochs."""
    nodes = np.unique(np.concatenate([layout.nodes for layout in layouts]))
    a, b = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for epoch in epochs:
        if isinstance(epoch.interval, IntervalDynamics):
            for target, source in _acting_pairs(epoch.interval):
                a.append(np.searchsorted(nodes, target))
                b.append(np.searchsorted(nodes, source))
    i, j = np.concatenate(a), np.concatenate(b)
    pairs = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), shape=(len(nodes), len(nodes)))
    label = connected_components(pairs, directed=False)[1]
    work = 0.0
    for layout in layouts:
        sizes = np.bincount(label[np.searchsorted(nodes, layout.nodes)], weights=layout.dims)
        work += _SWEEP_WORK * float((sizes**3).sum())
    return _SWEEP_CALLS * len(epochs) + work / _SWEEP_SPEED


def _acting_pairs(interval: IntervalDynamics) -> list[tuple[IntArray, IntArray]]:
    """Ids of nodes and of those that act on them."""
    nodes = interval.transition.nodes
    pairs = [(nodes[blocks.target], nodes[blocks.source]) for blocks in interval.transition.F]
    for group in interval.nonlinear:
        pairs += [(nodes[group.rows[:, 0]], nodes[others]) for others in group.rows.T[1:]]
    return pairs


def sparse_ordering(factors: Sequence[Sequence[int]], order: Order) -> gtsam.Ordering:
    """An ordering of all variables that factors, given by their keys, are on."""
    if order == "colamd":
        return gtsam.Ordering.ColamdSymbolicFactorGraph(_symbolic(factors))
    tied = [keys for keys in factors if len(keys) > 1]
    together = {key for keys in tied for key in keys}
    ordering = gtsam.Ordering()
    for key in dict.fromkeys(key for keys in factors for key in keys if key not in together):
        ordering.push_back(key)  # METIS ends the interpreter over variables without neighbours
    if tied:
        cut = gtsam.Ordering.MetisSymbolicFactorGraph(_symbolic(tied))
        for k in range(cut.size()):
            ordering.push_back(cut.at(k))
    return ordering


def _symbolic(factors: Sequence[Sequence[int]]) -> gtsam.SymbolicFactorGraph:
    graph = gtsam.SymbolicFactorGraph()
    for keys in factors:
        graph.push_back(gtsam.SymbolicFactor.FromKeys(keys))
    return graph


def _structure(epochs: Sequence[Epoch], layouts: Sequence[StateLayout]) -> tuple[list[list[int]], IntArray]:
    """Keys of the states of each interaction, counted through the nodes of all epochs; and their sizes."""
    first = np.concatenate([[0], np.cumsum([len(layout) for layout in layouts])]).tolist()
    factors: list[list[int]] = [[key] for key in range(first[1])]  # what was known before
    for k, epoch in enumerate(epochs[:-1]):
        here, there = layouts[k], layouts[k + 1]
        leaving = set(epoch.leaving)
        listens = {node: [first[k] + row] for row, node in enumerate(here.nodes.tolist()) if node not in leaving}
        if isinstance(epoch.interval, IntervalDynamics):
            for targets, sources in _acting_pairs(epoch.interval):
                for target, source in zip(targets.tolist(), (first[k] + here.rows(sources)).tolist(), strict=True):
                    listens[target].append(source)
        rows = first[k + 1] + there.rows(list(listens))
        for row, acting in zip(rows.tolist(), listens.values(), strict=True):
            factors.append([row, *dict.fromkeys(acting)])
    return factors, np.concatenate([layout.dims for layout in layouts])


def _work(tree: gtsam.SymbolicBayesTree, dims: IntArray) -> tuple[float, int]:
    """Multiplications of the elimination, and the number of cliques."""
    work, cliques, open_cliques = 0.0, 0, list(tree.roots())
    while open_cliques:
        clique = open_cliques.pop()
        conditional = clique.conditional()
        sizes, count = dims[conditional.keys()], conditional.nrFrontals()
        f, s = float(sizes[:count].sum()), float(sizes[count:].sum())
        work += f**3 / 3 + f * f * s + f * s * s
        cliques += 1
        open_cliques += [clique[k] for k in range(clique.nrChildren())]
    return work, cliques


def _ordering(linear: gtsam.GaussianFactorGraph, order: Order) -> gtsam.Ordering:
    return sparse_ordering([linear.at(i).keys() for i in range(linear.size())], order)
