"""The scene graph G_t = (V_t, E_t): typed nodes, and directed edges (source j -> target i) that act on the dynamics.

    dx_i/dt = A_i x_i + sum_j rate_ij ( A_self x_i + A_other x_j + b ) + noise

An edge carries its rate (1/s, never per step) and the triple (A_self, A_other, b) of its interaction function, already
evaluated at the estimate at the start of an interval; that of a nonlinear edge is a law of acceleration, evaluated
where an estimator asks. A graph is therefore a complete, frozen record of the
dynamics of an interval: it can be discretised over any dt, and again over parts of it when a measurement comes late.
Only nodes are estimated (Sani et al., SAGA-KF, ICPR 2024), edges are inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from saga_fg.errors import InputError, require_type
from saga_fg.model.motion import NodeType, distinct_types
from saga_fg.model.nonlinear_interactions import AccelerationLaw
from saga_fg.numerics import FloatArray, IntArray, checked, checked_ids, checked_rows


@dataclass(frozen=True, eq=False)
class Edges:
    """E edges of one interaction between nodes of equal state sizes d_i (targets) and d_j (sources).

    interaction  name of the interaction function
    target       (E,) rows of the influenced nodes in the graph
    source       (E,) rows of the influencing nodes
    rate         (E,) kappa_ij >= 0, 1/s
    A_self       (E, d_i, d_i), A_other (E, d_i, d_j), b (E, d_i)
    """

    interaction: str
    target: IntArray
    source: IntArray
    rate: FloatArray
    A_self: FloatArray
    A_other: FloatArray
    b: FloatArray

    def __post_init__(self) -> None:
        what, count = _checked_ends(self)
        d_i, d_j = np.shape(self.A_other)[1:] if np.ndim(self.A_other) == 3 else (0, 0)
        for name, shape in (("A_self", (count, d_i, d_i)), ("A_other", (count, d_i, d_j)), ("b", (count, d_i))):
            vars(self)[name] = checked(f"{what}: {name}", getattr(self, name), shape)

    def __len__(self) -> int:
        return len(self.target)


class OwnMotions(NamedTuple):
    """Own motions x' = F x + b + q, q ~ N(0, Q), of n nodes over an interval: F, Q (n, d, d), b (n, d)."""

    F: FloatArray
    b: FloatArray
    Q: FloatArray


class RecordedMotions(Protocol):
    """Known courses or mixtures of motion of some nodes (`saga_fg.model.manoeuvres`)."""

    @property
    def ids(self) -> IntArray: ...

    def select(self, rows: IntArray) -> RecordedMotions: ...

    def predicted(self, dt: float, scale: FloatArray) -> tuple[RecordedMotions, OwnMotions]:
        """dt seconds later, and the motions until then; scale (n,) of the process noise."""


@dataclass(frozen=True, eq=False)
class NonlinearEdges:
    """E edges that accelerate their targets: dv_i/dt += rate tau a(x_i, x_j).

    law     the acceleration, and tau
    target  (E,) rows of the influenced nodes in the graph
    source  (E,) rows of the influencing nodes
    rate    (E,) >= 0, 1/s
    given   (E, ...) arguments of the law besides the states
    """

    law: AccelerationLaw
    target: IntArray
    source: IntArray
    rate: FloatArray
    given: FloatArray

    def __post_init__(self) -> None:
        what, count = _checked_ends(self)
        vars(self)["given"] = checked(f"{what}: given", self.given, (count, *np.shape(self.given)[1:]))

    def __len__(self) -> int:
        return len(self.target)

    @property
    def interaction(self) -> str:
        """Name of the law."""
        return type(self.law).__name__


def _checked_ends(edges: Edges | NonlinearEdges) -> tuple[str, int]:
    """Check ends and rates; returns a description of the edges and their number."""
    what = f"edges of {edges.interaction}"
    count = len(checked_rows(f"{what}: target", edges.target))
    for name in ("target", "source"):
        vars(edges)[name] = checked_rows(f"{what}: {name}", getattr(edges, name), count)
    rate = vars(edges)["rate"] = checked(f"{what}: rate", edges.rate, (count,))
    if (rate < 0).any():
        raise InputError(f"{what}: rate[{int(np.argmax(rate < 0))}]: expected a rate >= 0 in 1/s, got {rate.min():g}")
    if (edges.target == edges.source).any():
        row = int(edges.target[edges.target == edges.source][0])
        raise InputError(f"{what}: node row {row} has an edge to itself")
    return what, count


