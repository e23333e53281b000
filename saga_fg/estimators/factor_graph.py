"""A recording as a GTSAM factor graph: the equivalent problem, for GTSAM's own solvers and for anybody's factors.

    prior        one joint factor for each component of what was known before; one factor for each node that appears
    interaction  one n-ary factor a node and interval
    detection    one factor a measurement

Every node has a variable of its own at every moment. Linear factors are native (`gtsam.LinearContainerFactor` about
zero); nonlinear and robust ones are `gtsam.CustomFactor`s. Directions of an interval's noise without variance are hard
constraints (`gtsam.noiseModel.Constrained`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from factors import (
    FactorError,
    ResidualFactor,
    ResidualFactors,
    Vector,
    detection_factor,
    gaussian_factors,
    interaction_factor,
    interaction_factors,
    joint_prior_factor,
    nonlinear_graph,
    prior_factors,
)
from saga_fg.arrays import BoolArray, FloatArray
from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.moment import Moment
from saga_fg.estimators.motion import Motion, NodeMotion, Standstill
from saga_fg.estimators.protocol import Measurements
from saga_fg.estimators.sighting import Sighting
from saga_fg.transition import Blocks

_SINGULAR = 1e-13  # share of the variances of axes below which a direction has none


@dataclass(frozen=True, eq=False)
class FactorGraph:
    """graph; values: the estimator's answer, the minimum of the graph; keys: for each moment, the key of each node."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    keys: tuple[dict[int, int], ...]


def prior_graph(x: BlockGaussian) -> FactorGraph:
    """The graph of what a filter knows: one joint prior for each component."""
    return recording_graph(x, [Moment(0.0)], [x.layout], [x.mean])


def recording_graph(
    prior: BlockGaussian, moments: Sequence[Moment], layouts: Sequence[Layout], means: Sequence[FloatArray]
) -> FactorGraph:
    """The graph of `moments` after `prior`; layouts and smoothed means of each moment's joint state.

    Raises `InputError` where a covariance has become singular, so that no factor can be made of it.
    """
    try:
        return _recording_graph(prior, moments, layouts, means)
    except FactorError as error:
        raise InputError(f"graph: {error}") from error


def _recording_graph(
    prior: BlockGaussian, moments: Sequence[Moment], layouts: Sequence[Layout], means: Sequence[FloatArray]
) -> FactorGraph:
    keys: list[dict[int, int]] = []
    dims: dict[int, int] = {}
    values = gtsam.Values()
    for layout, mean in zip(layouts, means, strict=True):
        own = {}
        for row, node in enumerate(layout.nodes.tolist()):
            key = own[node] = gtsam.symbol("x", len(dims))
            dims[key] = int(layout.dims[row])
            values.insert(key, mean[layout.offsets[row] : layout.offsets[row + 1]])
        keys.append(own)
    linear = _prior_factors(prior, keys[0]) if len(prior.layout) else []
    graph = gtsam.NonlinearFactorGraph()
    for k, (moment, layout) in enumerate(zip(moments, layouts, strict=True)):
        for birth in moment.births:
            linear += prior_factors([keys[k][node] for node in birth.nodes.tolist()], birth.means, birth.covariances)
        for sighting in moment.sightings:
            seen = [keys[k][node] for node in sighting.measured.nodes.tolist()]
            if sighting.loss is None and isinstance(sighting.measured, Measurements):
                linear += _detection_factors(seen, sighting, layout, means[k])
            else:
                for factor in _nonlinear_detections(seen, sighting):
                    graph.add(factor.as_custom_factor())
        if moment.motion is not None:
            gone = layout.rows(moment.gone)
            stay = layout.without(gone) if len(gone) else layout
            at = means[k][layout.places(layout.rows(stay.nodes))]
            native, nonlinear = motion_factors(moment.motion, stay, at, keys[k], keys[k + 1])
            linear += native
            for one in nonlinear:
                singles = one.singles() if isinstance(one, ResidualFactors) else [one]
                for single in singles:
                    graph.add(single.as_custom_factor())
    graph.push_back(nonlinear_graph(linear, dims))
    return FactorGraph(graph, values, tuple(keys))


def _prior_factors(x: BlockGaussian, keys: dict[int, int]) -> list[gtsam.JacobianFactor]:
    """One joint factor a component."""
    factors = []
    for label in range(x.partition.count):
        rows = np.flatnonzero(x.partition.label == label)
        means = [x.mean[x.layout.places(rows[k : k + 1])] for k in range(len(rows))]
        names = [keys[node] for node in x.layout.nodes[rows].tolist()]
        factors.append(joint_prior_factor(names, means, x.joint(rows)))
    return factors


