"""Objects in the running graph: their factors, the providers of these, and the graph of what a filter knows.

    prior        || x_i - m ||_P                             `NewObjects`; one joint factor for a component at the start
    interaction  || x_i' - sum_j F_ij x_j - b_i ||_{Q_i}     `Interactions`, one n-ary factor a node and interval
    detection    || z - H x_i ||_R                           `DetectionFactors`, one a measurement

A node that nothing moves or disturbs, such as a pole, keeps the variable of the epoch before, since a direction without
noise has no factor.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import gtsam
import numpy as np

from factors import (
    FactorError,
    GaussianFactors,
    ResidualFactors,
    detection_factors,
    gaussian_factors,
    interaction_factor,
    interaction_factors,
    joint_prior_factor,
    prior_factors,
)
from saga_fg.errors import InputError
from saga_fg.estimators.filtering import Measured, Measurements, Observations
from saga_fg.estimators.interval_dynamics import IntervalDynamics
from saga_fg.estimators.partition import BlockGaussian, StateLayout
from saga_fg.graph import Additions, GraphView, NewVariable, SceneFactorGraph, node_key, node_kind
from saga_fg.model import Blocks, Transition
from saga_fg.numerics import BoolArray, FloatArray, IntArray

_SINGULAR = 1e-13  # share of the variances of axes below which a direction has none
Factors = list[gtsam.JacobianFactor | GaussianFactors | ResidualFactors]


def prior_graph(x: BlockGaussian, time: float) -> SceneFactorGraph:
    """The graph of what a filter knows at `time`, s: one joint prior for each component.

    Raises `InputError` where a covariance has become singular.
    """
    graph, names = SceneFactorGraph(), x.layout.nodes.tolist()
    graph.advance(time)
    states = np.split(x.mean, x.layout.offsets[1:-1]) if names else []
    keys = graph.add_variables("", [NewVariable(*node_kind(n), state) for n, state in zip(names, states, strict=True)])
    try:
        priors = list(component_priors(x, dict(zip(names, keys, strict=True))))
    except FactorError as error:
        raise InputError(f"graph: {error}") from error
    graph.add_factors("prior", priors)
    return graph


def component_priors(x: BlockGaussian, keys: Mapping[int, int]) -> Iterator[GaussianFactors | gtsam.JacobianFactor]:
    """One prior a component."""
    label, ids = x.partition.label, x.layout.nodes
    alone = np.bincount(label)[label] == 1
    for d in np.unique(x.layout.dims[alone]).tolist():
        rows = np.flatnonzero(alone & (x.layout.dims == d))
        names = [keys[node] for node in ids[rows].tolist()]
        yield prior_factors(names, x.mean[x.layout.spans(rows)], x.covariances(rows))
    for number in np.unique(label[~alone]).tolist():
        rows = np.flatnonzero(label == number)
        means = [x.mean[x.layout.offsets[row] : x.layout.offsets[row + 1]] for row in rows.tolist()]
        yield joint_prior_factor([keys[node] for node in ids[rows].tolist()], means, x.joint(rows))


def measurement_factors(keys: Mapping[int, int], measured: Measured) -> Factors:
    """Return the factors of measurements, native where they are linear; keys: of the variables by id."""
    names = np.array([keys[node] for node in measured.nodes.tolist()], dtype=np.uint64)
    if isinstance(measured, Observations):
        return [detection_factors(names, measured.model, measured.z, measured.R)]
    assert isinstance(measured, Measurements)
    told = measured.H.any(axis=(1, 2))
    return [gaussian_factors(names[told, None], [measured.H[told]], measured.z[told], measured.R[told])]


def interval_factors(
    interval: IntervalDynamics,
    layout: StateLayout,
    mean: FloatArray,
    keys: Mapping[int, int],
    next_keys: Mapping[int, int],
) -> tuple[list[gtsam.JacobianFactor | GaussianFactors], list[ResidualFactors]]:
    """Factors of an interval, native ones and those of nodes that move nonlinearly.

    mean: joint state to linearise at; keys: of the nodes before and after it. A node without one after it, or with the
    same one, has no factor.
    """
    dynamics = interval.linearised(layout, mean)
    now = np.array([keys.get(node, 0) for node in layout.nodes.tolist()], dtype=np.uint64)
    then = np.array([next_keys.get(node, 0) for node in layout.nodes.tolist()], dtype=np.uint64)
    noise: dict[int, FloatArray] = {}
    regular = np.zeros(len(layout), dtype=bool)  # native factors need noise in all directions
    for blocks in dynamics.Q:
        noise.update(zip(blocks.target.tolist(), blocks.values, strict=True))
        regular[blocks.target] = _is_regular(blocks.values)
    same = (now == then) | (then == 0)
    block_shapes = np.zeros(len(layout), dtype=np.int64)  # numbers of state sizes among the sources of a node
    for blocks in dynamics.F:
        block_shapes[np.unique(blocks.target)] += 1
    nonlinear: list[ResidualFactors] = []
    moves_nonlinearly = same.copy()
    for group, rows in interval.nonlinear_rows(layout):
        moves_nonlinearly[rows[:, 0]] = True
        nonlinear.append(group.factors(then[rows[:, 0]], now[rows]))
    together = regular & (block_shapes == 1) & ~moves_nonlinearly
    native: list[gtsam.JacobianFactor | GaussianFactors] = []
    for blocks in dynamics.F:
        mine = np.flatnonzero(together[blocks.target] & (now[blocks.source] > 0))
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
        sources = [(int(now[j]), F) for G in dynamics.F for j, F in _of_row(G, row) if now[j]]
        b = dynamics.b[layout.offsets[row] : layout.offsets[row + 1]]
        if not _is_regular(Q):
            raise FactorError(
                f"node {node}: expected process noise in all directions of its state, since edges act on it or it "
                "moves; without, its interaction is no factor (estimates need none)"
            )
        native.append(interaction_factor(int(then[row]), [key for key, _ in sources], [F for _, F in sources], b, Q))
    return native, nonlinear


def _is_regular(Q: FloatArray) -> BoolArray:
    """(...,) true where covariances (..., d, d), in units of their axes, have variance in all directions."""
    deviation = np.sqrt(np.diagonal(Q, axis1=-2, axis2=-1))
    scale = np.where(deviation > 0, deviation, 1.0)
    return np.asarray(np.linalg.eigvalsh(Q / scale[..., :, None] / scale[..., None, :])[..., 0] > _SINGULAR)


def _of_row(blocks: Blocks, row: int) -> list[tuple[int, FloatArray]]:
    """Source rows and blocks of one node."""
    mine = np.flatnonzero(blocks.target == row)
    return list(zip(blocks.source[mine].tolist(), blocks.values[mine], strict=True))


@dataclass(frozen=True, eq=False)
class NewObjects:
    """New objects, independent of all others: ids (k,), means (k, d), covariances (k, d, d); labels by id."""

    nodes: IntArray
    means: FloatArray
    covariances: FloatArray
    labels: Mapping[int, str] = field(default_factory=dict)
    name: str = "new objects"
    internal: ClassVar[bool] = True

    def factors(self, view: GraphView) -> Additions:
        ids = np.asarray(self.nodes).tolist()
        if not ids:
            return Additions()
        new = [
            NewVariable(*node_kind(i), mean, label=self.labels.get(i, ""))
            for i, mean in zip(ids, self.means, strict=True)
        ]
        keys = [node_key(i, view.epoch) for i in ids]
        return Additions(new, [prior_factors(keys, self.means, self.covariances)])


@dataclass(frozen=True, eq=False)
class Interactions:
    """Objects move by a transition over those that stay.

    earlier    by id, the keys of their variables, by default those of the epoch before; nodes of the transition that
               are not among them are no objects of the graph
    carried_over   ids of those whose variables stay as they are
    """

    transition: Transition
    earlier: Mapping[int, int] | None = None
    carried_over: Collection[int] = ()
    name: str = "interactions"
    internal: ClassVar[bool] = True

    def factors(self, view: GraphView) -> Additions:
        interval = IntervalDynamics(self.transition)
        nodes = self.transition.nodes.tolist()
        earlier = {node: node_key(node, view.epoch - 1) for node in nodes} if self.earlier is None else self.earlier
        if not earlier:
            return Additions()
        layout = StateLayout(nodes, self.transition.graph.dims)
        at, mean = layout.offsets.tolist(), np.zeros(layout.size)
        mine = [row for row, node in enumerate(nodes) if node in earlier]
        for row in mine:
            mean[at[row] : at[row + 1]] = view.state(earlier[nodes[row]])
        dynamics = interval.linearised(layout, mean)
        moved = dynamics.times(mean) + dynamics.b
        moving = [row for row in mine if nodes[row] not in self.carried_over]
        known = view.variables
        new = [
            NewVariable(*node_kind(n), moved[at[row] : at[row + 1]], label=known[earlier[n]].label)
            for row, n in zip(moving, (nodes[row] for row in moving), strict=True)
        ]
        then = {nodes[row]: node_key(nodes[row], view.epoch) for row in moving}
        native, nonlinear = interval_factors(interval, layout, mean, earlier, then)
        return Additions(new, named={(view.epoch,): [*native, *nonlinear]})


@dataclass(frozen=True, eq=False)
class DetectionFactors:
    """Measurements of objects; keys: of their variables by id, by default those of this epoch."""

    measured: Measured
    keys: Mapping[int, int] | None = None
    name: str = "detections"
    internal: ClassVar[bool] = True

    def factors(self, view: GraphView) -> Additions:
        now = self.keys or {node: node_key(node, view.epoch) for node in self.measured.nodes.tolist()}
        return Additions(factors=measurement_factors(now, self.measured))
