"""Interaction functions that are linear, and the predicted paths that they can act along.

Interaction functions: the triple (A_self, A_other, b) with which an edge j -> i acts on the state of node i.

    dx_i/dt += rate_ij ( A_self x_i + A_other x_j + b )

The mathematics of each interaction is written here, once; graphs, filters and factors adapt it. With u_i the unit
heading of node i and R_ij the rotation from the heading of j to that of i:

    shared velocity    dv_i/dt += rate ( R_ij v_j - v_i ),  da_i/dt -= rate a_i  where a_i is of the state
    car-following      dv_i/dt += rate u_i ( u_j.v_j - u_i.v_i + ( s_ij - gap_ij - headway u_i.v_i ) / tau )

s_ij is the distance along the path of i, linearised at the estimate: it changes by
t_j.dp_j - u_i.dp_i, with t_j the direction of the path at j. On a straight path it is u_i.(p_j - p_i).

Car-following is Helly's linear law (Helly 1959); its gap is that of the present estimate: it keeps the formation.

Predicted paths of nodes: where others are along the path of a vehicle, and beside it.

A path is a polyline from the node on, and straight beyond both ends. A node without one goes straight along its
heading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from saga_fg.kernels.paths import path_cones, places_along
from saga_fg.model.motion import NodeType
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, unchecked
from saga_fg.parts import part_kind
from saga_fg.settings import (
    NonNegative,
    PositiveOrInf,
    Settings,
    setting,
)
from saga_fg.types import LanesAcross

SHARP = 1.2  # rad, turn from which nothing is said about where a path is
_ROUNDING = 1 + 1e-9


@dataclass(frozen=True, eq=False)
class Paths(Columns):
    """k paths of m steps: rows (k,) of the nodes, ascending; position (k, m + 1, 2), m; heading (k, m + 1), rad.

    speed, weight    (k, m + 1) typical speed of earlier traffic there, m/s, and the weight of what it is known from,
                     against 1 for no more than one's own speed
    certainty        (k,) from 0 to 1 with which earlier traffic tells the course where the path begins
    disagreement     (k,) variance of its headings there, rad^2
    """

    row: IntArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    weight: FloatArray
    certainty: FloatArray
    disagreement: FloatArray

    def cones(self, most: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Direction (k,) at the start of each path, how far it turns from there, rad, and a margin (k,), m.

        A path that turns by at most a is in a cone of this half angle: places up to `most` m aside of it are no farther
        from that cone than the margin, or the path turns by more than `SHARP`. At a corner a place may be farther from
        the path than aside.
        """
        return path_cones(self.position, most, SHARP, _ROUNDING)

    def of_nodes(self, rows: IntArray) -> Paths:
        """The paths of the nodes `rows` (k,), ascending, which are counted from 0 then."""
        place = np.minimum(np.searchsorted(rows, self.row), max(len(rows) - 1, 0))
        kept = (rows[place] == self.row).nonzero()[0] if len(rows) else np.empty(0, dtype=np.int64)
        return unchecked(Paths, **vars(self.select(kept)) | {"row": place[kept]})


NO_PATHS = Paths(
    np.empty(0, dtype=np.int64),
    np.empty((0, 2, 2)),
    np.empty((0, 2)),
    np.empty((0, 2)),
    np.empty((0, 2)),
    np.empty(0),
    np.empty(0),
)


class Along(NamedTuple):
    """Places of E nodes on the paths of others: ahead along the path, m, aside to its left, m, its direction there (E,)
    rad, and whether it is a predicted one."""

    ahead: FloatArray
    aside: FloatArray
    direction: FloatArray
    predicted: BoolArray


