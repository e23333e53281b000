r"""Nonlinear dynamics of nodes over one interval: their own motion, and what accelerates them.

    x_i' = G_i phi_i(x_i, dt) + sum_j F_ij x_j + b_i + B sum_e rate_e tau_e a_e(x_i, x_e) + q_i,    q_i ~ N(0, Q_i)

F, b and Q are the transition's, which knows the linear edges and the linear part A_i of the own motion, and
G_i = F_ii exp(-A_i dt) is what the edges make of it; phi_i is the own motion alone, exp(A_i dt) x_i where it is linear;
B holds accelerations over the interval, dt^2 / 2 on positions and dt on velocities. Without edges that is the own
motion, exactly; where motion and edges are linear, the transition. Between, it errs as the transition does, by second
order in rates and turn rates times dt (Lie splitting).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from factors import ResidualFactors
from factors.validation import KeyArray
from saga_fg.errors import InputError
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.model.node import NodeType, NonlinearMotion
from saga_fg.model.nonlinear_interactions import AccelerationLaw, held
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray, checked


@dataclass(frozen=True, eq=False)
class Push:
    """Accelerations of some nodes of a flow by one neighbour each.

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
class Flow:
    """n nodes of one motion that listen to as many neighbours of the same kinds; see the module for the equation.

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
    pushes: tuple[Push, ...]

    def predict(self, states: Sequence[FloatArray]) -> FloatArray:
        """States (n, d) after the interval, of the states (n, d), (n, d_j), ... before it."""
        x = states[0] if self.own is None else self.own.flow(states[0], self.dt)
        moved = self.b + sum((_times(F, y) for F, y in zip((self.G, *self.F), (x, *states[1:]), strict=True)), 0.0)
        for push in self.pushes:
            a, _, _ = push.accelerations(states)
            np.add.at(moved, (push.at[:, None], push.pv), held(a[..., None], self.dt)[..., 0])
        return moved

    def jacobians(self, states: Sequence[FloatArray]) -> list[FloatArray]:
        """Derivatives (n, d, d), (n, d, d_j), ... of `predict`."""
        own = self.G.copy() if self.own is None else self.G @ self.own.flow_jacobian(states[0], self.dt)
        J = [own, *(F.copy() for F in self.F)]
        for push in self.pushes:
            _, by_own, by_other = push.accelerations(states)
            rows = push.at[:, None, None], push.pv[:, None]
            np.add.at(J[0], (*rows, push.pv), held(by_own, self.dt))
            np.add.at(J[push.slot], (*rows, push.other_pv), held(by_other, self.dt))
        return J

    def factors(self, next_keys: KeyArray, keys: KeyArray) -> ResidualFactors:
        """The factors of all nodes: next_keys (n,), keys (n, 1 + k)."""
        return ResidualFactors(
            rows=np.column_stack([next_keys, keys]),
            dims=(self.b.shape[1], self.b.shape[1], *(F.shape[2] for F in self.F)),
            residual=self._residual,
            covariances=self.Q,
            jacobians=self._residual_jacobians,
            name="interactions",
        )

    def _residual(self, later: FloatArray, *states: FloatArray) -> FloatArray:
        return later - self.predict(states)

    def _residual_jacobians(self, later: FloatArray, *states: FloatArray) -> list[FloatArray]:
        identity = np.broadcast_to(np.eye(later.shape[1]), self.G.shape)
        return [identity, *(-J for J in self.jacobians(states))]


def flows(transition: Transition) -> tuple[Flow, ...]:
    """The nonlinear dynamics of a transition: of nodes with such a motion, or that nonlinear edges act on."""
    graph, types = transition.graph, transition.graph.types
    acting = [group for group in graph.nonlinear if group.rate.any()]
    if transition.dt == 0 or not (acting or any(t.flow is not None for t in set(types))):
        return ()
    heard: dict[int, dict[int, FloatArray]] = {i: {} for i, t in enumerate(types) if t.flow is not None}
    for group in acting:
        heard.update({i: {} for i in group.target[group.rate > 0].tolist() if i not in heard})
    moved = np.isin(np.arange(len(types)), list(heard))
    for blocks in transition.F:
        for k in np.flatnonzero(moved[blocks.target]).tolist():
            heard[int(blocks.target[k])][int(blocks.source[k])] = blocks.values[k]
    for group in acting:
        for i, j in zip(group.target[group.rate > 0].tolist(), group.source[group.rate > 0].tolist(), strict=True):
            heard[i].setdefault(j, np.zeros((types[i].dim, types[j].dim)))
    alike: dict[tuple[object, ...], list[list[int]]] = {}
    for i, blocks_of in heard.items():
        others = sorted((types[j].components, j) for j in blocks_of if j != i)
        kind = id(types[i]), *(components for components, _ in others)
        alike.setdefault(kind, []).append([i, *(j for _, j in others)])
    Q = {i: noise for blocks in transition.Q for i, noise in zip(blocks.target.tolist(), blocks.values, strict=True)}
    return tuple(_flow(transition, np.array(rows), heard, Q) for rows in alike.values())


def _flow(
    transition: Transition, rows: IntArray, heard: dict[int, dict[int, FloatArray]], Q: dict[int, FloatArray]
) -> Flow:
    types, dt = transition.graph.types, transition.dt
    node_type: NodeType = types[rows[0, 0]]
    own, *others = (np.stack([heard[row[0]][row[k]] for row in rows.tolist()]) for k in range(rows.shape[1]))
    if node_type.flow is not None:
        own = own @ scipy.linalg.expm(-node_type.generator * dt)
    b = transition.b[transition.offsets[rows[:, 0]][:, None] + np.arange(node_type.dim)]
    place = np.full(len(types), -1)
    place[rows[:, 0]] = np.arange(len(rows))
    pushes = []
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
                pushes.append(Push(group.law, at[some], slot, weight, group.given[mine[some]], pv, other_pv))
    noise = np.stack([Q[i] for i in rows[:, 0].tolist()])
    return Flow(rows, dt, node_type.flow, own, tuple(others), b, noise, tuple(pushes))


def _times(F: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray((F @ x[:, :, None])[:, :, 0])
