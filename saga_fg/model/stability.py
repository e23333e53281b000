"""Stability of edge rules, alone and together, and interactions learned from recordings.

Edge rules must not drive objects apart.

By Gershgorin's theorem the eigenvalues of couplings whose rates sum to K_i at node i lie in discs about -K_i of radius
K_i, so within 2 max K_i of zero, and two nodes that act on each other at the rate max K_i reach that bound. Rules are
therefore tried on pairs of nodes, each rule at the highest sum of rates that it can have at a node of the pair; both
act, unless the rule has leaders. No eigenvalue of the joint generator may have a positive real part, and none of a
step, which is of first order in the coupling, may be outside the unit circle.

Each rule is tried alone, on pairs in several directions to each other, and together with all that may act on the same
object, on a pair that heads the same way. (Where headings differ, a rule for speeds along headings and one
for velocities may feed each other while headings are held; but in the next interval these follow the velocities.)

Rules by which lanes, lines or cones act on vehicles are not tried, as their sources are stationary. Nor are laws of
acceleration, which are bounded in themselves.

Interactions learned from recordings, as a value that is written to a file and given to a tracker.

Learned dynamics must be stable: construction checks them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import scipy.linalg

from saga_fg.errors import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Attached, EdgeRule, Following, Neighbours
from saga_fg.model.interactions import NodeTable, applies, unit
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.nonlinear_interactions import AccelerationLaw
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.numerics import FloatArray
from saga_fg.settings import Range, Settings, setting, settings_group

LONGEST_STEP = 1.0  # s
_STEPS = (0.1, 0.25, 0.5, LONGEST_STEP)
_TURNS = np.radians([0.0, 15.0, 45.0, 90.0, 135.0, 180.0])  # between the headings of a pair
_ROUNDING = 1e-6  # 1/s; the double eigenvalue zero of constant velocity is found to half the digits
_GROWTH = 1e-4  # of an eigenvalue of a step beyond 1, for the same reason

MovingRule = Following | Neighbours | Attached


def require_stable(rules: Sequence[EdgeRule], longest_step: float = LONGEST_STEP) -> None:
    """Raises `InputError` for rules that drive objects apart, in time or in steps.

    It names `edges[k]`, or several that may act on the same objects.

    longest_step  of a prediction, s; longer ones than `LONGEST_STEP` are not tried
    """
    able = {k: rule for k, rule in enumerate(rules) if isinstance(rule, MovingRule)}
    for numbers in [(k,) for k in able] + _acting_together(able):
        turns = _TURNS if len(numbers) == 1 else _TURNS[:1]
        graph, highest = _pairs_of_nodes([able[k] for k in numbers], turns)
        name = ", ".join(f"edges[{k}]" for k in numbers)
        who = f"two nodes that act on each other at up to {highest:g} 1/s, the highest sum of rates at a node,"
        generator, _, _ = joint_generator(graph)
        abscissa = float(np.linalg.eigvals(generator).real.max())
        if abscissa > _ROUNDING:
            raise InputError(f"{name}: expected stable dynamics, {who} drift apart like exp({abscissa:.3g} t)")
        for dt in sorted({min(step, longest_step) for step in _STEPS}):
            radius = float(np.abs(np.linalg.eigvals(discretise(graph, dt).F_matrix.toarray())).max())
            if radius > 1 + _GROWTH:
                raise InputError(
                    f"{name}: expected stable steps, what {who} do grows by the factor {radius:.3g} in {dt:g} s "
                    "(a shorter max_step of the tracker, or lower rates, help)"
                )


def highest_rate(rule: MovingRule) -> float:
    """The highest sum of the rates of a rule's edges into a node, 1/s."""
    match rule:
        case Neighbours():
            return rule.rate * rule.max_degree
        case _:
            return rule.rate


