"""The running graph as a joint Gaussian by components, and intervals that are carried out on it, P <- F P F^T + Q.

Interaction factors are information: noise without variance has none, and noise of variance Q between states of variance
P costs QR digits, Cholesky twice as many. Components with a node that would lose too many are predicted by covariances:
their posterior becomes one prior on their newest states. A node that stays as it is, x' = x, needs neither: it keeps
its variable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from factors import FactorError, joint_prior_factor
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import Dynamics, noise_ratio, predict
from saga_fg.estimators.filter_steps import predicted
from saga_fg.estimators.layout import StateLayout
from saga_fg.estimators.partition import Partition, zeros
from saga_fg.graph.messages import solver_error, with_names
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.numerics.arrays import BoolArray, FloatArray

_SMALL = 64  # size of the largest component that is eliminated by QR
_LIMIT = 1e8  # variance predicted over process noise, up to which factors keep enough digits
_LIMIT_WIDE = 1e6  # the same by Cholesky


def joint_gaussian(
    graph: SceneFactorGraph, covariance: Callable[[list[int]], FloatArray], layout: StateLayout, keys: Sequence[int]
) -> BlockGaussian:
    """The joint Gaussian of variables by components, whose ids in `layout` are those of nodes or their keys.

    Nodes with their states, other variables with increments from their base; covariance: joint one of some variables.
    Raises `GraphError` where they are not determined.
    """
    part = components(held.factors.rows[row] for held in graph.groups.values() for row in held.rows.tolist())
    _, own = np.unique([part[key] for key in keys], return_inverse=True)
    partition = Partition(layout, own.astype(np.int64))
    members: dict[int, list[int]] = {}
    for k, label in enumerate(own.tolist()):
        members.setdefault(label, []).append(k)
    blocks, group, component = zeros(partition), partition.group.tolist(), partition.row.tolist()
    try:
        for its in members.values():
            blocks[group[its[0]]][component[its[0]]] = covariance([keys[k] for k in its])
    except FactorError as error:
        raise solver_error(graph.variables, graph.groups, error) from error
    base = graph.base
    mean = [
        np.asarray(graph.state(key))
        if node != key
        else (v := graph.variable(key)).type.local(v.type.read(base, key), graph.state(key))
        for node, key in zip(layout.nodes.tolist(), keys, strict=True)
    ]
    return BlockGaussian(partition, np.concatenate([np.empty(0), *mean]), blocks)


def components(factors: Iterable[Sequence[int]]) -> dict[int, int]:
    """The component of every variable, by the keys of factors: what these tie together, directly or through others."""
    row: dict[int, int] = {}
    pairs = [(row.setdefault(keys[0], len(row)), row.setdefault(key, len(row))) for keys in factors for key in keys]
    a, b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    matrix = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=(len(row), len(row)))
    return dict(zip(row, connected_components(matrix, directed=False)[1].tolist(), strict=True))


def lossy(x: BlockGaussian, dynamics: Dynamics, still: BoolArray, window: bool) -> BoolArray:
    """(n,) nodes of components of which interaction factors would lose digits; still (n,): what keeps its variable.

    window: whether there is one to be lost, so that wide components are to keep their factors while that can be.
    """
    label, ratio = dynamics.joined(x.partition).label, noise_ratio(predicted(x, dynamics, None, False), dynamics)
    wide = np.bincount(label, weights=x.layout.dims)[label] > (np.inf if window else _SMALL)
    return np.isin(label, label[(ratio > np.where(wide, _LIMIT_WIDE, _LIMIT)) & ~still])


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
    label = components(held.factors.rows[row] for held in graph.groups.values() for row in held.rows.tolist())
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
