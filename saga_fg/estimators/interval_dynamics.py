r"""The dynamics of one interval as an estimator records them: a transition, of which some nodes move nonlinearly.

    x_i' = G_i phi_i(x_i, dt) + sum_j F_ij x_j + b_i + B sum_e rate_e tau_e a_e(x_i, x_e) + q_i,    q_i ~ N(0, Q_i)

in place of the transition's own row for nodes whose types move nonlinearly or on which nonlinear edges act. F, b and Q
are the transition's, which has the linear edges and the linear part A_i of the own motion, and G_i = F_ii exp(-A_i dt)
is the effect of the edges on it; phi_i is the own motion alone, exp(A_i dt) x_i where it is linear; B integrates
accelerations over the interval, dt^2 / 2 on positions and dt on velocities. Without edges that is the own motion,
exactly; where motion and edges are linear, the transition. Between, it errs as the transition does, by second order in
rates and turn rates times dt (Lie splitting).

The frozen graph of the transition can be discretised again over parts of the interval, as late measurements need.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from factors import ResidualFactors
from factors.validation import KeyArray
from saga_fg.errors import InputError
from saga_fg.estimators.dynamics import Dynamics, identity
from saga_fg.estimators.layout import StateLayout
from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.motion import NodeType, NonlinearMotion
from saga_fg.model.nonlinear_interactions import AccelerationLaw, held
from saga_fg.model.transition import Blocks, Transition
from saga_fg.numerics.arrays import FloatArray, IntArray, checked


@dataclass(frozen=True, eq=False)
class IntervalDynamics:
    """The record of an interval. most: number of nodes beyond which components are not joined, see `FilterStep`."""

    transition: Transition
    most: int | None = None

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

    def check(self, layout: StateLayout) -> None:
        """Raise `InputError` or `UnknownNodeError` unless it is about exactly the nodes of `layout`, each once."""
        Dynamics.of(self.transition, layout)

    def split(self, dt: float) -> tuple[IntervalDynamics, IntervalDynamics]:
        """The first `dt` seconds of the interval and the rest, with the same edges."""
        graph = self.transition.graph
        first, rest = discretise(graph, dt), discretise(graph.after(dt), self.transition.dt - dt)
        return IntervalDynamics(first, self.most), IntervalDynamics(rest, self.most)

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
class ZeroInterval:
    """An interval of 0 s, between two epochs at the same time."""

    dt: float = 0.0
    linear: bool = True
    most: int | None = None

    def linearised(self, layout: StateLayout, mean: FloatArray) -> Dynamics:
        """The identity."""
        return Dynamics(layout, identity(layout, np.arange(len(layout))), np.zeros(len(mean)), ())


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
            dims=(self.b.shape[1], self.b.shape[1], *(F.shape[2] for F in self.F)),
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
                weight = group.rate[mine[some]] * group.law.time_constant
                accelerations.append(
                    AccelerationTerm(group.law, at[some], slot, weight, group.given[mine[some]], pv, other_pv)
                )
    noise = np.stack([Q[i] for i in rows[:, 0].tolist()])
    return NonlinearDynamics(rows, dt, node_type.flow, own, tuple(others), b, noise, tuple(accelerations))


def _times(F: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray((F @ x[:, :, None])[:, :, 0])