POSITION = ("x", "y")
VELOCITY = ("vx", "vy")
ACCELERATION = ("ax", "ay")
Needs = tuple[tuple[str, ...], tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class NodeTable:
    """The nodes as input of rules and interactions: estimates at the start of an interval, in world coordinates.

    id (n,); label (n,) classes; types n node types; position (n, 2) m; velocity (n, 2) m/s; heading (n,) rad;
    length (n,) m along the heading; velocity_variance (n,) mean variance of a velocity component, (m/s)^2;
    has_moved (n,) probability that a node was ever in motion, which distinguishes parked from waiting cars, 1 if left
    out; closed, open (n,) the weights with which a stop line holds traffic and lets waiting vehicles go, by the belief
    on its light, 0 if left out; unseen (n,) time since a node was last detected, s, 0 if left out; existence (n,)
    probability that a node is a real object, 1 if left out; outline: by row, the polyline (k, 2) of a stop line (its
    left and right end) or of a lane (its centre); width: by row, of a lane, m; lanes: those that cross stop lines,
    these by row; paths: predicted ones; acted (n,) mask of nodes that others may act on, None: all; derived: values
    that rules share, kept with the table
    """

    id: IntArray
    label: StrArray
    types: tuple[NodeType, ...]
    position: FloatArray
    velocity: FloatArray
    heading: FloatArray
    length: FloatArray
    velocity_variance: FloatArray
    has_moved: FloatArray | BoolArray = None  # type: ignore[assignment]  # arrays from construction on
    closed: FloatArray = None  # type: ignore[assignment]
    outline: Mapping[int, FloatArray] = field(default_factory=dict)
    width: Mapping[int, float] = field(default_factory=dict)
    unseen: FloatArray = None  # type: ignore[assignment]
    existence: FloatArray = None  # type: ignore[assignment]
    open: FloatArray = None  # type: ignore[assignment]
    lanes: LanesAcross | None = None
    paths: Paths | None = None
    acted: BoolArray | None = None
    derived: dict[object, Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        usual = {"has_moved": 1.0, "closed": 0.0, "open": 0.0, "unseen": 0.0, "existence": 1.0}
        for name, value in usual.items():
            if getattr(self, name) is None:
                vars(self)[name] = np.full(len(self), value)

    def __len__(self) -> int:
        return len(self.id)

    def append(self, other: NodeTable) -> NodeTable:
        """With the nodes of another, which have no paths, after these; its lanes are by the rows of the whole."""
        mine, its, n = vars(self), vars(other), len(self)
        columns: dict[str, Any] = {k: np.concatenate([v, its[k]]) for k, v in mine.items() if isinstance(v, np.ndarray)}
        for name in ("outline", "width"):
            columns[name] = {**mine[name], **{n + row: value for row, value in its[name].items()}}
        whole: dict[str, Any] = {"types": self.types + other.types, "lanes": other.lanes, "derived": {}}
        return unchecked(NodeTable, **mine | columns | whole)

    def along(self, target: IntArray, source: IntArray) -> Along:
        """Places of nodes `source` (E,) along the paths of nodes `target` (E,)."""
        paths, path = NO_PATHS if self.paths is None else self.paths, np.full(len(self), -1)
        path[paths.row] = np.arange(len(paths))
        return Along(*places_along(self.position, self.heading, path, paths.position, target, source))

    def select(self, rows: IntArray) -> NodeTable:
        """The nodes `rows` (k,), ascending. Raises `TypeError` for a column of a kind that cannot be selected."""
        chosen = rows.tolist()
        columns: dict[str, Any] = {"types": tuple(map(self.types.__getitem__, chosen)), "derived": {}}
        for name, value in self.__dict__.items():
            if isinstance(value, np.ndarray):
                columns[name] = value.take(rows, 0)
                columns[name].flags.writeable = False  # labels that are never changed are looked up once
            elif isinstance(value, Paths | LanesAcross):
                columns[name] = value.of_nodes(rows)
            elif isinstance(value, Mapping):
                place = dict(zip(chosen, range(len(chosen)), strict=True)) if value and name != "derived" else {}
                columns[name] = {place[row]: entry for row, entry in value.items() if row in place}
            elif name != "types" and value is not None:
                raise TypeError(f"nodes: {name} is a {type(value).__name__}, which cannot be selected by rows")
            elif value is None:
                columns[name] = None
        return unchecked(NodeTable, **columns)


class Triples(NamedTuple):
    """A_self (E, d_i, d_i), A_other (E, d_i, d_j), b (E, d_i)."""

    A_self: FloatArray
    A_other: FloatArray
    b: FloatArray


@part_kind("interaction", "saga_fg.interactions")
class Interaction(Protocol):
    """An interaction function, evaluated for E edges between nodes of one type and nodes of one type."""

    @property
    def needs(self) -> Needs:
        """Components that target and source must have."""
        ...

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        """The triples of the edges source[k] -> target[k] (rows of `nodes`)."""
        ...


@dataclass(frozen=True)
class SharedVelocity:
    """Consensus of velocities: a node relaxes towards the velocity of its neighbour at the edge's rate.

    The neighbour decides how fast it is, so that an acceleration of its own fades at the same rate.
    """

    needs: ClassVar[Needs] = (VELOCITY, VELOCITY)
    along_heading: bool = setting(
        False, "true: turn the neighbour's velocity by the difference of headings, for queues in bends"
    )

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        turn = nodes.heading[target] - nodes.heading[source] if self.along_heading else np.zeros(len(target))
        c, s = np.cos(turn), np.sin(turn)
        R = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
        triples = velocity_triples(nodes, target, source, by_velocity=-np.eye(2), by_other_velocity=R)
        own = nodes.types[target[0]]
        if own.has(ACCELERATION):
            a = own.index(ACCELERATION)
            triples.A_self[:, a[:, None], a] = -np.eye(2)
        return triples


@dataclass(frozen=True)
class CarFollowing(Settings):
    """Helly's linear car-following law along the follower's heading; the source is the leader."""

    needs: ClassVar[Needs] = (POSITION + VELOCITY, POSITION + VELOCITY)
    time_constant: PositiveOrInf = setting(
        4.0, "tau: time constant with which a wrong gap closes, s; usual 1 to 10; .inf: share speeds only"
    )
    headway: NonNegative = setting(
        0.0, "growth of the desired gap with the follower's speed, s; usual 0 to 2; higher: larger gaps at speed"
    )

    def triples(self, nodes: NodeTable, target: IntArray, source: IntArray) -> Triples:
        u_i, u_j = (unit(nodes.heading[rows]) for rows in (target, source))
        place = nodes.along(target, source)
        t_j = unit(place.direction)
        along, onward = u_i[:, :, None] * u_i[:, None, :], u_i[:, :, None] * t_j[:, None, :]
        constant = -self.headway * (nodes.velocity[target] * u_i).sum(axis=1)
        constant += ((nodes.position[source] * t_j) - (nodes.position[target] * u_i)).sum(axis=1)
        return velocity_triples(
            nodes,
            target,
            source,
            by_position=-along / self.time_constant,
            by_velocity=-along * (1 + self.headway / self.time_constant),
            by_other_position=onward / self.time_constant,
            by_other_velocity=u_i[:, :, None] * u_j[:, None, :],
            constant=-u_i * (constant / self.time_constant)[:, None],
        )


def unit(heading: FloatArray) -> FloatArray:
    """Unit vectors (n, 2) of headings (n,), rad."""
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def ahead_and_aside(offset: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Components of offsets (..., 2) along directions u (..., 2) and to the left of them."""
    return np.einsum("...i,...i->...", offset, u), u[..., 0] * offset[..., 1] - u[..., 1] * offset[..., 0]


def applies(needs: Needs, target: NodeType, source: NodeType) -> bool:
    """True if nodes of these types have the components that an interaction needs."""
    own, other = needs
    return target.has(own) and source.has(other)


def velocity_triples(
    nodes: NodeTable,
    target: IntArray,
    source: IntArray,
    by_position: FloatArray | None = None,
    by_velocity: FloatArray | None = None,
    by_other_position: FloatArray | None = None,
    by_other_velocity: FloatArray | None = None,
    constant: FloatArray | None = None,
) -> Triples:
    """The triples of E edges that act on velocities in the plane.

    by_...: derivatives of dv_i/dt, (2, 2) or (E, 2, 2), by position and velocity of target and source; constant (E, 2)
    """
    own, other, v = nodes.types[target[0]], nodes.types[source[0]], nodes.types[target[0]].index(VELOCITY)
    E = len(target)
    triples = Triples(np.zeros((E, own.dim, own.dim)), np.zeros((E, own.dim, other.dim)), np.zeros((E, own.dim)))
    for matrix, kind, names, block in (
        (triples.A_self, own, POSITION, by_position),
        (triples.A_self, own, VELOCITY, by_velocity),
        (triples.A_other, other, POSITION, by_other_position),
        (triples.A_other, other, VELOCITY, by_other_velocity),
    ):
        if block is not None:
            matrix[:, v[:, None], kind.index(names)] = block
    if constant is not None:
        triples.b[:, v] = constant
    return triples
