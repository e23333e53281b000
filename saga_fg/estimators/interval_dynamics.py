"""The dynamics of one interval as estimators record them, and intervals carried out on a joint Gaussian.

The dynamics of one interval as an estimator records them: a transition, of which some nodes move nonlinearly.

    x_i' = G_i phi_i(x_i, dt) + sum_j F_ij x_j + b_i + B sum_e rate_e tau_e a_e(x_i, x_e) + q_i,    q_i ~ N(0, Q_i)

in place of the transition's own row for nodes whose types move nonlinearly or on which nonlinear edges act. F, b and Q
are the transition's, which has the linear edges and the linear part A_i of the own motion, and G_i = F_ii exp(-A_i dt)
is the effect of the edges on it; phi_i is the own motion alone, exp(A_i dt) x_i where it is linear; B integrates
accelerations over the interval, dt^2 / 2 on positions and dt on velocities. Without edges that is the own motion,
exactly; where motion and edges are linear, the transition. Between, it errs as the transition does, by second order in
rates and turn rates times dt (Lie splitting).

The frozen graph of the transition can be discretised again over parts of the interval, as late measurements need.

The running graph as a joint Gaussian by components, and intervals that are carried out on it, P <- F P F^T + Q.

Interaction factors are information: noise without variance has none, and noise of variance Q between states of variance
P costs QR digits, Cholesky twice as many. Components with a node that would lose too many are predicted by covariances:
their posterior becomes one prior on their newest states. A node that stays as it is, x' = x, needs neither: it keeps
its variable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from factors import FactorError, ResidualFactors, joint_prior_factor
from factors.gaussian import Elimination
from factors.validation import KeyArray
from saga_fg.errors import InputError
from saga_fg.estimators.filtering import Dynamics, noise_ratio, predict
from saga_fg.estimators.partition import BlockGaussian, Partition, StateLayout, zeros
from saga_fg.graph import SceneFactorGraph, solver_error, with_names
from saga_fg.model import (
    POSITION,
    VELOCITY,
    AccelerationLaw,
    Blocks,
    NodeType,
    NonlinearMotion,
    Transition,
    discretise,
    held,
)
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked


@dataclass(frozen=True, eq=False)
class IntervalDynamics:
    """The record of an interval."""

    transition: Transition

    @property
    def dt(self) -> float:
        """Seconds."""
        return self.transition.dt

    @property
    def linear(self) -> bool:
        """True where linearising it again elsewhere changes nothing."""
        return not self.nonlinear

    @cached_property
    def nonlinear(self) -> tuple[NonlinearDynamics, ...]:
        """The nonlinear dynamics of the transition's graph."""
        return nonlinear_dynamics(self.transition)

    def nonlinear_rows(self, layout: StateLayout) -> list[tuple[NonlinearDynamics, IntArray]]:
        """Nonlinear dynamics with their rows (n, 1 + k) of `layout`."""
        place = layout.rows(self.transition.nodes)
        return [(group, place[group.rows]) for group in self.nonlinear]

    def coupled(self, dynamics: Dynamics) -> BoolArray:
        """(n,) nodes of the linearised `dynamics` that the interval ties to others, or moves nonlinearly."""
        tied = np.zeros(len(dynamics.layout), dtype=bool)
        for F in dynamics.F:
            across = (F.target != F.source) & F.values.any(axis=(1, 2))
            tied[F.target[across]] = tied[F.source[across]] = True
        for _, rows in self.nonlinear_rows(dynamics.layout):
            tied[rows] = True
        return tied

    def split(self, dt: float) -> tuple[IntervalDynamics, IntervalDynamics]:
        """The first `dt` seconds of the interval and the rest, with the same edges."""
        graph = self.transition.graph
        first, rest = discretise(graph, dt), discretise(graph.after(dt), self.transition.dt - dt)
        return IntervalDynamics(first), IntervalDynamics(rest)

    def linearised(self, layout: StateLayout, mean: FloatArray) -> Dynamics:
        """The linear dynamics over the nodes of `layout`, nonlinear ones linearised at the joint state `mean`."""
        linear = Dynamics.of(self.transition, layout)
        if self.linear:
            return linear
        own = np.zeros(len(layout), dtype=bool)
        nonlinear = self.nonlinear_rows(layout)
        for _, rows in nonlinear:
            own[rows[:, 0]] = True
        F = []
        for blocks in linear.F:
            kept = ~own[blocks.target]
            F.append(Blocks(blocks.target[kept], blocks.source[kept], blocks.values[kept]))
        b = linear.b.copy()
        for group, rows in nonlinear:
            states = [mean[layout.spans(column)] for column in rows.T]
            J = group.jacobians(states)
            moved = group.predict(states)
            for block, x in zip(J, states, strict=True):
                moved = moved - (block @ x[:, :, None])[:, :, 0]
            b[layout.spans(rows[:, 0])] = moved
            F += [Blocks(rows[:, 0], column, block) for column, block in zip(rows.T, J, strict=True)]
        return Dynamics(layout, tuple(F), b, linear.Q)


