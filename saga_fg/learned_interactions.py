"""Interactions learned from recordings, as a value that is written to a file and given to a tracker.

Dynamics that were learned must not run away: on construction every rule is tried at its highest rate on two nodes,
which act on each other unless the rule has leaders. No eigenvalue of the joint generator may have a positive real part,
and none of a step of up to `LONGEST_STEP`, which is of first order in the coupling, may be outside the unit circle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from saga_fg.discretisation import discretise, joint_generator
from saga_fg.edge_network import EdgeNetwork
from saga_fg.edge_rules import Following, Neighbours
from saga_fg.errors import InputError
from saga_fg.interactions import NodeTable
from saga_fg.node import ConstantVelocity, NodeType
from saga_fg.scene_graph import Edges, SceneGraph
from saga_fg.settings import require_between, require_one_of, setting, settings_group

FORMAT = "saga-fg interactions"
VERSION = 1
HIGHEST_RATE = 20.0  # 1/s, of an edge: beyond, an interaction is a rigid bond
LONGEST_STEP = 1.0  # s
_STEPS = (0.1, 0.5, LONGEST_STEP)
_ROUNDING = 1e-6  # 1/s; the double eigenvalue zero of constant velocity is found to half the digits
_GROWTH = 1e-4  # of an eigenvalue of a step beyond 1, for the same reason


@dataclass(frozen=True)
class LearnedInteractions:
    """Edge rules with the noise that is left beside them.

    Raises `InputError` for another format or version, and for rules that would make the dynamics, or a step, unstable.
    """

    format: Literal["saga-fg interactions"] = setting("saga-fg interactions", "what this file is")
    version: int = setting(VERSION, "of the format")
    learned_from: str = setting("", "what it was learned from")
    edges: tuple[Following | Neighbours | EdgeNetwork, ...] = settings_group(tuple, "edge rules of the scene graph")
    explained_noise: float = setting(
        0.0, "a node acted on at the total rate K moves with exp(-explained_noise K) of its own noise, s"
    )
    acceleration_noise: Mapping[str, float] = settings_group(
        dict, "spectral density of the acceleration by class, m^2/s^3; default serves all others"
    )

    def __post_init__(self) -> None:
        require_one_of(self, "format", (FORMAT,))
        if self.version != VERSION:
            raise InputError(f"version: expected {VERSION}, the one this program writes, got {self.version}")
        require_between(self, 0, 10, "explained_noise")
        for label, q in self.acceleration_noise.items():
            if not (np.isfinite(q) and q > 0):
                raise InputError(f"acceleration_noise.{label}: expected a finite number > 0, got {q!r}")
        for k, rule in enumerate(self.edges):
            rate = rule.max_rate if isinstance(rule, EdgeNetwork) else rule.rate
            if rate > HIGHEST_RATE:
                raise InputError(f"edges[{k}].rate: expected at most {HIGHEST_RATE:g} 1/s, got {rate:g}")
            graph = _two_nodes(rule, rate)
            generator, _, _ = joint_generator(graph)
            abscissa = float(np.linalg.eigvals(generator).real.max())
            if abscissa > _ROUNDING:
                raise InputError(
                    f"edges[{k}]: expected stable dynamics, two nodes that act on each other at {rate:g} 1/s drift "
                    f"apart like exp({abscissa:.3g} t)"
                )
            for dt in _STEPS:
                radius = float(np.abs(np.linalg.eigvals(discretise(graph, dt).F_matrix.toarray())).max())
                if radius > 1 + _GROWTH:
                    raise InputError(
                        f"edges[{k}]: expected stable steps, what two nodes that act on each other at {rate:g} 1/s do "
                        f"grows by the factor {radius:.3g} in {dt:g} s"
                    )


def _two_nodes(rule: Following | Neighbours | EdgeNetwork, rate: float) -> SceneGraph:
    """Two nodes at constant velocity, coupled at `rate`; both ways, but for rules by which one leads the other."""
    node_type = NodeType("node", ConstantVelocity(0.0))
    position, speed = np.array([[0.0, 0.0], [10.0, 0.5]]), np.array([[5.0, 0.0], [4.0, 1.0]])
    heading = np.arctan2(speed[:, 1], speed[:, 0])
    names = np.array(["node", "node"])
    nodes = NodeTable(np.arange(2), names, (node_type,) * 2, position, speed, heading, np.full(2, 4.0), np.ones(2))
    led = isinstance(rule, Following) or (isinstance(rule, EdgeNetwork) and rule.ahead_only)
    target, source = (np.array([0]), np.array([1])) if led else (np.array([0, 1]), np.array([1, 0]))
    triples = rule.interaction.triples(nodes, target, source)
    edges = Edges(type(rule.interaction).__name__, target, source, np.full(len(target), rate), *triples)
    return SceneGraph.of([0, 1], node_type, [edges])
