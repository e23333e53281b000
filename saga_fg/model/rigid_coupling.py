r"""Rigid coupling of two objects that move as one: a truck and its trailer, a bicycle and its rider.

    dv_i/dt += rate ( v_j - v_i + ( p_j - p_i - d_ij ) / tau ),    d_ij the offset at the start of the interval

Edges go both ways: each takes on the other's velocity and keeps its place relative to it, so that detections of one
correct the other as well. From one interval to the next the offset may turn with the pair.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from saga_fg.model.edge_rules import Pairs
from saga_fg.model.interactions import POSITION, VELOCITY, Needs, NodeTable, Triples, velocity_triples
from saga_fg.numerics.arrays import FloatArray, IntArray, of_classes
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.settings import NonNegative, Settings, setting

OFFSET_TIME = 1.0  # tau: time constant with which a change of the offset is undone, s
SPEED_SCALE = 2.0  # m/s, sigma of the kernel on the difference of velocities


@dataclass(frozen=True)
class RigidCoupling:
    """A node keeps the velocity of another and its present place relative to it."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION + VELOCITY)

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        offset = nodes.position[source] - nodes.position[target]
        stiffness = np.eye(2) / OFFSET_TIME
        return velocity_triples(
            nodes, target, source, -stiffness, -np.eye(2), stiffness, np.eye(2), -offset / OFFSET_TIME
        )


@dataclass(frozen=True)
class Attached(Settings):
    """Every object of some classes is attached to the nearest of some others that touches it and moves as it does."""

    map_classes: ClassVar[tuple[str, ...]] = ()
    interaction: ClassVar[RigidCoupling] = RigidCoupling()
    rate: ClassVar[float] = 3.0  # 1/s, usual 1 to 5
    heading_scale: ClassVar[float] = 0.5  # rad, sigma of the kernel on the difference of headings
    attached: tuple[str, ...] = setting(("trailer",), "classes of attached objects; more: more pairs are sought")
    carriers: tuple[str, ...] = setting(("truck",), "classes of the objects they are attached to; likewise")
    max_gap: NonNegative = setting(
        2.0,
        "largest distance between centres beyond half of both lengths, m; usual 1 to 3; higher: looser "
        "pairs are coupled, too",
    )

    def pairs(self, nodes: NodeTable) -> Pairs:
        parts, carriers = (np.flatnonzero(of_classes(nodes.label, names)) for names in (self.attached, self.carriers))
        if len(parts) == 0 or len(carriers) == 0:
            return Pairs(parts[:0], carriers[:0], np.empty(0))
        apart = _distance(nodes.position, parts, carriers) - (nodes.length[parts, None] + nodes.length[carriers]) / 2
        turn = wrap_angle(nodes.heading[parts, None] - nodes.heading[carriers])
        difference = _distance(nodes.velocity, parts, carriers)
        exponent = (turn / self.heading_scale) ** 2 + (difference / SPEED_SCALE) ** 2
        rate = np.where(apart <= self.max_gap, self.rate * np.exp(-exponent / 2), 0.0)
        of_part, of_carrier = rate.argmax(axis=1), rate.argmax(axis=0)
        rows = np.arange(len(parts))
        mutual = (of_carrier[of_part] == rows) & (rate[rows, of_part] > 0)
        a, b = parts[mutual], carriers[of_part[mutual]]
        r = rate[rows, of_part][mutual]
        return Pairs(np.concatenate([a, b]), np.concatenate([b, a]), np.concatenate([r, r]))


def _distance(values: FloatArray, rows: IntArray, others: IntArray) -> FloatArray:
    """(k, m) lengths of the differences of values (n, 2)."""
    difference = values[rows, None] - values[others]
    return np.hypot(difference[..., 0], difference[..., 1])
