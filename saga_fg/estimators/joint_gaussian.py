"""The running graph as a joint Gaussian by components, and intervals that are carried out on it, P <- F P F^T + Q.

Interaction factors are information: noise without variance has none, and noise of variance Q between states of variance
P costs QR digits, Cholesky twice as many. Components with a node that would lose too many are predicted by covariances:
their posterior becomes one prior on their newest states. A node that stays as it is, x' = x, needs neither: it keeps
its variable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from factors import FactorError, joint_prior_factor
from factors.marginal import Elimination
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import Dynamics, noise_ratio, predict
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.partition import Partition, zeros
from saga_fg.graph.messages import solver_error, with_names
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

LARGEST_RATIO: dict[Elimination, float] = {"qr": 3e11, "cholesky": 1e6}
"""Variance predicted over process noise, up to which factors keep enough digits."""


def joint_gaussian(
    graph: SceneFactorGraph, covariance: Callable[[list[int]], FloatArray], layout: StateLayout, keys: Sequence[int]
) -> BlockGaussian:
    """The joint Gaussian of variables by components, whose ids in `layout` are those of nodes or their keys.

    Nodes with their states, other variables with increments from their base; covariance: joint one of some variables.
    Raises `GraphError` where they are not determined.
    """
    part = graph.components()
    partition = Partition(layout, renumbered(np.array([part[key] for key in keys], dtype=np.int64)))
    members: dict[int, list[int]] = {}
    for k, label in enumerate(partition.label.tolist()):
        members.setdefault(label, []).append(k)
    blocks, group, component = zeros(partition), partition.group.tolist(), partition.row.tolist()
    try:
        for its in members.values():
            blocks[group[its[0]]][component[its[0]]] = covariance([keys[k] for k in its])
    except FactorError as error:
        raise solver_error(graph.variables, graph.groups, error) from error
    point = graph.point()
    mean = [
        np.asarray(graph.state(key)) if node != key else point.increment(key)
        for node, key in zip(layout.nodes.tolist(), keys, strict=True)
    ]
    return BlockGaussian(partition, np.concatenate([np.empty(0), *mean]), blocks)


def merged(layout: StateLayout, *parts: BlockGaussian) -> BlockGaussian:
    """The joint Gaussian over `layout` of parts that are independent of each other, each in the order of the layout."""
    parts = tuple(part for part in parts if len(part.layout))
    if len(parts) == 1:
        return parts[0]
    label, mean, count = np.zeros(len(layout), dtype=np.int64), np.empty(layout.size), 0
    where = [layout.rows(part.layout.nodes) for part in parts]
    for part, rows in zip(parts, where, strict=True):
        label[rows] = count + part.partition.label
        mean[layout.places(rows)] = part.mean
        count += part.partition.count
    partition = Partition(layout, renumbered(label))
    blocks = zeros(partition)
    for part, rows in zip(parts, where, strict=True):
        its = np.unique(part.partition.label, return_index=True)[1]  # a node of each component
        group, row = part.partition.group[its], part.partition.row[its]
        for number, P in enumerate(part.blocks):
            mine = group == number
            there = rows[its[mine]]
            blocks[partition.group[there[0]]][partition.row[there]] = P[row[mine]]
    return BlockGaussian(partition, mean, blocks)


def renumbered(label: IntArray) -> IntArray:
    """Labels (n,) in the order in which they occur, from 0 without gaps."""
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[label]


def lossy(x: BlockGaussian, dynamics: Dynamics, still: BoolArray, elimination: Elimination) -> BoolArray:
    """(n,) nodes of components of which interaction factors would lose digits; still (n,): what keeps its variable."""
    label = dynamics.joined(x.partition).label
    ratio = np.full(len(still), np.inf)
    own = {d: np.zeros((len(still), d, d)) for d in np.unique(x.layout.dims).tolist()}
    for F in dynamics.F:
        if (mine := np.flatnonzero(F.target == F.source)).size:
            own[F.values.shape[1]][F.target[mine]] = F.values[mine]
    for Q in dynamics.Q:
        F_ii = own[Q.values.shape[1]][Q.target]
        ratio[Q.target] = noise_ratio(F_ii @ x.covariances(Q.target) @ np.swapaxes(F_ii, 1, 2) + Q.values, Q.values)
    return np.isin(label, label[(ratio > LARGEST_RATIO[elimination]) & ~still])


def by_covariance(x: BlockGaussian, dynamics: Dynamics, chosen: BoolArray) -> BlockGaussian:
    """The prediction of those components of `x` that have one of the first nodes, which are `chosen` (n,)."""
    label = dynamics.joined(x.partition).label
    mine = np.isin(label, label[: len(chosen)][chosen])
    return predict(x.without(np.flatnonzero(~mine)), dynamics.restricted(np.flatnonzero(mine)))


def replace_by_prior(
    graph: SceneFactorGraph, x: BlockGaussian, earlier: Mapping[int, int], now: Mapping[int, int]
) -> None:
    """Put the joint Gaussian `x` in the place of all that the graph holds of its components.

    Its variables by id, as they were and as they are now. Raises `InputError` where it has become singular.
    """
    label = graph.components()
    ids = x.layout.nodes.tolist()
    for number in range(x.partition.count):
        rows = np.flatnonzero(x.partition.label == number)
        keys = [now[ids[row]] for row in rows.tolist()]
        old = {label.get(earlier[ids[row]]) for row in rows.tolist()}
        leaving = [key for key, part in label.items() if part in old and key not in keys]
        mean = np.split(x.mean[x.layout.places(rows)], np.cumsum(x.layout.dims[rows])[:-1])
        base = graph.base
        increments = [m if key in ids else m - base.atVector(key) for key, m in zip(keys, mean, strict=True)]
        try:
            prior = joint_prior_factor(keys, increments, x.joint(rows))
        except FactorError as error:
            raise InputError(f"transition: {with_names(graph.variables, str(error), keys)}") from error
        graph.replace_by_prior(leaving, prior)
