"""In which order to eliminate a recording, chosen by what each would cost.

    time              epoch by epoch: a chain of dense joint states, carried out as filter and smoother
    colamd, metis     sparse elimination of all states at once, one variable a node and epoch, by GTSAM

Elimination in time costs the cube of a component's size at every epoch, whatever its graph. Where a component is a
long queue rather than a crowd, cutting it across space is cheaper by orders of magnitude; where everybody interacts
with everybody it is dearer. The sparse orders are eliminated symbolically, which tells the size of every clique (f
variables with s that remain: f^3/3 + f^2 s + f s^2 multiplications), and the seconds follow from speeds as measured.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

import gtsam
import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from saga_fg.estimators.epoch import Epoch
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.layout import Layout
from saga_fg.numerics.arrays import IntArray

log = logging.getLogger(__name__)

Order = Literal["time", "colamd", "metis"]

_SWEEP_SPEED, _SWEEP_CALLS = 3e10, 2e-3  # multiplications a second; seconds an epoch
_SWEEP_WORK = 8  # multiplications an epoch over the cube of a component's size, filter and smoother
_SPARSE_SPEED, _SPARSE_CALLS = 5e9, 1e-4  # multiplications a second; seconds a factor and clique
_SPARSE_WORK = 3  # over those of the elimination itself: covariances, and once more for the last digits
_WORTH_A_LOOK = 0.5  # seconds of elimination in time above which the others are looked at


def cheapest_order(epochs: Sequence[Epoch], layouts: Sequence[Layout]) -> Order:
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


def _seconds_in_time(epochs: Sequence[Epoch], layouts: Sequence[Layout]) -> float:
    """Of filter and smoother over components joined through all epochs."""
    nodes = np.unique(np.concatenate([layout.nodes for layout in layouts]))
    a, b = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for epoch in epochs:
        if isinstance(epoch.interval, IntervalDynamics):
            for target, source in _heard(epoch.interval):
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


def _heard(interval: IntervalDynamics) -> list[tuple[IntArray, IntArray]]:
    """Ids of nodes and of those they listen to."""
    nodes = interval.transition.nodes
    pairs = [(nodes[blocks.target], nodes[blocks.source]) for blocks in interval.transition.F]
    for group in interval.nonlinear:
        pairs += [(nodes[group.rows[:, 0]], nodes[others]) for others in group.rows.T[1:]]
    return pairs


def sparse_ordering(factors: Sequence[Sequence[int]], order: Order) -> gtsam.Ordering:
    """An ordering of all variables that factors, given by their keys, speak of."""
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


def _structure(epochs: Sequence[Epoch], layouts: Sequence[Layout]) -> tuple[list[list[int]], IntArray]:
    """Which states each interaction is about; keys count through the nodes of all epochs, whose sizes come with it."""
    first = np.concatenate([[0], np.cumsum([len(layout) for layout in layouts])]).tolist()
    factors: list[list[int]] = [[key] for key in range(first[1])]  # what was known before
    for k, epoch in enumerate(epochs[:-1]):
        here, there = layouts[k], layouts[k + 1]
        gone = set(epoch.gone)
        listens = {node: [first[k] + row] for row, node in enumerate(here.nodes.tolist()) if node not in gone}
        if isinstance(epoch.interval, IntervalDynamics):
            for targets, sources in _heard(epoch.interval):
                for target, source in zip(targets.tolist(), (first[k] + here.rows(sources)).tolist(), strict=True):
                    listens[target].append(source)
        rows = first[k + 1] + there.rows(list(listens))
        for row, heard in zip(rows.tolist(), listens.values(), strict=True):
            factors.append([row, *dict.fromkeys(heard)])
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
