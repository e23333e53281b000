"""Effect of each edge of the scene graph on a prediction: the prediction with it less the one without it.

    effect of e on its target i = x_i(t + dt; all edges) - x_i(t + dt; all edges but e)

in position and velocity, from the estimates at the start of the interval (other components, such as an acceleration,
are taken as 0: edges act on them by nothing). As F has the sparsity of the graph, only the edges into i matter for i.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import POSITION, VELOCITY, NodeTable
from saga_fg.model.nonlinear_interactions import held
from saga_fg.model.scene_graph import Edges, SceneGraph
from saga_fg.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class EdgeEffect:
    """One edge: ids of its ends, its interaction and rate (1/s), how it moved (2,), m, and sped up (2,), m/s, i."""

    target: int
    source: int
    interaction: str
    rate: float
    position: FloatArray
    velocity: FloatArray


def edge_effects(graph: SceneGraph, dt: float, nodes: NodeTable) -> list[EdgeEffect]:
    """The effects of all edges of `graph` over `dt` s on nodes whose estimates (at least) `nodes` holds."""
    row_of = {id_: row for row, id_ in enumerate(nodes.id.tolist())}
    into: dict[int, list[Edges]] = {}
    for group in graph.edges:
        for k in range(len(group)):
            into.setdefault(int(group.target[k]), []).append(_single(group, k))
    effects = []
    for i, edges in into.items():
        together = _predicted(graph, i, edges, dt, nodes, row_of)
        for e, edge in enumerate(edges):
            change = together - _predicted(graph, i, edges[:e] + edges[e + 1 :], dt, nodes, row_of)
            ids = int(graph.nodes[i]), int(graph.nodes[edge.source[0]])
            effects.append(EdgeEffect(*ids, edge.interaction, float(edge.rate[0]), change[:2], change[2:]))
    for law_edges in graph.nonlinear:
        i, j = (graph.nodes[rows].tolist() for rows in (law_edges.target, law_edges.source))
        states = np.concatenate([nodes.position, nodes.velocity], axis=1)
        own, other = (states[[row_of[node] for node in ends]] for ends in (i, j))
        a = law_edges.law.accelerations(own, other, law_edges.given).value
        moved = held((law_edges.rate[:, None] * a)[:, :, None], dt)[:, :, 0]
        each = zip(i, j, law_edges.rate.tolist(), moved, strict=True)
        effects += [EdgeEffect(t, s, law_edges.interaction, rate, x[:2], x[2:]) for t, s, rate, x in each]
    return effects


def _single(group: Edges, k: int) -> Edges:
    one = slice(k, k + 1)
    triple = (group.A_self[one], group.A_other[one], group.b[one])
    return Edges(group.interaction, group.target[one], group.source[one], group.rate[one], *triple)


def _predicted(
    graph: SceneGraph, i: int, edges: Sequence[Edges], dt: float, nodes: NodeTable, row_of: dict[int, int]
) -> FloatArray:
    """Position and velocity (4,) of node row i after dt, if only `edges` (single ones, into i) act on it."""
    rows = [i, *sorted({int(edge.source[0]) for edge in edges})]
    place = {row: n for n, row in enumerate(rows)}
    local = tuple(
        Edges(
            edge.interaction,
            np.array([0]),
            np.array([place[int(edge.source[0])]]),
            edge.rate,
            edge.A_self,
            edge.A_other,
            edge.b,
        )
        for edge in edges
    )
    types = tuple(graph.types[row] for row in rows)
    transition = discretise(SceneGraph(graph.nodes[rows], types, local), dt)
    states = []
    for row, node_type in zip(rows, types, strict=True):
        x = np.zeros(node_type.dim)
        known = row_of[int(graph.nodes[row])]
        x[node_type.index(POSITION)] = nodes.position[known]
        if node_type.has(VELOCITY):
            x[node_type.index(VELOCITY)] = nodes.velocity[known]
        states.append(x)
    own = (transition.F_matrix @ np.concatenate(states) + transition.b)[: types[0].dim]
    return np.asarray(np.concatenate([own[types[0].index(POSITION)], own[types[0].index(VELOCITY)]]))