@dataclass(frozen=True, eq=False)
class AccelerationTerm:
    """Accelerations of some nodes by one neighbour each.

    at (m,) which nodes; slot: which of their states is the neighbour's; weight (m,) rate tau; pv, other_pv: places of
    position and velocity in the two states, of the position alone for a neighbour without velocity
    """

    law: AccelerationLaw
    at: IntArray
    slot: int
    weight: FloatArray
    given: FloatArray
    pv: IntArray
    other_pv: IntArray

    def accelerations(self, states: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """a (m, 2) and its derivatives (m, 2, 4), (m, 2, 2 or 4)."""
        other = np.zeros((len(self.at), 4))
        other[:, : len(self.other_pv)] = states[self.slot][self.at][:, self.other_pv]
        what, m = f"law {type(self.law).__name__}", len(self.at)
        try:
            found = self.law.accelerations(states[0][self.at][:, self.pv], other, self.given)
            value = checked(f"{what}: accelerations", found[0], (m, 2))
            by_own, by_other = (checked(f"{what}: derivatives", by, (m, 2, 4)) for by in found[1:])
        except Exception as error:  # of a researcher's law: anything
            raise error if isinstance(error, InputError) else InputError(f"{what}: {error!r}") from error
        w = self.weight[:, None, None]
        return w[:, 0] * value, w * by_own, w * by_other[..., : len(self.other_pv)]


@dataclass(frozen=True, eq=False)
class NonlinearDynamics:
    """n nodes of one motion with as many neighbours of the same kinds; the module has the equation.

    rows (n, 1 + k) of the transition's nodes: the node, its neighbours; own: the motion where it is nonlinear, else
    G is F_ii; F: k blocks (n, d, d_j); b (n, d); Q (n, d, d)
    """

    rows: IntArray
    dt: float
    own: NonlinearMotion | None
    G: FloatArray
    F: tuple[FloatArray, ...]
    b: FloatArray
    Q: FloatArray
    accelerations: tuple[AccelerationTerm, ...]

    def predict(self, states: Sequence[FloatArray]) -> FloatArray:
        """States (n, d) after the interval, of the states (n, d), (n, d_j), ... before it."""
        x = states[0] if self.own is None else self.own.flow(states[0], self.dt)
        moved = self.b + sum((_times(F, y) for F, y in zip((self.G, *self.F), (x, *states[1:]), strict=True)), 0.0)
        for term in self.accelerations:
            a, _, _ = term.accelerations(states)
            np.add.at(moved, (term.at[:, None], term.pv), held(a[..., None], self.dt)[..., 0])
        return moved

    def jacobians(self, states: Sequence[FloatArray]) -> list[FloatArray]:
        """Derivatives (n, d, d), (n, d, d_j), ... of `predict`."""
        own = self.G.copy() if self.own is None else self.G @ self.own.flow_jacobian(states[0], self.dt)
        J = [own, *(F.copy() for F in self.F)]
        for term in self.accelerations:
            _, by_own, by_other = term.accelerations(states)
            rows = term.at[:, None, None], term.pv[:, None]
            np.add.at(J[0], (*rows, term.pv), held(by_own, self.dt))
            np.add.at(J[term.slot], (*rows, term.other_pv), held(by_other, self.dt))
        return J

    def factors(self, next_keys: KeyArray, keys: KeyArray) -> ResidualFactors:
        """The factors of all nodes: next_keys (n,), keys (n, 1 + k)."""
        return ResidualFactors(
            rows=np.column_stack([next_keys, keys]),
            variables=(self.b.shape[1], self.b.shape[1], *(F.shape[2] for F in self.F)),
            residual=self.residual,
            covariances=self.Q,
            jacobians=self.residual_jacobians,
            name="interactions",
        )

    def residual(self, later: FloatArray, *states: FloatArray) -> FloatArray:
        """States (n, d) after the interval less those that `predict` gives."""
        return later - self.predict(states)

    def residual_jacobians(self, later: FloatArray, *states: FloatArray) -> list[FloatArray]:
        """Derivatives of `residual` by each of them."""
        identity = np.broadcast_to(np.eye(later.shape[1]), self.G.shape)
        return [identity, *(-J for J in self.jacobians(states))]


def nonlinear_dynamics(transition: Transition) -> tuple[NonlinearDynamics, ...]:
    """The nonlinear dynamics of a transition: of nodes with such a motion, or that nonlinear edges act on."""
    graph, types = transition.graph, transition.graph.types
    acting = [group for group in graph.nonlinear if group.rate.any()]
    if transition.dt == 0 or not (acting or any(t.flow is not None for t in graph.kinds[0])):
        return ()
    sources: dict[int, dict[int, FloatArray]] = {i: {} for i, t in enumerate(types) if t.flow is not None}
    for group in acting:
        sources.update({i: {} for i in group.target[group.rate > 0].tolist() if i not in sources})
    moved = np.isin(np.arange(len(types)), list(sources))
    for blocks in transition.F:
        for k in np.flatnonzero(moved[blocks.target]).tolist():
            sources[int(blocks.target[k])][int(blocks.source[k])] = blocks.values[k]
    for group in acting:
        for i, j in zip(group.target[group.rate > 0].tolist(), group.source[group.rate > 0].tolist(), strict=True):
            sources[i].setdefault(j, np.zeros((types[i].dim, types[j].dim)))
    alike: dict[tuple[object, ...], list[list[int]]] = {}
    for i, blocks_of in sources.items():
        others = sorted((types[j].components, j) for j in blocks_of if j != i)
        kind = id(types[i]), *(components for components, _ in others)
        alike.setdefault(kind, []).append([i, *(j for _, j in others)])
    Q = {i: noise for blocks in transition.Q for i, noise in zip(blocks.target.tolist(), blocks.values, strict=True)}
    return tuple(_stacked_dynamics(transition, np.array(rows), sources, Q) for rows in alike.values())


def _stacked_dynamics(
    transition: Transition, rows: IntArray, sources: dict[int, dict[int, FloatArray]], Q: dict[int, FloatArray]
) -> NonlinearDynamics:
    types, dt = transition.graph.types, transition.dt
    node_type: NodeType = types[rows[0, 0]]
    own, *others = (np.stack([sources[row[0]][row[k]] for row in rows.tolist()]) for k in range(rows.shape[1]))
    if node_type.flow is not None:
        own = own @ scipy.linalg.expm(-node_type.generator * dt)
    b = transition.b[transition.offsets[rows[:, 0]][:, None] + np.arange(node_type.dim)]
    place = np.full(len(types), -1)
    place[rows[:, 0]] = np.arange(len(rows))
    accelerations = []
    for group in transition.graph.nonlinear:
        mine = np.flatnonzero((place[group.target] >= 0) & (group.rate > 0))
        at = place[group.target[mine]]
        for slot in range(1, rows.shape[1]):
            some = np.flatnonzero(rows[at, slot] == group.source[mine])
            if len(some):
                other = types[rows[0, slot]]
                pv = node_type.index(POSITION + VELOCITY)
                other_pv = other.index(POSITION + VELOCITY if other.has(VELOCITY) else POSITION)
                weight = group.rate[mine[some]]
                accelerations.append(
                    AccelerationTerm(group.law, at[some], slot, weight, group.given[mine[some]], pv, other_pv)
                )
    noise = np.stack([Q[i] for i in rows[:, 0].tolist()])
    return NonlinearDynamics(rows, dt, node_type.flow, own, tuple(others), b, noise, tuple(accelerations))


def _times(F: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray((F @ x[:, :, None])[:, :, 0])


LARGEST_RATIO: dict[Elimination, float] = {"qr": 3e11, "cholesky": 1e6}
"""Variance predicted over process noise, up to which factors keep enough digits."""


def joint_gaussian(
    graph: SceneFactorGraph, covariance: Callable[[list[int]], FloatArray], layout: StateLayout, keys: Sequence[int]
) -> BlockGaussian:
    """The joint Gaussian of variables by components, whose ids in `layout` are those of nodes or their keys.

    Nodes with their states, other variables with increments from their base; covariance: joint one of some variables.
    Raises `GraphError` where they are not determined.
    """
    part = graph.index.components()
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
    moving = x.without(np.flatnonzero(~mine))
    return predict(moving, dynamics.of_nodes(moving.layout))


def replace_by_prior(
    graph: SceneFactorGraph, x: BlockGaussian, earlier: Mapping[int, int], now: Mapping[int, int]
) -> None:
    """Put the joint Gaussian `x` in the place of all that the graph holds of its components.

    Its variables by id, as they were and as they are now. Raises `InputError` where it has become singular.
    """
    label = graph.index.components()
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


def with_noise(transition: Transition, rows: BoolArray) -> Transition:
    """Give some nodes (n,) noise of variance 1, so that their factors, which are not used, can be made."""
    Q = [
        replace(group, values=np.where(rows[group.target][:, None, None], np.eye(group.values.shape[1]), group.values))
        for group in transition.Q
    ]
    return replace(transition, Q=tuple(Q))
