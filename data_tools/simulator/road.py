"""Roads and lanes of the simulated world, vehicles on them and the models of their drivers.

Roads: a smooth centre line, and coordinates along and across it.

A position is given by s, the distance along the centre line, and d, the distance to its left (Frenet coordinates):

    p(s, d) = c(s) + d n(s),      c'(s) = t(s),      heading'(s) = kappa(s),      dp/ds at constant d = (1 - kappa d) t

The curvature kappa is a sum of smooth bumps; heading and centre line are its first and second integral on a fine grid.

Lanes along the centre line of a road, each with a direction of travel; one of them may join and end.

Along a lane, distance is measured in its direction of travel: road s for forward lanes, length - s for oncoming ones.
An ending lane that starts `approach` m outside the road is an on-ramp; with approach 0 it is a lane drop. It may also
be closed by cones, which move its traffic into the adjacent lane over the last `taper` m.

Driver models of car following and lane changes: the Intelligent Driver Model (IDM) and MOBIL.

IDM (Treiber, Hennecke, Helbing 2000, doi 10.1103/PhysRevE.62.1805, equations 3 and 4):

    dv/dt = a [ 1 - (v / v0)^4 - (s*(v, dv) / s)^2 ],     s*(v, dv) = s0 + max(0, v T + v dv / (2 sqrt(a b)))

with v the speed, s the gap to the leader, bumper to bumper, and dv = v - v_leader the approach rate. A driver faster
than his desired speed, which happens when the speed limit drops, brakes with b at most for that reason. In equilibrium
(dv/dt = 0, dv = 0) the gap is s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4).

MOBIL (Kesting, Treiber, Helbing 2007, doi 10.3141/1999-10): with a the present acceleration of a driver, a' that behind
his new leader, and o, o' those of his new follower without and with him, he changes lanes if

    o' > -b_safe  and  a' > -b_safe                    nobody has to brake hard (gap acceptance)
    a' - a + p (o' - o) > threshold                    the gain is large enough

In a lane that ends the second condition is waived. Gaps of at least s0 / 2 are required on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.settings import VAN_SHARE, TrafficSettings
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray

GRID = 0.5  # m


@dataclass(frozen=True, eq=False)
class Road:
    """A centre line sampled every `GRID` m from s = 0, in world coordinates.

    point (G, 2) m, heading (G,) rad (not wrapped), curvature (G,) 1/m.
    """

    point: FloatArray
    heading: FloatArray
    curvature: FloatArray

    @property
    def length(self) -> float:
        return GRID * (len(self.heading) - 1)

    def curvature_at(self, s: FloatArray) -> FloatArray:
        """Curvature, 1/m, at s of any shape; the road runs on straight beyond its ends."""
        position = np.clip(s / GRID, 0, len(self.curvature) - 1)
        return np.asarray(self.curvature[position.astype(np.int64)])

    def heading_at(self, s: FloatArray) -> FloatArray:
        """Direction of the centre line, rad, at s of any shape."""
        return np.interp(s, GRID * np.arange(len(self.heading)), self.heading)

    def position(self, s: FloatArray, d: FloatArray) -> FloatArray:
        """World coordinates (..., 2) of positions s, d (...), m."""
        grid = GRID * np.arange(len(self.heading))
        inside = np.clip(s, 0, self.length)
        heading = self.heading_at(inside)
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
        centre = np.stack([np.interp(inside, grid, self.point[:, axis]) for axis in (0, 1)], axis=-1)
        return np.asarray(centre + (s - inside)[..., None] * tangent + d[..., None] * normal)


def curved_road(length: float, bends: list[tuple[float, float, float]], start: FloatArray, heading: float) -> Road:
    """A road of `length` m from `start` (2,) in direction `heading`, rad.

    Each bend is (middle, m along the road; total turn, rad, left positive; length, m): a curvature bump of the shape
    1 + cos, whose peak is 2 turn / length.
    """
    s = GRID * np.arange(round(length / GRID) + 1)
    curvature = np.zeros_like(s)
    for middle, turn, extent in bends:
        phase = np.clip((s - middle) / extent, -0.5, 0.5)
        curvature += turn / extent * (1 + np.cos(2 * np.pi * phase))
    direction = heading + _integral(curvature)
    point = start + np.stack([_integral(np.cos(direction)), _integral(np.sin(direction))], axis=-1)
    return Road(point, direction, curvature)


def _integral(values: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2)]) * GRID


SPAN = 1.0e6  # m, longer than any road


def smooth_step(share: FloatArray) -> FloatArray:
    """6 x^5 - 15 x^4 + 10 x^3, clipped to [0, 1]: from 0 to 1 with vanishing slope and curvature at both ends."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x**3 * (x * (6 * x - 15) + 10))


