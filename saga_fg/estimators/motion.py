r"""The dynamics of one interval as an estimator records them: a transition, of which some nodes move nonlinearly.

    x_i(t+dt) = f( x_i(t), [x_j(t)], dt ) + q_i,   q_i ~ N(0, Q_i(dt))         for the nodes with a flow f

in place of the transition's own row; Q_i is the transition's. These are nodes whose types move nonlinearly or that
nonlinear edges of the transition's graph act on (`saga_fg.estimators.flow`). The frozen graph of the transition can be
discretised again over parts of the interval, which is what a late measurement needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from saga_fg.estimators.dynamics import Dynamics, identity
from saga_fg.estimators.flow import Flow, flows
from saga_fg.estimators.layout import Layout
from saga_fg.model.discretisation import discretise
from saga_fg.model.transition import Blocks, Transition
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Motion:
    """The record of an interval."""

    transition: Transition

    @property
    def dt(self) -> float:
        """Seconds."""
        return self.transition.dt

    @property
    def linear(self) -> bool:
        """Whether linearising it again elsewhere gives the same."""
        return not self.flows

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

    def parts(self, dt: float) -> tuple[Motion, Motion]:
        """The first `dt` seconds of the interval and the rest, with the same edges."""
        graph = self.transition.graph
        first, rest = discretise(graph, dt), discretise(graph.after(dt), self.transition.dt - dt)
        return Motion(first), Motion(rest)

    def dynamics(self, layout: Layout, mean: FloatArray) -> Dynamics:
        """The linear dynamics over the nodes of `layout`, nonlinear ones linearised at the joint state `mean`."""
        linear = Dynamics.of(self.transition, layout)
        if self.linear:
            return linear
        own = np.zeros(len(layout), dtype=bool)
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
        return Dynamics(layout, tuple(F), b, linear.Q)


@dataclass(frozen=True, eq=False)
class Standstill:
    """No time steps: what divides two epochs at the same time."""

    dt: float = 0.0
    linear: bool = True

    def dynamics(self, layout: Layout, mean: FloatArray) -> Dynamics:
        """The identity."""
        return Dynamics(layout, identity(layout, np.arange(len(layout))), np.zeros(len(mean)), ())