def joint_generator(graph: SceneGraph) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The whole graph as one linear system dx/dt = G x + c + w: G (D, D), c (D,), Qc (D, D), dense.

    exp(G dt) is the reference that `discretise` approximates to second order in the coupling.
    """
    offsets = np.concatenate([[0], np.cumsum(graph.dims)])
    G = scipy.linalg.block_diag(*(t.generator for t in graph.types)) if len(graph) else np.empty((0, 0))
    scaled = (t.diffusion * scale for t, scale in zip(graph.types, graph.diffusion_scale, strict=True))
    Qc = scipy.linalg.block_diag(*scaled) if len(graph) else np.empty((0, 0))
    c = np.zeros(int(offsets[-1]))
    for edges in graph.edges:
        for k, (i, j, rate) in enumerate(zip(edges.target, edges.source, edges.rate, strict=True)):
            at_i = slice(offsets[i], offsets[i + 1])
            at_j = slice(offsets[j], offsets[j + 1])
            G[at_i, at_i] += rate * edges.A_self[k]
            G[at_i, at_j] += rate * edges.A_other[k]
            c[at_i] += rate * edges.b[k]
    return G, c, Qc


def _acting_together(rules: Mapping[int, MovingRule]) -> list[tuple[int, ...]]:
    """Sets of rules, by number, that may act on one object: of some class, which was seen moving or was not."""
    classes = {label for rule in rules.values() for label in _classes(rule)}
    found = {
        tuple(k for k, rule in rules.items() if label in _classes(rule) and (moved in _states(rule)))
        for label in sorted(classes)
        for moved in (True, False)
    }
    return sorted(numbers for numbers in found if len(numbers) > 1)


def _classes(rule: MovingRule) -> tuple[str, ...]:
    return (*rule.attached, *rule.carriers) if isinstance(rule, Attached) else rule.classes


def _states(rule: MovingRule) -> tuple[bool, ...]:
    """States of objects that a rule acts on: True for seen moving, False for others."""
    match rule:
        case Neighbours():
            return (True,)
        case Following():
            return (True, False) if rule.parked else (True,)
        case _:
            return (True, False)


def _pairs_of_nodes(rules: Sequence[MovingRule], turns: FloatArray) -> tuple[SceneGraph, float]:
    """A pair of nodes for each turn between headings, coupled by every rule, and the highest sum of rates, 1/s."""
    n = 2 * len(turns)
    node_type = NodeType("node", ConstantVelocity(0.0))
    heading = np.stack([0 * turns, turns], axis=1).ravel()
    velocity = 5.0 * unit(heading)
    position = np.tile([[0.0, 0.0], [10.0, 0.5]], (len(turns), 1))
    names, types = np.full(n, "node"), (node_type,) * n
    nodes = NodeTable(
        id=np.arange(n),
        label=names,
        types=types,
        position=position,
        velocity=velocity,
        heading=heading,
        length=np.full(n, 4.0),
        velocity_variance=np.ones(n),
    )
    first, second = np.arange(0, n, 2), np.arange(1, n, 2)
    groups, total = [], 0.0
    for rule in rules:
        led = isinstance(rule, Following)
        target, source = (first, second) if led else (np.concatenate([first, second]), np.concatenate([second, first]))
        rate = highest_rate(rule) * np.exp(-((turns[target // 2] / rule.heading_scale) ** 2) / 2)
        law = rule.interaction
        if not isinstance(law, AccelerationLaw) and applies(law.needs, node_type, node_type):
            total += float(rate.max())
            groups.append(Edges(type(law).__name__, target, source, rate, *law.triples(nodes, target, source)))
    return SceneGraph.of(nodes.id, node_type, groups), total


FORMAT = "saga-fg interactions"
VERSION = 1
HIGHEST_RATE = 20.0  # 1/s, of an edge: beyond, an interaction is a rigid bond


@dataclass(frozen=True)
class LearnedInteractions(Settings):
    """Edge rules, and how much of the process noise they explain.

    Raises `InputError` for another format or version, and for rules that would make the dynamics, or a step, unstable.
    """

    format: Literal["saga-fg interactions"] = setting("saga-fg interactions", "format of this file")
    version: int = setting(VERSION, "version of the format")
    learned_from: str = setting("", "data it was learned from")
    edges: tuple[Following | Neighbours, ...] = settings_group(tuple, "edge rules of the scene graph")
    explained_noise: Annotated[float, Range(0, 10)] = setting(
        0.0, "process noise is scaled by exp(-explained_noise K) at the total rate K of interactions, s; usual 0 to 2"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.version != VERSION:
            raise InputError(f"version: expected {VERSION}, the one this program writes, got {self.version}")
        for k, rule in enumerate(self.edges):
            if rule.rate > HIGHEST_RATE:
                raise InputError(f"edges[{k}].rate: expected at most {HIGHEST_RATE:g} 1/s, got {rule.rate:g}")
        require_stable(self.edges)