def smooth_step_slope(share: FloatArray) -> FloatArray:
    """Derivative of `smooth_step`."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(30 * x**2 * (1 - x) ** 2)


@dataclass(frozen=True, eq=False)
class Lanes:
    """The lanes of a road, numbered forward lanes first, from the middle of the road outwards.

    road
    offset     (L,) distance of each lane to the left of the centre line, m (where it runs beside the road)
    direction  (L,) +1 forward, -1 oncoming
    ending     the lane that ends, or -1
    end        distance at which it ends, m
    opening    distance from which vehicles may leave it, m
    approach   lateral distance from the road at which it starts, m
    taper      length over which cones move its traffic into the adjacent lane, m; 0: no cones
    """

    road: Road
    offset: FloatArray
    direction: IntArray
    ending: int = -1
    end: float = np.inf
    opening: float = 0.0
    approach: float = 0.0
    approach_length: float = 120.0
    taper: float = 0.0

    @property
    def forward(self) -> IntArray:
        return np.flatnonzero(self.direction > 0)

    @property
    def oncoming(self) -> IntArray:
        return np.flatnonzero(self.direction < 0)

    @property
    def adjacent(self) -> int:
        """The lane that traffic of the ending lane joins."""
        return self.ending - 1

    def lateral(self, lane: IntArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offset d of the lanes' middle at travelled s, m, and its derivative by s; lane and s of one shape."""
        d = self.offset[lane]
        if self.taper > 0:
            share = (s - self.end) / self.taper + 1
            aside = np.where(lane == self.ending, self.offset[self.adjacent] - self.offset[self.ending], 0.0)
            return d + aside * smooth_step(share), aside * smooth_step_slope(share) / self.taper
        if self.ending < 0 or self.approach == 0:
            return d, np.zeros_like(d)
        share = (self.opening - s) / self.approach_length
        here = lane == self.ending
        outside = np.where(here, self.approach, 0.0)
        slope = outside * smooth_step_slope(share) / self.approach_length
        return d - outside * smooth_step(share), slope

    def road_s(self, lane: IntArray, s: FloatArray) -> FloatArray:
        """Road coordinate of travelled s, m."""
        return np.where(self.direction[lane] > 0, s, self.road.length - s)

    def neighbour(self, lane: IntArray, side: int) -> IntArray:
        """The lane on the left (side -1) or right (+1) as the driver sees it, or -1."""
        other = lane + side
        exists = (other >= 0) & (other < len(self.offset))
        other = np.where(exists, other, 0)
        return np.where(exists & (self.direction[other] == self.direction[lane]), other, -1)

    def may_change(self, lane: IntArray, target: IntArray, s: FloatArray) -> BoolArray:
        """True where a change from `lane` to the neighbour `target` is allowed at s; nobody enters an ending lane."""
        allowed = (target >= 0) & (target != self.ending if self.ending >= 0 else True)
        if self.taper > 0:
            return np.asarray(allowed & (lane != self.ending))
        return np.asarray(allowed & ((lane != self.ending) | (s >= self.opening)))

    def pose(self, lane: IntArray, s: FloatArray, d: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """World position (..., 2), m, and heading (...), rad, at travelled s, offset d, where dd/ds = `slope`."""
        sign = self.direction[lane]
        along = self.road_s(lane, s)
        stretch = 1 - self.road.curvature_at(along) * d
        tangent = self.road.heading_at(along)
        heading = tangent + np.where(sign > 0, 0.0, np.pi) + sign * np.arctan2(slope, stretch)
        return self.road.position(along, d), heading

    def metric(self, lane: IntArray, s: FloatArray, d: FloatArray, slope: FloatArray) -> FloatArray:
        """Length travelled over ground per unit of s, at places as in `pose`."""
        return np.hypot(1 - self.road.curvature_at(self.road_s(lane, s)) * d, slope)


@dataclass(frozen=True, eq=False)
class LaneOrder:
    """Vehicles sorted by lane and distance, to find leaders and followers: keys lane * SPAN + s (E,), vehicles (E,)."""

    key: FloatArray
    vehicle: IntArray

    @classmethod
    def by_position(cls, s: FloatArray, lanes: IntArray) -> LaneOrder:
        """Sort vehicles by s (N,), m, in the lanes (N, 2) that each occupies: -1 for none, two during a change."""
        rows, columns = np.nonzero(lanes >= 0)
        key = lanes[rows, columns] * SPAN + s[rows]
        order = np.argsort(key, kind="stable")
        return cls(key[order], rows[order])

    def ahead(self, lane: IntArray, s: FloatArray) -> IntArray:
        """First vehicle (N,) beyond s (N,) in lane (N,), or -1; lanes may be -1."""
        return self._at(np.searchsorted(self.key, lane * SPAN + s, side="right"), lane)

    def behind(self, lane: IntArray, s: FloatArray) -> IntArray:
        """Last vehicle (N,) before s (N,) in lane (N,), or -1."""
        return self._at(np.searchsorted(self.key, lane * SPAN + s, side="left") - 1, lane)

    def _at(self, place: IntArray, lane: IntArray) -> IntArray:
        if len(self.key) == 0:
            return np.full(len(place), -1)
        inside = np.clip(place, 0, len(self.key) - 1)
        same = (inside == place) & (lane >= 0) & (np.floor_divide(self.key[inside], SPAN) == lane)
        return np.where(same, self.vehicle[inside], -1)


HARDEST_BRAKING = 9.0  # m/s^2, limit of tyres on a dry road
POLITENESS = 0.3  # p of MOBIL (Kesting, Treiber and Helbing 2007): weight of the new follower's loss
CHANGE_THRESHOLD = 0.3  # a_th of MOBIL, m/s^2: least gain for which a driver changes lanes
SAFE_DECELERATION = 3.0  # b_safe of MOBIL, m/s^2: largest deceleration a lane change may cause


@dataclass(frozen=True, eq=False)
class Drivers(Columns):
    """The parameters of N drivers, each of shape (N,), or broadcastable."""

    desired_speed: FloatArray  # v0, m/s
    time_headway: FloatArray  # T, s
    minimum_gap: FloatArray  # s0, m
    max_acceleration: FloatArray  # a, m/s^2
    comfortable_deceleration: FloatArray  # b, m/s^2


def free_acceleration(speed: FloatArray, drivers: Drivers, speed_limit: FloatArray | float = np.inf) -> FloatArray:
    """Acceleration (N,), m/s^2, on an empty road with a speed limit, m/s."""
    desired = np.minimum(drivers.desired_speed, speed_limit)
    acceleration = drivers.max_acceleration * (1 - (speed / desired) ** 4)
    return np.asarray(np.maximum(acceleration, -drivers.comfortable_deceleration))


def following_acceleration(
    speed: FloatArray, gap: FloatArray, leader_speed: FloatArray, drivers: Drivers
) -> FloatArray:
    """Interaction term -a (s*/s)^2 (N,), m/s^2: 0 for an infinite gap, bounded by `HARDEST_BRAKING`."""
    root = 2 * np.sqrt(drivers.max_acceleration * drivers.comfortable_deceleration)
    desired_gap = drivers.minimum_gap + np.maximum(
        0.0, speed * drivers.time_headway + speed * (speed - leader_speed) / root
    )
    term = drivers.max_acceleration * (desired_gap / np.maximum(gap, 0.01)) ** 2
    return np.asarray(-np.minimum(term, HARDEST_BRAKING))


def equilibrium_gap(speed: FloatArray | float, drivers: Drivers) -> FloatArray:
    """Gap s_e(v) (N,), m, at which drivers follow a leader of constant `speed` below their desired speed."""
    ratio = np.asarray(speed, dtype=np.float64) / drivers.desired_speed
    return np.asarray((drivers.minimum_gap + speed * drivers.time_headway) / np.sqrt(1 - ratio**4))


def lane_change_gain(
    drivers: Drivers,
    length: FloatArray,
    s: FloatArray,
    speed: FloatArray,
    acceleration: FloatArray,
    target: IntArray,
    must: BoolArray,
    order: LaneOrder,
) -> FloatArray:
    """Gain (N,), m/s^2, of each driver in lane `target` (N,; -1: none); -inf where the change is not allowed.

    length and s m, speed m/s and acceleration m/s^2 (N,): the present state; must (N,): the present lane ends.
    """
    leader, follower = order.ahead(target, s), order.behind(target, s)
    half = length / 2
    front = np.where(leader >= 0, s[leader] - s - half[leader] - half, np.inf)
    rear = np.where(follower >= 0, s - s[follower] - half[follower] - half, np.inf)
    mine = free_acceleration(speed, drivers) + following_acceleration(speed, front, speed[leader], drivers)
    others = drivers.select(follower)
    theirs = free_acceleration(speed[follower], others) + following_acceleration(speed[follower], rear, speed, others)
    loss = np.where(follower >= 0, np.maximum(acceleration[follower] - theirs, 0.0), 0.0)
    safe = (mine > -SAFE_DECELERATION) & ((theirs > -SAFE_DECELERATION) | (follower < 0))
    room = (front > drivers.minimum_gap / 2) & (rear > drivers.minimum_gap / 2)
    gain = mine - acceleration - POLITENESS * loss
    worth = must | (gain > CHANGE_THRESHOLD)
    return np.where((target >= 0) & safe & room & worth, gain + np.where(must, 100.0, 0.0), -np.inf)


def best_lane_changes(gain: FloatArray, target: IntArray) -> IntArray:
    """Rows (C,) of the drivers who change now: for each target lane (N,) the one with the largest finite gain (N,)."""
    candidates = np.flatnonzero(np.isfinite(gain))
    best = candidates[np.argsort(-gain[candidates], kind="stable")]
    _, first = np.unique(target[best], return_index=True)
    return best[np.sort(first)]


TIME_HEADWAY = 1.2  # T of the IDM (Treiber, Hennecke and Helbing 2000), s: desired time headway
MINIMUM_GAP = 2.0  # s0 of the IDM, m: gap kept at standstill
MAX_ACCELERATION = 1.5  # a of the IDM, m/s^2: maximum acceleration
COMFORTABLE_DECELERATION = 2.0  # b of the IDM, m/s^2: comfortable deceleration
DRIVER_SPREAD = 0.15  # relative standard deviation of the parameters over drivers (log-normal)


@dataclass(frozen=True)
class Kind:
    """Kind of vehicle: class label, mean and deviation of its size, m, and driver parameters relative to a car."""

    name: str
    label: str
    size: tuple[float, float, float]
    spread: tuple[float, float, float]
    speed: float = 1.0
    headway: float = 1.0
    acceleration: float = 1.0


KINDS = (
    Kind("car", "car", (4.6, 1.85, 1.58), (0.3, 0.07, 0.1)),
    Kind("van", "car", (5.3, 2.0, 2.15), (0.4, 0.06, 0.2)),
    Kind("truck", "truck", (8.5, 2.45, 3.3), (1.4, 0.1, 0.3), speed=0.9, headway=1.2, acceleration=0.65),
    Kind("bus", "bus", (11.8, 2.5, 3.1), (0.7, 0.05, 0.15), speed=0.9, headway=1.15, acceleration=0.7),
)
CAR, VAN, TRUCK, BUS = range(4)
HITCH = 0.9  # m between truck and trailer
TRAILER_LENGTH = (6.0, 11.0)  # m


@dataclass(frozen=True, eq=False)
class Fleet(Columns):
    """N vehicles: kind (N,) rows of `KINDS`, size (N, 3) m, and drivers of shape (N,)."""

    kind: IntArray
    size: FloatArray
    drivers: Drivers

    @property
    def label(self) -> StrArray:
        return np.array([kind.label for kind in KINDS])[self.kind]

    @property
    def length(self) -> FloatArray:
        return self.size[:, 0]


def sample_sizes(kind: IntArray, rng: np.random.Generator) -> FloatArray:
    """Random sizes (N, 3), m, of vehicles of the given kinds, within two deviations of the mean."""
    mean = np.array([k.size for k in KINDS])[kind]
    spread = np.array([k.spread for k in KINDS])[kind]
    return np.asarray(mean + spread * np.clip(rng.standard_normal(mean.shape), -2, 2))


def sample_fleet(count: int, desired_speed: float, traffic: TrafficSettings, rng: np.random.Generator) -> Fleet:
    """`count` random vehicles; `desired_speed`, m/s, is the mean over the drivers of cars."""
    shares = np.array([VAN_SHARE, traffic.truck_share, traffic.bus_share])
    kind = rng.choice(len(KINDS), size=count, p=[1 - shares.sum(), *shares])

    def spread(mean: float, factor: FloatArray | float = 1.0) -> FloatArray:
        deviation = np.clip(rng.standard_normal(count), -2.5, 2.5)
        return np.asarray(mean * factor * np.exp(DRIVER_SPREAD * deviation))

    speed, headway, acceleration = (
        np.array([getattr(k, name) for k in KINDS])[kind] for name in ("speed", "headway", "acceleration")
    )
    return Fleet(
        kind,
        sample_sizes(kind, rng),
        Drivers(
            spread(desired_speed, speed),
            spread(TIME_HEADWAY, headway),
            spread(MINIMUM_GAP),
            spread(MAX_ACCELERATION, acceleration),
            spread(COMFORTABLE_DECELERATION),
        ),
    )


def attach_trailers(fleet: Fleet, share: float, rng: np.random.Generator) -> tuple[Fleet, FloatArray]:
    """Attach trailers to a share of the trucks: the fleet with total lengths, and lengths (N,) of trailers, m, or 0."""
    trailer = np.zeros(len(fleet))
    if share > 0:
        tows = (fleet.kind == TRUCK) & (rng.random(len(fleet)) < share)
        trailer = np.where(tows, rng.uniform(*TRAILER_LENGTH, len(fleet)), 0.0)
    size = fleet.size.copy()
    size[:, 0] += np.where(trailer > 0, trailer + HITCH, 0.0)
    return replace(fleet, size=size), trailer
