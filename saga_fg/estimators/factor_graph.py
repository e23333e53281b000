"""The factors of a recording, and the running graph that they make: the equivalent problem, for anybody's solver.

    prior        one joint factor for each component of what was known before; one factor for each node that appears
    interaction  || x_i' - sum_j F_ij x_j - b_i ||_{Q_i}, one n-ary factor a node and interval
    detection    one factor a measurement

Every node has a variable of its own at every epoch, but for one that nothing moves or disturbs, such as a pole: it
keeps the variable of the epoch before, since a direction without noise has no factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from factors import (
    FactorError,
    ResidualFactors,
    detection_factors,
    gaussian_factors,
    interaction_factor,
    interaction_factors,
    joint_prior_factor,
    prior_factors,
)
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.epoch import Epoch
from saga_fg.estimators.interval_dynamics import IntervalDynamics, ZeroInterval
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.measurements import RecordedMeasurements
from saga_fg.estimators.protocol import Measurements
from saga_fg.graph.keys import node_key, node_kind
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import NewVariable
from saga_fg.model.transition import Blocks
from saga_fg.numerics.arrays import BoolArray, FloatArray

_SINGULAR = 1e-13  # share of the variances of axes below which a direction has none
Factors = list[gtsam.JacobianFactor | ResidualFactors]


@dataclass(frozen=True, eq=False)
class EpochFactors:
    """keys: of the variable of each node at an epoch; factors that come in with it, by what they are."""

    keys: dict[int, int]
    factors: dict[str, Factors]


def prior_graph(x: BlockGaussian, time: float) -> SceneFactorGraph:
    """The graph of what a filter knows at `time`, s: one joint prior for each component."""
    return recording_graph(x, [Epoch(time)], [x.layout], [x.mean])


def recording_graph(
    prior: BlockGaussian, epochs: Sequence[Epoch], layouts: Sequence[Layout], means: Sequence[FloatArray]
) -> SceneFactorGraph:
    """The graph of `epochs` after `prior`; layouts and smoothed means of each epoch's joint state.

    Raises `InputError` where a covariance has become singular, so that no factor can be made of it.
    """
    try:
        recorded = recording_factors(prior, epochs, layouts, means)
    except FactorError as error:
        raise InputError(f"graph: {error}") from error
    graph = SceneFactorGraph()
    for epoch, layout, mean, one in zip(epochs, layouts, means, recorded, strict=True):
        graph.advance(max(epoch.time, float(np.nextafter(graph.time, np.inf))))  # two may be at the same time
        new = [
            NewVariable(*node_kind(node), mean[layout.offsets[row] : layout.offsets[row + 1]])
            for row, node in enumerate(layout.nodes.tolist())
            if one.keys[node] not in graph.variables
        ]
        graph.add_variables("recording", new)
        for name, factors in one.factors.items():
            graph.add_factors(name, factors)
    return graph


def recording_factors(
    prior: BlockGaussian, epochs: Sequence[Epoch], layouts: Sequence[Layout], means: Sequence[FloatArray]
) -> list[EpochFactors]:
    """The factors epoch by epoch, nonlinear ones and noise at the means. Raises `FactorError`, as the graph."""
    result: list[EpochFactors] = []
    keys: dict[int, int] = {}  # of nodes that have a variable already
    moved: Factors = []
    for k, (epoch, layout) in enumerate(zip(epochs, layouts, strict=True)):
        keys = {node: keys.get(node) or node_key(node, k) for node in layout.nodes.tolist()}
        seen = [_detections(keys, recorded, layout, means[k]) for recorded in epoch.measurements]
        factors: dict[str, Factors] = {
            "interactions": moved,
            "prior": _prior_factors(prior, keys) if k == 0 and len(prior.layout) else [],
            "births": [
                factor
                for birth in epoch.births
                for factor in prior_factors([keys[n] for n in birth.nodes.tolist()], birth.means, birth.covariances)
            ],
            "detections": [factor for one in seen for factor in one],
        }
        result.append(EpochFactors(keys, factors))
        if epoch.interval is not None:
            gone = layout.rows(epoch.gone)
            stay = layout.without(gone) if len(gone) else layout
            at = means[k][layout.places(layout.rows(stay.nodes))]
            resting = stay.nodes[epoch.interval.linearised(stay, at).still].tolist()
            now, keys = keys, {node: keys[node] for node in resting}
            then = {node: node_key(node, k + 1) for node in stay.nodes.tolist()} | keys
            native, nonlinear = interval_factors(epoch.interval, stay, at, now, then)
            moved = [*native, *nonlinear]
    return result


def _prior_factors(x: BlockGaussian, keys: dict[int, int]) -> Factors:
    """One joint factor a component."""
    factors: Factors = []
    for label in range(x.partition.count):
        rows = np.flatnonzero(x.partition.label == label)
        means = [x.mean[x.layout.places(rows[k : k + 1])] for k in range(len(rows))]
        names = [keys[node] for node in x.layout.nodes[rows].tolist()]
        factors.append(joint_prior_factor(names, means, x.joint(rows)))
    return factors


def _detections(keys: dict[int, int], recorded: RecordedMeasurements, layout: Layout, mean: FloatArray) -> Factors:
    """Native factors where measurements are linear; a weight of zero leaves nothing to say."""
    measured = recorded.measured
    names = np.array([[keys[node]] for node in measured.nodes.tolist()], dtype=np.uint64).reshape(-1, 1)
    if recorded.loss is None and isinstance(measured, Measurements):
        _, z, H, R = recorded.linearised(layout, mean)
        heard = np.flatnonzero(H.any(axis=(1, 2)))
        return list(gaussian_factors(names[heard], [H[heard]], z[heard], R[heard]))
    weights = np.ones(len(names)) if recorded.weights is None else recorded.weights
    heard = np.flatnonzero(weights > 0)
    names, z, R = names[heard], measured.z[heard], measured.R[heard] / weights[heard, None, None]
    if not isinstance(measured, Measurements):
        return [detection_factors(names[:, 0], measured.model, z, R, recorded.loss)]
    H = measured.H[heard]
    residual, jacobian = partial(_linear_residual, H, z), partial(_linear_jacobian, H)
    return [ResidualFactors(names, (H.shape[2],), residual, R, jacobian, recorded.loss, name="robust detections")]


def _linear_residual(H: FloatArray, z: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray((H @ x[:, :, None])[:, :, 0] - z)


def _linear_jacobian(H: FloatArray, x: FloatArray) -> list[FloatArray]:
    return [H]


def interval_factors(
    interval: IntervalDynamics | ZeroInterval,
    layout: Layout,
    mean: FloatArray,
    keys: dict[int, int],
    next_keys: dict[int, int],
) -> tuple[list[gtsam.JacobianFactor], list[ResidualFactors]]:
    """Factors of an interval, native ones and those of nodes that move nonlinearly."""
    dynamics = interval.linearised(layout, mean)
    now = np.array([keys[node] for node in layout.nodes.tolist()], dtype=np.uint64)
    then = np.array([next_keys[node] for node in layout.nodes.tolist()], dtype=np.uint64)
    noise: dict[int, FloatArray] = {}
    regular = np.zeros(len(layout), dtype=bool)  # native factors need noise in all directions
    for blocks in dynamics.Q:
        noise.update(zip(blocks.target.tolist(), blocks.values, strict=True))
        regular[blocks.target] = _is_regular(blocks.values)
    same = now == then  # of who rests
    kinds = np.zeros(len(layout), dtype=np.int64)  # sizes of the states that a node listens to
    for blocks in dynamics.F:
        kinds[np.unique(blocks.target)] += 1
    nonlinear: list[ResidualFactors] = []
    moves_nonlinearly = same.copy()
    for group, rows in interval.nonlinear_rows(layout) if isinstance(interval, IntervalDynamics) else ():
        moves_nonlinearly[rows[:, 0]] = True
        nonlinear.append(group.factors(then[rows[:, 0]], now[rows]))
    together = regular & (kinds == 1) & ~moves_nonlinearly
    native: list[gtsam.JacobianFactor] = []
    for blocks in dynamics.F:
        mine = np.flatnonzero(together[blocks.target])
        mine = mine[np.argsort(blocks.target[mine], kind="stable")]
        rows, first = np.unique(blocks.target[mine], return_index=True)
        if len(rows):
            b = dynamics.b[layout.spans(rows)]
            Q = np.stack([noise[row] for row in rows.tolist()])
            names, indptr = now[blocks.source[mine]], np.append(first, len(mine))
            native += interaction_factors(then[rows], names, indptr, blocks.values[mine], b, Q)
    for row in np.flatnonzero(~together & ~moves_nonlinearly).tolist():
        d, node = int(layout.dims[row]), int(layout.nodes[row])
        Q = noise.get(row, np.zeros((d, d)))
        heard = [(int(now[j]), F) for G in dynamics.F for j, F in _of_row(G, row)]
        b = dynamics.b[layout.offsets[row] : layout.offsets[row + 1]]
        if not _is_regular(Q):
            raise FactorError(f"node {node}: expected noise in all directions of its state")
        native.append(interaction_factor(int(then[row]), [key for key, _ in heard], [F for _, F in heard], b, Q))
    return native, nonlinear


def _is_regular(Q: FloatArray) -> BoolArray:
    """Which of the covariances (..., d, d) have variance in all directions, in units in which those of axes are 1."""
    deviation = np.sqrt(np.diagonal(Q, axis1=-2, axis2=-1))
    scale = np.where(deviation > 0, deviation, 1.0)
    return np.asarray(np.linalg.eigvalsh(Q / scale[..., :, None] / scale[..., None, :])[..., 0] > _SINGULAR)


def _of_row(blocks: Blocks, row: int) -> list[tuple[int, FloatArray]]:
    """Source rows and blocks of one node."""
    mine = np.flatnonzero(blocks.target == row)
    return list(zip(blocks.source[mine].tolist(), blocks.values[mine], strict=True))
