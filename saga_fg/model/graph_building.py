"""The scene graph made by edge rules, what each of its edges does to a prediction, and stability of rules.

    effect of e on its target i = x_i(t + dt; all edges) - x_i(t + dt; all edges but e)

in position and velocity, from the estimates at the start of the interval (other components, such as an acceleration,
are taken as 0: edges act on them by nothing). As F has the sparsity of the graph, only the edges into i matter for i.

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

Interactions learned from recordings are a value that is written to a file and given to a tracker. They must be stable:
construction checks them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import numpy as np
import scipy.linalg

from saga_fg.errors import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Attached, EdgeRule, Following, Neighbours, Pairs
from saga_fg.model.interactions import POSITION, VELOCITY, NodeTable, Triples, applies, unit
from saga_fg.model.motion import ConstantVelocity, NodeType, distinct_types
from saga_fg.model.nonlinear_interactions import AccelerationLaw, held
from saga_fg.model.scene_graph import Edges, NonlinearEdges, RecordedMotions, SceneGraph
from saga_fg.numerics import BoolArray, FloatArray, IntArray, checked, checked_rows, unchecked
from saga_fg.parts import of_own_code, part_name
from saga_fg.settings import Range, Settings, setting, settings_group

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


LONGEST_STEP = 1.0  # s
_STEPS = (0.1, 0.25, 0.5, LONGEST_STEP)
_TURNS = np.radians([0.0, 15.0, 45.0, 90.0, 135.0, 180.0])  # between the headings of a pair
_ROUNDING = 1e-6  # 1/s; the double eigenvalue zero of constant velocity is found to half the digits
_GROWTH = 1e-4  # of an eigenvalue of a step beyond 1, for the same reason

MovingRule: TypeAlias = Following | Neighbours | Attached


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
    of_moving = {
        k
        for k, rule in rules.items()
        if isinstance(rule, Neighbours | Following) and not getattr(rule, "parked", False)
    }
    classes = {label for rule in rules.values() for label in _classes(rule)}
    found = {
        tuple(k for k, rule in rules.items() if label in _classes(rule) and (moved or k not in of_moving))
        for label in sorted(classes)
        for moved in (True, False)
    }
    return sorted(numbers for numbers in found if len(numbers) > 1)


def _classes(rule: MovingRule) -> tuple[str, ...]:
    return (*rule.attached, *rule.carriers) if isinstance(rule, Attached) else rule.classes


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
            with of_own_code(f"interaction {part_name(law)}"):
                triples = law.triples(nodes, target, source)
            groups.append(Edges(type(law).__name__, target, source, rate, *triples))
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
