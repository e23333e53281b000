"""Edge rules: who acts on whom, at which rate; rigid bonds of trailers and riders.

rate_ij = r_j * rate * exp( -d_ij^2 / (2 distance_scale^2) ) * exp( -dheading_ij^2 / (2 heading_scale^2) ) * ...
              r_j * rate * exp( -ahead_ij / gap_scale ) * ...                                  behind a leader

The nearer a leader, the sooner its speed becomes one's own; on recorded traffic this decides more than how the law
depends on the gap. r_j is the probability that the source exists: the rate is the expected one, and clutter pulls at
nobody.
A rule is any object with `interaction` and `pairs(nodes)`; pass your own to the tracker in place of these.

Information gain of an edge: how much the velocity of its source says about that of its target.

    gain_ij = s_i^2 / ( s_i^2 + s_j^2 + spread^2 ),     s^2 = variance of the velocity + ( `UNSEEN_ACCELERATION` t )^2

This is the gain of a Kalman filter that takes the velocity of j, off by the spread, for a measurement of that of i. A
detected object learns more from its detections than from neighbours, who pull on a bus that brakes for its stop; a
hidden one soon has nothing else to go by. t is the time since an object was last detected: the variance that a filter
states rests on the noise of corrected states, and an object out of sight may have braked since. The gain of edges into
detected objects is therefore low.

The line that cones and barriers form ahead of a vehicle.

In the frame of the vehicle (a ahead, y to the left), the cones near its path, in order of a, are a line y(a). Its side
is that of the nearest cone, and the vehicle has to pass on the other one: with m = +1 if that is the left, else -1, and
the distance c that drivers keep between cones and the middle of their vehicle,

    demand(a) = m y(a) + c         how far to the side the vehicle has to be by a; above 0: it is pushed

Rigid bonds, of a trailer and its truck, of a bicycle and its rider:

    dv_i/dt += rate ( v_j - v_i + ( p_j - p_i - d_ij ) / tau ),    d_ij the offset at the start of the interval

Edges go both ways: each takes on the other's velocity and keeps its place relative to it, so that detections of one
correct the other as well. From one interval to the next the offset may turn with the pair.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from saga_fg.kernels.edges import leader_rates, neighbour_rates, pairs_ahead
from saga_fg.model.interactions import (
    NO_PATHS,
    POSITION,
    SHARP,
    VELOCITY,
    CarFollowing,
    Interaction,
    Needs,
    NodeTable,
    SharedVelocity,
    Triples,
    ahead_and_aside,
    unit,
    velocity_triples,
)
from saga_fg.model.nonlinear_interactions import (
    AccelerationLaw,
    IntelligentDriver,
    SmoothDriver,
    SocialForce,
    nearest_offset,
)
from saga_fg.numerics import BoolArray, FloatArray, IntArray, near_pairs, of_classes, wrap_angle
from saga_fg.parts import part_kind
from saga_fg.settings import (
    NonNegative,
    NonNegativeInt,
    PositiveOrInf,
    Settings,
    setting,
    settings_group,
)
from saga_fg.types import VEHICLES

CONES = ("traffic_cone", "barrier")  # classes of objects that form a line
CLEARANCE = 1.75  # c, m, usual 1.5 to 2: half a vehicle and half a metre or more
MIN_SPEED = 1.0  # m/s; slower vehicles are not pushed
BESIDE = 3.0  # m behind the middle of a vehicle, up to which a cone is still beside it
CORRIDOR = 6.0  # cones further aside are ignored, m
REACH = 45.0  # cones further ahead are ignored, m


class ConesAhead(NamedTuple):
    """The cones ahead of n vehicles, nearest first: rows (n, m) of nodes; ahead, demand (n, m), m; known (n, m) whether
    there is one; side (n,) m; speed (n,) along the heading, m/s."""

    row: IntArray
    ahead: FloatArray
    demand: FloatArray
    known: BoolArray
    side: FloatArray
    speed: FloatArray


def cones_ahead(nodes: NodeTable, vehicles: IntArray) -> ConesAhead:
    """The cones ahead of `vehicles` (n,), rows of `nodes`."""
    cones = np.flatnonzero(of_classes(nodes.label, CONES))
    u = unit(nodes.heading[vehicles])
    offset = nodes.position[cones] - nodes.position[vehicles, None]
    ahead, left = ahead_and_aside(offset, u[:, None])
    known = (ahead > -BESIDE) & (ahead < REACH) & (np.abs(left) < CORRIDOR)
    order = np.argsort(np.where(known, ahead, np.inf), axis=1)
    ahead, left = (np.take_along_axis(x, order, axis=1) for x in (ahead, left))
    known = np.take_along_axis(known, order, axis=1)
    first = left[:, 0] if len(cones) else np.zeros(len(vehicles))
    side = np.where(first < 0, 1.0, -1.0)
    demand = side[:, None] * left + CLEARANCE
    speed = np.einsum("ni,ni->n", nodes.velocity[vehicles], u)
    return ConesAhead(cones[order], ahead, demand, known, side, speed)


def anticipated(nodes: NodeTable, classes: tuple[str, ...]) -> FloatArray:
    """Positions (n, 2) of all nodes, those of vehicles moved aside as far as the cones before them will push them."""
    position = nodes.position.copy()
    vehicles = np.flatnonzero(of_classes(nodes.label, classes))
    line = cones_ahead(nodes, vehicles)
    pushed = np.where(line.known & (line.ahead > 0), line.demand, 0.0).max(axis=1, initial=0.0)
    pushed = np.where(line.speed > MIN_SPEED, pushed, 0.0)
    u = unit(nodes.heading[vehicles])
    position[vehicles] += (line.side * pushed)[:, None] * np.stack([-u[:, 1], u[:, 0]], axis=-1)
    return position


INFORMATION_GAIN = (
    "true: weight edges by their information gain, so that they act on objects that are hidden, and hardly on others; "
    "false: full weight"
)
SPREAD = 0.5  # standard deviation of the difference between the velocities of a pair, m/s
UNSEEN_ACCELERATION = 2.0  # growth of the velocity deviation of undetected objects, m/s^2
MIN_ABSENCE = 1e-9  # probability that a certain object does not exist


def pairs_within(
    position: FloatArray, targets: BoolArray, sources: BoolArray, radius: float
) -> tuple[IntArray, IntArray]:
    """All pairs (E,) of different rows of two masks (n,) within `radius` m: target rows, source rows."""
    to, of = targets.nonzero()[0], sources.nonzero()[0]
    i, j = near_pairs(position[to], position[of], np.full(len(to), radius))
    target, source = to[i], of[j]
    different = target != source
    return target[different], source[different]


def strongest(target: IntArray, rate: FloatArray, n: int, degree: int) -> IntArray:
    """Rows (k,) of at most `degree` edges into each of n nodes, the strongest of E edges: target (E,), rate (E,)."""
    order = np.lexsort((-rate, target))
    rank = np.arange(len(order)) - np.searchsorted(target[order], np.arange(n))[target[order]]
    return order[rank < degree]


Leaders = Literal["any", "moving", "stationary"]


class Pairs(NamedTuple):
    """E directed edges source -> target (rows of a `NodeTable`) with their rates, 1/s."""

    target: IntArray
    source: IntArray
    rate: FloatArray


@part_kind("edge rule", "saga_fg.edge_rules")
class EdgeRule(Protocol):
    """Chooses edges from the estimates at the start of an interval.

    A rule that has `map_classes` reads nodes of the map of these classes alone; nodes that no rule reads are left out.
    One that has `relation` gives its edges a name for people, such as "follows", else they have that of its type.
    """

    @property
    def interaction(self) -> Interaction | AccelerationLaw: ...

    def pairs(self, nodes: NodeTable) -> Pairs: ...


def acting_classes(rules: Iterable[EdgeRule]) -> set[str]:
    """The classes of objects that some of the rules act on."""
    return {label for rule in rules for label in getattr(rule, "classes", getattr(rule, "attached", ()))}


@dataclass(frozen=True)
class Neighbours(Settings):
    """Edges between moving objects that are close and head the same way; by default they share their velocity."""

    map_classes: ClassVar[tuple[str, ...]] = ()
    relation: ClassVar[str] = "moves with"
    interaction: SharedVelocity | CarFollowing | Interaction | AccelerationLaw = settings_group(
        SharedVelocity, "interaction function of the edges"
    )
    rate: NonNegative = setting(
        0.3, "strength of an edge at distance and heading difference zero, 1/s; usual 0.2 to 0.6"
    )
    distance_scale: PositiveOrInf = setting(8.0, "sigma of the kernel on the distance, m; .inf: no kernel")
    heading_scale: PositiveOrInf = setting(
        0.4, "sigma of the kernel on the difference of headings, rad; .inf: no kernel; higher: edges in bends, too"
    )
    speed_scale: PositiveOrInf = setting(
        3.0, "sigma of the kernel on the difference of velocities, m/s; .inf: no kernel"
    )
    max_distance: NonNegative = setting(
        20.0, "no edge beyond this distance, m; usual 10 to 40; higher: more edges, slower"
    )
    min_speed: NonNegative = setting(
        1.0, "no edge to or from objects slower than this, m/s; usual 0.5 to 2; higher: slow traffic is left alone"
    )
    max_degree: NonNegativeInt = setting(4, "largest number of edges into one object, the strongest; higher: slower")
    information_gain: bool = setting(False, INFORMATION_GAIN)
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")

    def pairs(self, nodes: NodeTable) -> Pairs:
        able = of_classes(nodes.label, self.classes) & (np.hypot(*nodes.velocity.T) >= self.min_speed)
        target, source = pairs_within(nodes.position, _acted(nodes, able), able, self.max_distance)
        _, _, variance, spread = _columns(nodes, self.information_gain)
        direction = nodes.along(target, source).direction
        found = neighbour_rates(
            target=target,
            source=source,
            direction=direction,
            position=nodes.position,
            velocity=nodes.velocity,
            heading=nodes.heading,
            variance=variance,
            rate=self.rate,
            distance_scale=self.distance_scale,
            heading_scale=self.heading_scale,
            speed_scale=self.speed_scale,
            max_distance=self.max_distance,
            min_speed=self.min_speed,
            degree=self.max_degree,
            spread=spread,
        )
        return Pairs(*found)


@dataclass(frozen=True)
class Following(Settings):
    """A vehicle is led by the nearest vehicle ahead in its lane, as estimated from headings.

    Where it is not certain that the nearest exists, the next ones lead with the probability that none before them does.
    All vehicles count there: one that is not among `leaders` leads nobody, but blocks those ahead of it.
    """

    map_classes: ClassVar[tuple[str, ...]] = ()
    relation: ClassVar[str] = "follows"
    interaction: SharedVelocity | CarFollowing | IntelligentDriver | SmoothDriver | Interaction | AccelerationLaw = (
        settings_group(CarFollowing, "interaction function of the edges")
    )
    rate: NonNegative = setting(1.0, "strength of an edge right behind the leader, straight ahead, 1/s; usual 0.5 to 4")
    max_gap: NonNegative = setting(
        40.0,
        "no edge from a leader further ahead than this, centre to centre, m; usual 20 to 80; higher: more "
        "edges, slower",
    )
    gap_scale: PositiveOrInf = setting(
        20.0,
        "distance ahead over which the strength falls to 37 %, m; usual 10 to 30, .inf: it does not; higher: leaders "
        "far ahead count more",
    )
    lateral_scale: PositiveOrInf = setting(
        1.2,
        "sigma of the kernel on the leader's lateral offset, m; usual a third of a lane; higher: leaders in "
        "adjacent lanes count, too",
    )
    heading_scale: PositiveOrInf = setting(
        0.4, "sigma of the kernel on the difference of headings, rad; .inf: no kernel; higher: edges in bends, too"
    )
    information_gain: bool = setting(False, INFORMATION_GAIN)
    parked: bool = setting(
        False, "true: vehicles that were never seen moving follow, too, leaders within lateral_scale"
    )
    min_separation: NonNegative = setting(
        0.0, "ignore leaders nearer than this share of half of both lengths: they are duplicates; usual 0 to 0.8"
    )
    leaders: Leaders = setting(
        "any", "which vehicles lead where nothing stands between: any; moving: once seen moving; stationary: all others"
    )
    cones: bool = setting(
        False, "true: leaders and followers are where cones will push them aside, not where they are now"
    )
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")
    towed: tuple[str, ...] = setting(
        (), "classes that lead but do not follow, such as trailers, which go where their truck goes"
    )

    def pairs(self, nodes: NodeTable) -> Pairs:
        if self.cones:
            nodes = replace(nodes, position=anticipated(nodes, self.classes))
        target, source = self._ahead(nodes)
        exists, moved, variance, spread = _columns(nodes, self.information_gain)
        along = nodes.along(target, source)
        found = leader_rates(
            target=target,
            source=source,
            ahead=along.ahead,
            aside=along.aside,
            direction=along.direction,
            predicted=along.predicted,
            position=nodes.position,
            heading=nodes.heading,
            length=nodes.length,
            moved=moved,
            exists=exists,
            variance=variance,
            rate=self.rate,
            max_gap=self.max_gap,
            gap_scale=self.gap_scale,
            lateral_scale=self.lateral_scale,
            heading_scale=self.heading_scale,
            parked=self.parked,
            leaders=("any", "moving", "stationary").index(self.leaders),
            min_separation=self.min_separation,
            spread=spread,
            steepest=_STEEPEST,
            least=MIN_ABSENCE,
        )
        return Pairs(*found)

    def _ahead(self, nodes: NodeTable) -> tuple[IntArray, IntArray]:
        """All pairs that may be in a lane: target rows, source rows."""
        able = of_classes(nodes.label, self.classes)
        follows = _acted(nodes, able) & ~of_classes(nodes.label, self.towed)
        if not self.parked:
            follows = follows & (nodes.has_moved > 0)
        paths = NO_PATHS if nodes.paths is None else nodes.paths
        path = np.full(len(nodes), -1)
        path[paths.row] = np.arange(len(paths))
        aside, widening = 3 * self.lateral_scale, math.tan(min(3 * self.heading_scale, 1.5) / 2)
        direction, turn, margin = paths.cones(aside)
        return pairs_ahead(
            position=nodes.position,
            heading=nodes.heading,
            follows=follows,
            able=able,
            farthest=self.max_gap,
            aside=aside,
            widening=widening,
            path=path,
            begin=paths.position[:, 0],
            direction=direction,
            turn=turn,
            margin=margin,
            sharp=SHARP,
        )


PUSHING_DISTANCE = 4.0  # m; beyond, the force is less than a thousandth of that of a touch
PUSHING = 4  # sources of one object, the nearest


@dataclass(frozen=True)
class Repulsion(Settings):
    """Edges between pedestrians that keep away from each other; `sources: [wall]`: from walls of the road map."""

    classes: ClassVar[tuple[str, ...]] = ("pedestrian",)
    interaction: ClassVar[SocialForce] = SocialForce()
    relation: ClassVar[str] = "keeps away from"
    sources: tuple[str, ...] = setting(("pedestrian",), "classes that push; more: pushed by more")

    @property
    def map_classes(self) -> tuple[str, ...]:
        """Classes of nodes of the map that push."""
        return self.sources

    def pairs(self, nodes: NodeTable) -> Pairs:
        pushed, pushing = (of_classes(nodes.label, names).nonzero()[0] for names in (self.classes, self.sources))
        target, source = np.repeat(pushed, len(pushing)), np.tile(pushing, len(pushed))
        target, source = target[target != source], source[target != source]
        given = self.interaction.given(nodes, target, source)
        apart = nearest_offset(nodes.position[target] - nodes.position[source], given)
        distance = np.hypot(*apart.T)
        near = (distance <= PUSHING_DISTANCE).nonzero()[0]
        near = near[strongest(target[near], -distance[near], len(nodes), PUSHING)]
        return Pairs(target[near], source[near], np.ones(len(near)))


_STEEPEST = 1.5  # rad, turn of an arc


def traffic_rules() -> tuple[Following, Neighbours]:
    """The default rules: a hidden vehicle follows a leader that moves, and people walk in groups."""
    leader = Following(
        SharedVelocity(),
        rate=3.0,
        max_gap=60.0,
        gap_scale=16.0,
        lateral_scale=1.2,
        min_separation=0.8,
        leaders="moving",
        information_gain=True,
    )
    group = Neighbours(
        classes=("pedestrian",),
        rate=1.0,
        distance_scale=1.5,
        max_distance=4.5,
        heading_scale=3.0,
        speed_scale=1.0,
        min_speed=0.2,
        information_gain=True,
    )
    return leader, group


def _acted(nodes: NodeTable, able: BoolArray) -> BoolArray:
    """The `able` (n,) nodes that others may act on."""
    return able if nodes.acted is None else able & nodes.acted


def _columns(nodes: NodeTable, information: bool) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Existence, share that moves and velocity variance of n nodes; the spread, -1 where information does not count."""
    exists, moved = nodes.existence, np.asarray(nodes.has_moved, dtype=np.float64)
    if not information:
        return exists, moved, np.ones(len(nodes)), -1.0
    return exists, moved, nodes.velocity_variance + (UNSEEN_ACCELERATION * nodes.unseen) ** 2, SPREAD


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
    relation: ClassVar[str] = "is attached to"
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
