r"""The dynamics of one interval as an estimator records them: a transition, and nodes that move nonlinearly.

    x_i(t+dt) = f( x_i(t), [x_j(t)], dt ) + q_i,   q_i ~ N(0, Q_i(dt))         for the nodes with an interaction f

in place of the transition's own row; Q_i is the transition's. These are nodes whose types move nonlinearly or that
nonlinear edges of the transition's graph act on (`saga_fg.estimators.flow`), and those of functions given by hand
(`NodeMotion`). The frozen graph of the transition can be discretised again over parts of the interval, and so can f,
which is what a late measurement needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factors import FactorError, NonlinearInteraction
from saga_fg.arrays import FloatArray, IntArray
from saga_fg.discretisation import discretise
from saga_fg.errors import InputError
from saga_fg.estimators.dynamics import Dynamics, identity
from saga_fg.estimators.flow import Flow, flows
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.protocol import require_kind
from saga_fg.transition import Blocks, Transition


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """A node that moves by a nonlinear interaction function of its own state and those of `neighbours` (ids)."""

    node: int
    neighbours: tuple[int, ...]
    interaction: NonlinearInteraction


@dataclass(frozen=True, eq=False)
class Motion:
    """The record of an interval."""

    transition: Transition
    nonlinear: tuple[NodeMotion, ...] = ()

    @property
    def dt(self) -> float:
        """Seconds."""
        return self.transition.dt

    @property
    def linear(self) -> bool:
        """Whether linearising it again elsewhere gives the same."""
        return not (self.nonlinear or self.flows)

    @cached_property
    def flows(self) -> tuple[Flow, ...]:
        """The nonlinear dynamics of the transition's graph."""
        return flows(self.transition)

    def flows_of(self, layout: Layout) -> list[tuple[Flow, IntArray]]:
        """The same with their rows (n, 1 + k) of `layout`."""
        place = layout.rows(self.transition.nodes)
        return [(flow, place[flow.rows]) for flow in self.flows]

    def check(self, layout: Layout) -> None:
        """Raise `InputError` or `UnknownNodeError` unless it is about exactly the nodes of `layout`, each once."""
        Dynamics.of(self.transition, layout)
        for motion in self.nonlinear:
            require_kind("nonlinear", motion, NodeMotion)
        if self.nonlinear and self.flows:
            raise InputError("nonlinear: expected linear motion and edges of all nodes in the graph beside it")
        moving = [motion.node for motion in self.nonlinear]
        layout.rows(moving)
        if len(set(moving)) < len(moving):
            raise InputError(f"nonlinear: expected each node once, got {moving}")
        for motion in self.nonlinear:
            layout.rows(motion.neighbours)
            if len({motion.node, *motion.neighbours}) <= len(motion.neighbours):
                raise InputError(f"nonlinear: node {motion.node}: expected distinct neighbours other than itself")

    def parts(self, dt: float) -> tuple[Motion, Motion]:
        """The first `dt` seconds of the interval and the rest, with the same edges."""
        graph = self.transition.graph
        first, rest = discretise(graph, dt), discretise(graph.after(dt), self.transition.dt - dt)
        return Motion(first, self.nonlinear), Motion(rest, self.nonlinear)

    def dynamics(self, layout: Layout, mean: FloatArray) -> Dynamics:
        """The linear dynamics over the nodes of `layout`, nonlinear ones linearised at the joint state `mean`."""
        linear = Dynamics.of(self.transition, layout)
        if self.linear:
            return linear
        own = np.zeros(len(layout), dtype=bool)
        own[layout.rows([motion.node for motion in self.nonlinear])] = True
        flows_of = self.flows_of(layout)
        for _, rows in flows_of:
            own[rows[:, 0]] = True
        F = []
        for blocks in linear.F:
            kept = ~own[blocks.target]
            F.append(Blocks(blocks.target[kept], blocks.source[kept], blocks.values[kept]))
        b = linear.b.copy()
        for flow, rows in flows_of:
            states = [mean[layout.spans(column)] for column in rows.T]
            J = flow.jacobians(states)
            moved = flow.predict(states)
            for block, x in zip(J, states, strict=True):
                moved = moved - (block @ x[:, :, None])[:, :, 0]
            b[layout.spans(rows[:, 0])] = moved
            F += [Blocks(rows[:, 0], column, block) for column, block in zip(rows.T, J, strict=True)]
        for motion in self.nonlinear:
            rows = layout.rows([motion.node, *motion.neighbours])
            x, *others = (mean[layout.places(rows[k : k + 1])] for k in range(len(rows)))
            matrices, offset = _affine(motion, x, others, self.transition.dt)
            b[layout.places(rows[:1])] = offset
            F += [Blocks(rows[:1], rows[k : k + 1], matrix[None]) for k, matrix in enumerate(matrices)]
        return Dynamics(layout, tuple(F), b, linear.Q)


@dataclass(frozen=True, eq=False)
class Standstill:
    """No time passes: what divides two moments at the same time."""

    dt: float = 0.0
    linear: bool = True

    def dynamics(self, layout: Layout, mean: FloatArray) -> Dynamics:
        """The identity."""
        return Dynamics(layout, identity(layout, np.arange(len(layout))), np.zeros(len(mean)), ())


def _affine(
    motion: NodeMotion, x: FloatArray, others: list[FloatArray], dt: float
) -> tuple[list[FloatArray], FloatArray]:
    """[F_i, F_j, ...] and b of f around x, others; angles of the prediction are those next to the node's own."""
    try:
        F, F_others, b = motion.interaction.affine(x, others, dt)
    except Exception as error:  # of a researcher's function: anything
        reason = error if isinstance(error, FactorError) else repr(error)
        raise InputError(f"interaction of node {motion.node}: {reason}") from error
    angles = list(motion.interaction.angles)
    predicted = (
        b + F @ x + sum((block @ other for block, other in zip(F_others, others, strict=True)), np.zeros(len(x)))
    )
    b[angles] -= 2 * np.pi * np.round((predicted[angles] - x[angles]) / (2 * np.pi))
    return [F, *F_others], b