def _detection_factors(
    keys: list[int], sighting: Sighting, layout: Layout, mean: FloatArray
) -> list[gtsam.JacobianFactor]:
    """Native factors of linear measurements, one each."""
    _, z, H, R = sighting.linearised(layout, mean)
    seen = np.flatnonzero(H.any(axis=(1, 2)))  # a weight of zero leaves nothing to say
    return gaussian_factors(np.array(keys, dtype=np.uint64)[seen, None], [H[seen]], z[seen], R[seen])


def _nonlinear_detections(keys: list[int], sighting: Sighting) -> list[ResidualFactor]:
    measured, robust = sighting.measured, sighting.loss
    weights = np.ones(len(keys)) if sighting.weights is None else sighting.weights
    factors = []
    for k in np.flatnonzero(weights > 0).tolist():
        z, R = measured.z[k], measured.R[k] / weights[k]
        if isinstance(measured, Measurements):
            H = measured.H[k]
            residual, jacobians = partial(_linear_residual, H, z), partial(_linear_jacobian, H)
            factors.append(ResidualFactor((keys[k],), (Vector(H.shape[1]),), residual, R, jacobians, robust))
        else:
            factors.append(detection_factor(keys[k], measured.model, z, R, robust))
    return factors


def _linear_residual(H: FloatArray, z: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray(H @ x - z)


def _linear_jacobian(H: FloatArray, x: FloatArray) -> list[FloatArray]:
    return [H]


def motion_factors(
    motion: Motion | Standstill, layout: Layout, mean: FloatArray, keys: dict[int, int], next_keys: dict[int, int]
) -> tuple[list[gtsam.JacobianFactor], list[ResidualFactor | ResidualFactors]]:
    """Factors of an interval, native ones and those of nodes that move nonlinearly."""
    dynamics = motion.dynamics(layout, mean)
    special = {m.node: m for m in motion.nonlinear} if isinstance(motion, Motion) else {}
    now = np.array([keys[node] for node in layout.nodes.tolist()], dtype=np.uint64)
    then = np.array([next_keys[node] for node in layout.nodes.tolist()], dtype=np.uint64)
    noise: dict[int, FloatArray] = {}
    regular = np.zeros(len(layout), dtype=bool)  # native factors need noise in all directions
    for blocks in dynamics.Q:
        noise.update(zip(blocks.target.tolist(), blocks.values, strict=True))
        regular[blocks.target] = _is_regular(blocks.values)
    regular[layout.rows(list(special))] = False
    kinds = np.zeros(len(layout), dtype=np.int64)  # sizes of the states that a node listens to
    for blocks in dynamics.F:
        kinds[np.unique(blocks.target)] += 1
    nonlinear: list[ResidualFactor | ResidualFactors] = []
    flowing = np.zeros(len(layout), dtype=bool)
    for flow, rows in motion.flows_of(layout) if isinstance(motion, Motion) else ():
        flowing[rows[:, 0]] = True
        nonlinear.append(flow.factors(then[rows[:, 0]], now[rows]))
    together = regular & (kinds == 1) & ~flowing
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
    for row in np.flatnonzero(~together & ~flowing).tolist():
        d, node = int(layout.dims[row]), int(layout.nodes[row])
        Q = noise.get(row, np.zeros((d, d)))
        if node in special:
            nonlinear.append(_nonlinear_motion(special[node], keys, next_keys, layout, motion.dt, Q))
            continue
        heard = [(int(now[j]), F) for G in dynamics.F for j, F in _of_row(G, row)]
        b = dynamics.b[layout.offsets[row] : layout.offsets[row + 1]]
        native.append(_interaction_factor(int(then[row]), [key for key, _ in heard], [F for _, F in heard], b, Q))
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


def _nonlinear_motion(
    motion: NodeMotion, keys: dict[int, int], next_keys: dict[int, int], layout: Layout, dt: float, Q: FloatArray
) -> ResidualFactor:
    dims = layout.dims[layout.rows([motion.node, *motion.neighbours])].tolist()
    neighbours = [keys[other] for other in motion.neighbours]
    return motion.interaction.factor(next_keys[motion.node], keys[motion.node], neighbours, dims, dt, Q)


def _interaction_factor(
    next_key: int, keys: list[int], F: list[FloatArray], b: FloatArray, Q: FloatArray
) -> gtsam.JacobianFactor:
    """|| x' - sum_j F_j x_j - b ||_Q, with hard constraints where Q has no variance."""
    if _is_regular(Q):
        return interaction_factor(next_key, keys, F, b, Q)
    variances, directions = np.linalg.eigh(Q)
    sigmas = np.sqrt(np.where(variances > _SINGULAR * variances[-1], variances, 0.0))
    terms = [(next_key, directions.T), *((key, -directions.T @ block) for key, block in zip(keys, F, strict=True))]
    model = gtsam.noiseModel.Constrained.MixedSigmas(1.0, sigmas)
    factor = gtsam.GaussianConditional(terms, 0, directions.T @ b, model).clone()
    assert isinstance(factor, gtsam.JacobianFactor)
    return factor
