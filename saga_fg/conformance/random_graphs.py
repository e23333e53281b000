"""Random scene graphs of mixed node types, for tests that must hold on any graph."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from saga_fg import ConstantAcceleration, ConstantVelocity, Curvilinear, Edges, NodeType, RandomWalk, SceneGraph
from saga_fg.model.interactions import CarFollowing, Interaction, NodeTable, SharedVelocity, applies
from saga_fg.numerics.arrays import IntArray

Random = np.random.Generator

CAR = NodeType("car", ConstantVelocity(acceleration_noise=1.5))
BUS = NodeType("bus", ConstantAcceleration(jerk_noise=0.4))
VAN = NodeType("van", Curvilinear(turn_time=1.5, fading_time=2.0, jerk_noise=0.7))
TRAM = NodeType("tram", ConstantAcceleration(jerk_noise=0.7, fading_time=2.0))
CONE = NodeType("cone", RandomWalk(drift=0.02))
POLE = NodeType("pole", RandomWalk())  # stands still for ever
MOVING = (CAR, BUS, TRAM)


def node_table(rng: Random, types: Sequence[NodeType], ids: ArrayLike | None = None) -> NodeTable:
    """Estimates of nodes that head roughly the same way."""
    n = len(types)
    heading = rng.normal(0.5, 0.3, n)
    speed = rng.uniform(5, 15, n)
    return NodeTable(
        id=np.arange(n) if ids is None else np.asarray(ids),
        label=np.array([t.name for t in types], dtype=np.str_),
        types=tuple(types),
        position=rng.uniform(-30, 30, (n, 2)),
        velocity=np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1),
        heading=heading,
        length=rng.uniform(3, 12, n),
        velocity_variance=rng.uniform(0.1, 2, n),
    )


def random_pairs(rng: Random, targets: Sequence[int], sources: Sequence[int], density: float) -> IntArray:
    """Distinct pairs of different rows."""
    pairs = [(i, j) for i in targets for j in sources if i != j and rng.random() < density]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2).T


def interaction_edges(
    rng: Random, nodes: NodeTable, interaction: Interaction, density: float, max_rate: float
) -> list[Edges]:
    """Edges of one interaction between random pairs of nodes it applies to, by the types of their ends."""
    groups = []
    for target_type in dict.fromkeys(nodes.types):
        for source_type in dict.fromkeys(nodes.types):
            if not applies(interaction.needs, target_type, source_type):
                continue
            rows = [[k for k, t in enumerate(nodes.types) if t is kind] for kind in (target_type, source_type)]
            target, source = random_pairs(rng, rows[0], rows[1], density)
            if len(target):
                rate = rng.uniform(0, max_rate, len(target))
                name = type(interaction).__name__
                groups.append(Edges(name, target, source, rate, *interaction.triples(nodes, target, source)))
    return groups


def arbitrary_edges(rng: Random, types: Sequence[NodeType], density: float, max_rate: float) -> list[Edges]:
    """Edges with made-up triples, between nodes of any two types: A_self damps, A_other and b are anything."""
    groups = []
    for d_i in sorted({t.dim for t in types}):
        for d_j in sorted({t.dim for t in types}):
            rows = [[k for k, t in enumerate(types) if t.dim == d] for d in (d_i, d_j)]
            target, source = random_pairs(rng, rows[0], rows[1], density)
            m = len(target)
            if m:
                A_self = 0.3 * rng.normal(size=(m, d_i, d_i)) - np.eye(d_i)
                A_other = 0.5 * rng.normal(size=(m, d_i, d_j))
                rate = rng.uniform(0, max_rate, m)
                groups.append(Edges("arbitrary", target, source, rate, A_self, A_other, rng.normal(size=(m, d_i))))
    return groups


def random_types(rng: Random, n: int, kinds: Sequence[NodeType] = (CAR, BUS, TRAM, CONE, POLE)) -> tuple[NodeType, ...]:
    return tuple(kinds[k] for k in rng.integers(0, len(kinds), n))


def random_graph(
    rng: Random,
    types: Sequence[NodeType],
    ids: ArrayLike | None = None,
    density: float = 0.4,
    max_rate: float = 1.0,
    arbitrary: bool = True,
) -> SceneGraph:
    """Shared velocity, car-following and (if wanted) arbitrary edges over nodes of the given types, pairs repeating."""
    nodes = node_table(rng, types, ids)
    groups = [
        *interaction_edges(rng, nodes, SharedVelocity(), density, max_rate),
        *interaction_edges(rng, nodes, SharedVelocity(along_heading=True), density / 2, max_rate),
        *interaction_edges(rng, nodes, CarFollowing(headway=0.5), density / 2, max_rate),
        *(arbitrary_edges(rng, types, density / 2, max_rate) if arbitrary else ()),
    ]
    return SceneGraph(nodes.id, nodes.types, tuple(groups))
