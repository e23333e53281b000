"""The scene graph made by edge rules, and what each of its edges does to a prediction.

    effect of e on its target i = x_i(t + dt; all edges) - x_i(t + dt; all edges but e)

in position and velocity, from the estimates at the start of the interval (other components, such as an acceleration,
are taken as 0: edges act on them by nothing). As F has the sparsity of the graph, only the edges into i matter for i.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import EdgeRule, Pairs
from saga_fg.model.interactions import POSITION, VELOCITY, NodeTable, Triples, applies
from saga_fg.model.motion import distinct_types
from saga_fg.model.nonlinear_interactions import held
from saga_fg.model.scene_graph import Edges, NonlinearEdges, RecordedMotions, SceneGraph
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked, checked_rows, unchecked

Governing = Callable[[int, NodeTable, IntArray, IntArray], FloatArray]
_MAX_EXPLAINED = 20.0  # exponent: a billionth of the noise stays, and F P F^T + Q is no more singular than that
E = TypeVar("E", Edges, NonlinearEdges)


def build_graph(
    nodes: NodeTable,
    rules: Sequence[EdgeRule],
    explained_noise: float = 0.0,
    noise_scale: FloatArray | None = None,
    motions: tuple[RecordedMotions, ...] = (),
    interacting: BoolArray | None = None,
    governing: Governing | None = None,
    min_rate: float = 1e-3,
) -> SceneGraph:
    """The scene graph of `nodes` with the edges `rules` choose, their rates times the existence of their sources.

    Edges weaker than `min_rate` (1/s) are left out.

    A node acted on at the total rate K has its diffusion multiplied by exp(-explained_noise K), explained_noise in s:
    motion that follows a leader is explained. `noise_scale` (n,) are further factors on it. `motions` are those
    of the graph. Rules see, and tie, the nodes that are `interacting` (n,), None: all. `governing` gives the
    probabilities (E,) that edges of a rule, by its number, govern between nodes; they scale its rates.

    Raises `InputError` for a rule whose pairs name rows that are not there, or rates that are not finite.
    """
    groups: list[Edges] = []
    nonlinear: list[NonlinearEdges] = []
    total_rate = np.zeros(len(nodes))
    graph_nodes, types = nodes, distinct_types(nodes.types)
    row = np.arange(len(nodes)) if interacting is None else interacting.nonzero()[0]
    if len(row) < len(nodes):
        nodes = nodes.select(row)
    if len(nodes) > 1:
        first: dict[tuple[str, ...], int] = {}  # an interaction sees no more of a type than its components
        kind = np.array([first.setdefault(t.components, len(first)) for t in types[0]])[types[1][row]]
        for number, rule in enumerate(rules):
            target, source, rate = _pairs(rule, nodes)
            if len(target) == 0:
                continue
            rate = rate * nodes.existence[source]
            if governing is not None:
                rate = rate * governing(number, nodes, target, source)
            keep = (rate >= min_rate).nonzero()[0]
            target, source, rate = target[keep], source[keep], rate[keep]
            pair_kind = kind[target] * len(first) + kind[source]
            for k in np.bincount(pair_kind).nonzero()[0]:
                mine = (pair_kind == k).nonzero()[0]
                t, s = target[mine], source[mine]
                law, shipped = rule.interaction, _shipped(rule) and _shipped(rule.interaction)
                if not applies(law.needs, nodes.types[t[0]], nodes.types[s[0]]):
                    continue
                ends = {"target": row[t], "source": row[s], "rate": rate[mine]}
                if hasattr(law, "triples"):
                    triples = law.triples(nodes, t, s)
                    if not isinstance(triples, Triples):
                        what = f"interaction {type(law).__name__}: triples"
                        raise InputError(f"{what}: expected Triples, got {type(triples).__name__}")
                    columns = triples._asdict()
                    groups.append(_made(Edges, shipped, interaction=type(law).__name__, **ends, **columns))
                else:
                    ends["given"] = law.given(nodes, t, s)
                    nonlinear.append(_made(NonlinearEdges, shipped, law=law, **ends))
                total_rate += np.bincount(row[t], weights=rate[mine], minlength=len(total_rate))
    scale = np.exp(-np.minimum(explained_noise * total_rate, _MAX_EXPLAINED))
    if noise_scale is not None:
        scale = scale * noise_scale
    parts = {"edges": tuple(groups), "diffusion_scale": scale, "nonlinear": tuple(nonlinear), "motions": motions}
    return unchecked(SceneGraph, nodes=graph_nodes.id, types=graph_nodes.types, kinds=types, **parts)


def _made(kind: type[E], shipped: bool, **columns: Any) -> E:
    """Edges, which are checked unless their rule and law are of this package."""
    return unchecked(kind, **columns) if shipped else kind(**columns)


def _pairs(rule: EdgeRule, nodes: NodeTable) -> Pairs:
    """The pairs of a rule; `InputError` for rows or rates of a user's that are not valid."""
    return rule.pairs(nodes) if _shipped(rule) else _checked_pairs(rule, nodes)


def _shipped(part: object) -> bool:
    """True if a rule or law is of this package, and none that was derived from one."""
    return type(part).__module__.startswith("saga_fg.")


def _checked_pairs(rule: EdgeRule, nodes: NodeTable) -> Pairs:
    """The pairs of a user's rule; `InputError` for rows or rates that are not valid."""
    what = f"edge rule {type(rule).__name__}"
    pairs = rule.pairs(nodes)
    if not (isinstance(pairs, tuple) and len(pairs) == 3):
        raise InputError(f"{what}: expected Pairs (target, source, rate), got {type(pairs).__name__}")
    target = checked_rows(f"{what}: target", pairs[0])
    source = checked_rows(f"{what}: source", pairs[1], len(target))
    for name, rows in (("target", target), ("source", source)):
        if len(rows) and (rows.min() < 0 or rows.max() >= len(nodes)):
            bad = int(rows[np.argmax((rows < 0) | (rows >= len(nodes)))])
            raise InputError(f"{what}: {name}: row {bad} is outside {len(nodes)} nodes")
    return Pairs(target, source, checked(f"{what}: rate", pairs[2], (len(target),)))


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