@dataclass(frozen=True, eq=False)
class SceneGraph:
    """Nodes and edges at the start of an interval.

    nodes  (n,) ids, unique
    types  n node types
    edges  one or more groups of edges, by rows of `nodes`
    nonlinear  one or more groups of nonlinear edges, likewise
    diffusion_scale  (n,) > 0, factors on the diffusion of the nodes' own motion, 1 if not given: what an interaction
                     explains of a node's motion is noise no more
    motions  of some nodes in place of those of their types, as they are at the start of the interval

    Raises `InputError` for edges that name a row the graph has not, triples whose sizes don't fit the nodes,
    or edges of the other kind.
    """

    nodes: IntArray
    types: tuple[NodeType, ...]
    edges: tuple[Edges, ...] = ()
    diffusion_scale: FloatArray = None  # type: ignore[assignment]  # an array from construction on
    nonlinear: tuple[NonlinearEdges, ...] = ()
    motions: tuple[RecordedMotions, ...] = ()

    def __post_init__(self) -> None:
        nodes = checked_ids("nodes", self.nodes)
        for name, kind in (("edges", Edges), ("nonlinear", NonlinearEdges)):
            require_type(name, getattr(self, name), tuple, list)
            for k, group in enumerate(getattr(self, name)):
                require_type(f"{name}[{k}]", group, kind)
        vars(self).update(nodes=nodes, types=tuple(self.types))
        if len(self.types) != len(nodes):
            raise InputError(f"types: expected {len(nodes)} node types, got {len(self.types)}")
        given = np.ones(len(nodes)) if self.diffusion_scale is None else self.diffusion_scale
        scale = checked("diffusion_scale", given, (len(nodes),))
        if (scale <= 0).any():
            raise InputError(
                f"diffusion_scale[{int(np.argmax(scale <= 0))}]: expected a factor > 0, got {scale.min():g}"
            )
        vars(self)["diffusion_scale"] = scale
        for group in self._groups:
            d_i, d_j = group.A_other.shape[1:] if isinstance(group, Edges) else (None, None)
            for name, rows, dim in (("target", group.target, d_i), ("source", group.source, d_j)):
                if len(rows) == 0:
                    continue
                if rows.min() < 0 or rows.max() >= len(nodes):
                    bad = int(rows[np.argmax((rows < 0) | (rows >= len(nodes)))])
                    raise InputError(f"edges of {group.interaction}: {name}: row {bad} is outside {len(nodes)} nodes")
                if dim is not None and (self.dims[rows] != dim).any():
                    bad = int(rows[np.argmax(self.dims[rows] != dim)])
                    raise InputError(
                        f"edges of {group.interaction}: {name}: node {int(nodes[bad])} has {self.dims[bad]} "
                        f"components, the interaction {dim}"
                    )

    def __len__(self) -> int:
        return len(self.nodes)

    @cached_property
    def dims(self) -> IntArray:
        """(n,) sizes of the nodes' states."""
        kinds, kind = self.kinds
        return np.array([t.dim for t in kinds], dtype=np.int64)[kind]

    @cached_property
    def kinds(self) -> tuple[list[NodeType], IntArray]:
        """The distinct types, and the number (n,) of each node's among them."""
        return distinct_types(self.types)

    @property
    def _groups(self) -> tuple[Edges | NonlinearEdges, ...]:
        return *self.edges, *self.nonlinear

    @property
    def edge_count(self) -> int:
        return sum(len(group) for group in self._groups)

    def after(self, dt: float) -> SceneGraph:
        """The graph for the rest of an interval of which dt seconds have passed: the same edges, later motions."""
        if not self.motions:
            return self
        scale = (self.diffusion_scale[self.rows(record.ids)] for record in self.motions)
        later = (record.predicted(dt, s)[0] for record, s in zip(self.motions, scale, strict=True))
        return replace(self, motions=tuple(later))

    def rows(self, nodes: IntArray) -> IntArray:
        """Rows of nodes that are in the graph."""
        order = np.argsort(self.nodes)
        return np.asarray(order[np.searchsorted(self.nodes, nodes, sorter=order)])

    def only(self, nodes: IntArray) -> SceneGraph:
        """The graph of those of its nodes that are among `nodes` (any ids), with the edges between them."""
        kept = np.flatnonzero(np.isin(self.nodes, nodes))
        row = np.full(len(self), -1, dtype=np.int64)
        row[kept] = np.arange(len(kept))
        groups: list[Edges] = []
        nonlinear: list[NonlinearEdges] = []
        for group in self._groups:
            inside = np.flatnonzero((row[group.target] >= 0) & (row[group.source] >= 0))
            target, source = row[group.target[inside]], row[group.source[inside]]
            if isinstance(group, NonlinearEdges):
                nonlinear.append(NonlinearEdges(group.law, target, source, group.rate[inside], group.given[inside]))
                continue
            triple = (group.A_self[inside], group.A_other[inside], group.b[inside])
            groups.append(Edges(group.interaction, target, source, group.rate[inside], *triple))
        types = tuple(self.types[k] for k in kept.tolist())
        motions = tuple(m.select(np.flatnonzero(np.isin(m.ids, nodes))) for m in self.motions)
        return SceneGraph(self.nodes[kept], types, tuple(groups), self.diffusion_scale[kept], tuple(nonlinear), motions)

    @staticmethod
    def of(nodes: Sequence[int] | IntArray, node_type: NodeType, edges: Sequence[Edges] = ()) -> SceneGraph:
        """A graph whose nodes are all of one type."""
        return SceneGraph(np.asarray(nodes, dtype=np.int64), (node_type,) * len(nodes), tuple(edges))
