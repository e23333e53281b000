"""Road users of the simulator: vehicles on lanes, trucks with trailers, and pedestrians.

Trajectories of N objects, sampled in time and interpolated between the samples.

Between two samples positions follow the cubic with the given positions and velocities at both ends (Hermite);
velocities and headings are interpolated linearly.

Pedestrians on the pavements, alone and in groups that walk, pause and walk on.

The centre of a group moves along the road: its speed w relaxes with time constant tau to its preferred speed, or to 0
during a pause. Each member has a position in the group and sways about it like a damped spring driven by noise,

    dw = (target - w) / tau dt,      de = u dt,      du = -(omega^2 e + 2 omega u) dt + sqrt(4 omega^3) sigma dW,

which in equilibrium has standard deviation sigma per axis.

Vehicles follow each other, change lanes and react to lights, in small steps.

State of a vehicle: travelled distance s of its centre, m; speed v over ground, m/s; its lane; and, while it changes
lanes, the lane it comes from and the share q of the change it has completed. Each step of length h

    v <- max(0, v + h a),     s <- s + h (v_old + v_new) / 2 / metric,     q <- q + h v / (length of the change)

(ballistic update, Treiber and Kesting, Traffic Flow Dynamics, section 11.5), where the acceleration a is what the
Intelligent Driver Model asked for a reaction time ago, plus random acceleration (an Ornstein-Uhlenbeck process).
The offset from the centre line follows a smooth step of q, so that a vehicle moves sideways only while it rolls.

Trucks that tow a trailer: one long vehicle in traffic, two objects in the scene.

Both parts follow the path of the combination: along the lane, the truck's centre is (total - truck) / 2 ahead of the
centre of the combination, the trailer's is (total - trailer) / 2 behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.road import (
    HARDEST_BRAKING,
    HITCH,
    LaneOrder,
    Lanes,
    Road,
    best_lane_changes,
    following_acceleration,
    free_acceleration,
    lane_change_gain,
    smooth_step,
    smooth_step_slope,
)
from data_tools.simulator.scene_layout import SceneLayout
from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types import Boxes

AT_SAMPLE = 1e-6  # share of a step within which a time is that of a sample


@dataclass(frozen=True, eq=False)
class SimulatedTrajectories:
    """N objects on the ground at T equally spaced times, in world coordinates.

    id, label  (N,)
    size       (N, 3) m
    time       (T,) s
    position   (T, N, 2) m
    velocity   (T, N, 2) m/s
    yaw        (T, N) rad, not wrapped
    present    (T, N) True while the object exists
    """

    id: StrArray
    label: StrArray
    size: FloatArray
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    present: BoolArray

    def __len__(self) -> int:
        return len(self.id)

    def at(self, time: float) -> tuple[Boxes, BoolArray]:
        """All N boxes at `time`, on the ground z = 0, and a mask (N,) of those that exist at both samples around it."""
        step = self.time[1] - self.time[0]
        k = int(np.clip(np.floor((time - self.time[0]) / step), 0, len(self.time) - 2))
        u = (time - self.time[k]) / step
        p0, p1, v0, v1 = self.position[k], self.position[k + 1], self.velocity[k], self.velocity[k + 1]
        position = (
            (1 + 2 * u) * (1 - u) ** 2 * p0 + u**2 * (3 - 2 * u) * p1 + step * u * (1 - u) * ((1 - u) * v0 - u * v1)
        )
        boxes = Boxes(
            self.label,
            np.column_stack([position, self.size[:, 2] / 2]),
            self.size,
            (1 - u) * self.yaw[k] + u * self.yaw[k + 1],
            (1 - u) * v0 + u * v1,
        )
        before, after = self.present[k] | (u > 1 - AT_SAMPLE), self.present[k + 1] | (u < AT_SAMPLE)
        return boxes, before & after

    def select(self, rows: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> SimulatedTrajectories:
        """The objects of some rows."""
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("id", "label", "size")},
            **{name: getattr(self, name)[:, rows] for name in ("position", "velocity", "yaw", "present")},
        )


def concatenated(parts: Sequence[SimulatedTrajectories]) -> SimulatedTrajectories:
    """All objects of `parts`, which share their times."""
    return SimulatedTrajectories(
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in ("id", "label", "size")},
        time=parts[0].time,
        **{
            name: np.concatenate([getattr(p, name) for p in parts], axis=1)
            for name in ("position", "velocity", "yaw", "present")
        },
    )


def static_objects(id: StrArray, boxes: Boxes, time: FloatArray) -> SimulatedTrajectories:  # noqa: A002
    """Trajectories of objects that never move."""
    shape = (len(time), len(boxes))
    return SimulatedTrajectories(
        id=id,
        label=boxes.label,
        size=boxes.size,
        time=time,
        position=np.broadcast_to(boxes.position[:, :2], (*shape, 2)),
        velocity=np.zeros((*shape, 2)),
        yaw=np.broadcast_to(boxes.yaw, shape),
        present=np.ones(shape, dtype=np.bool_),
    )


RELAXATION = 0.6  # tau, s
PEDESTRIAN_SWAY = 1.0  # omega, 1/s
SPACING = 0.8  # m between people who walk abreast
GROUP_SIZE = (1, 4)  # fewest and most people in a group
WALKING_SPEED = (1.0, 1.7)  # preferred speed of a group, m/s
PAUSE_INTERVAL, PAUSE_DURATION = 20.0, 4.0  # mean time between pauses of a group, and of a pause, s
JITTER = 0.25  # standard deviation of a person's position within the group, m
BODY = (0.65, 0.65, 1.72)  # length, width, height, m


def simulate_pedestrians(
    road: Road,
    pavements: list[tuple[float, float]],
    window: tuple[float, float],
    time: FloatArray,
    number: tuple[int, int],
    rng: np.random.Generator,
) -> SimulatedTrajectories:
    """Pedestrians on `pavements` (lowest and highest offset d, m) who start at road s within `window`, m.

    number: fewest and most groups
    """
    groups = int(rng.integers(number[0], number[1] + 1)) if pavements else 0
    count = rng.integers(GROUP_SIZE[0], GROUP_SIZE[1] + 1, size=groups)
    group = np.repeat(np.arange(groups), count)
    rank = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    offset = np.stack([-(rank // 2) * SPACING * 1.2, (rank % 2 - 0.5) * SPACING], axis=1)
    offset = offset + rng.uniform(-0.1, 0.1, offset.shape)

    centre = rng.uniform(*window, size=groups)
    low, high = np.array([pavements[k] for k in rng.integers(len(pavements), size=groups)]).reshape(-1, 2).T
    middle = rng.uniform(low, high)
    sense = rng.choice([-1.0, 1.0], size=groups)
    preferred = rng.uniform(*WALKING_SPEED, size=groups)
    pausing = rng.random(groups) < PAUSE_DURATION / (PAUSE_DURATION + PAUSE_INTERVAL)
    speed = np.where(pausing, 0.0, preferred)

    h = float(time[1] - time[0])
    sway = JITTER * rng.standard_normal((len(group), 2))
    swing = PEDESTRIAN_SWAY * JITTER * rng.standard_normal((len(group), 2))
    s, d = np.empty((2, len(time), len(group)))
    vs, vd = np.empty_like(s), np.empty_like(s)
    for k in range(len(time)):
        s[k] = centre[group] + sense[group] * offset[:, 0] + sway[:, 0]
        d[k] = middle[group] + offset[:, 1] + sway[:, 1]
        vs[k] = sense[group] * speed[group] + swing[:, 0]
        vd[k] = swing[:, 1]
        toggle = rng.random(groups) < h / np.where(pausing, PAUSE_DURATION, PAUSE_INTERVAL)
        pausing = pausing ^ toggle
        centre = centre + h * sense * speed
        speed = speed + h / RELAXATION * (np.where(pausing, 0.0, preferred) - speed)
        sway = sway + h * swing
        kick = np.sqrt(4 * PEDESTRIAN_SWAY**3 * h) * JITTER * rng.standard_normal(swing.shape)
        swing = swing - h * (PEDESTRIAN_SWAY**2 * sway + 2 * PEDESTRIAN_SWAY * swing) + kick
    heading = road.heading_at(s)
    stretch = 1 - road.curvature_at(s) * d
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    size = np.array(BODY) * np.exp(0.08 * np.clip(rng.standard_normal((len(group), 3)), -2, 2))
    return SimulatedTrajectories(
        id=np.array([f"pedestrian-{k:03d}" for k in range(len(group))], dtype=np.str_),
        label=np.full(len(group), "pedestrian"),
        size=size,
        time=time,
        position=road.position(s, d),
        velocity=(vs * stretch)[..., None] * tangent + vd[..., None] * normal,
        yaw=heading + np.where(sense[group] > 0, 0.0, np.pi),
        present=np.ones(s.shape, dtype=np.bool_),
    )


CHANGE_INTERVAL = 0.5  # s between two decisions to change lanes
SLOWEST_CHANGE = 2.0  # m/s, lowest speed at which a voluntary lane change starts
REACTION_TIME = 0.3  # s between a change in traffic and the driver's response
ACCELERATION_NOISE = 0.2  # standard deviation of the random acceleration, m/s^2
HURRY = 2.5  # m/s^2, of those who let nobody in
NOISE_TIME = 3.0  # correlation time of the random acceleration, s


@dataclass(frozen=True, eq=False)
class TrafficHistory:
    """States of N vehicles at T time steps: time (T,) s; arrays (T, N) s m, speed m/s, lane, offset d m, slope dd/ds,
    on_road.
    """

    time: FloatArray
    s: FloatArray
    speed: FloatArray
    lane: IntArray
    offset: FloatArray
    slope: FloatArray
    on_road: BoolArray


class Traffic:
    """Vehicles in traffic, advanced by `step`.

    step   time step, s
    noise  standard deviation of the random acceleration, m/s^2; reaction: time of the drivers, s
    early  spread of the positions at which drivers leave a lane closed by cones, m
    takers share of drivers who speed up where a lane ends, and let nobody in
    """

    def __init__(
        self,
        layout: SceneLayout,
        rng: np.random.Generator,
        step: float = 0.05,
        early: float = 0.0,
        noise: float = ACCELERATION_NOISE,
        reaction: float = REACTION_TIME,
        takers: float = 0.0,
    ) -> None:
        self._lanes, self._fleet, self._deviation, self._rng = layout.lanes, layout.fleet, noise, rng
        self._stop_lines, self._slow_zones, self._step = layout.stop_lines, layout.slow_zones, step
        n = len(layout.fleet)
        self.time = 0.0
        self.lane, self.s, self.speed = layout.lane.copy(), layout.s, layout.speed
        self._from = np.full(n, -1)
        self._share = np.zeros(n)
        self._change_length = np.ones(n)
        self._noise = noise * rng.standard_normal(n)
        self._passes = np.zeros(
            (len(layout.stop_lines), n), dtype=np.bool_
        )  # vehicles too close to stop for a red light
        self._was_closed = [False] * len(layout.stop_lines)
        self._pending = [np.zeros(n)] * round(reaction / step)
        self._steps = 0
        self._early = rng.uniform(0.0, early, n) if early > 0 else np.zeros(n)
        self._takes = rng.spawn(1)[0].random(n) < takers

    @property
    def on_road(self) -> BoolArray:
        return self.s < self._lanes.road.length

    def order(self) -> LaneOrder:
        """Lane order of the vehicles still on the road."""
        lanes = np.where(self.on_road[:, None], np.stack([self.lane, self._also_in()], axis=1), -1)
        return LaneOrder.by_position(self.s, lanes)

    def _also_in(self) -> IntArray:
        """Second lane (N,) that each vehicle occupies while it changes or is moved aside by cones, or -1."""
        if self._lanes.taper == 0:
            return self._from
        pushed = (self.lane == self._lanes.ending) & (self.s + self._early >= self._lanes.end - self._lanes.taper)
        return np.where(pushed, self._lanes.adjacent, self._from)

    def lateral(self) -> tuple[FloatArray, FloatArray]:
        """Lateral offsets d (N,), m, and slopes dd/ds (N,)."""
        d, slope = self._lanes.lateral(self.lane, self.s + self._early)
        d0, slope0 = self._lanes.lateral(np.where(self._from >= 0, self._from, self.lane), self.s)
        q = np.where(self._from >= 0, self._share, 1.0)
        weight = smooth_step(q)
        turn = smooth_step_slope(q) / self._change_length
        return d0 + weight * (d - d0), slope0 + weight * (slope - slope0) + turn * (d - d0)

    def step(self) -> None:
        """Advance all vehicles by one time step."""
        h = self._step
        order = self.order()
        metric = self._lanes.metric(self.lane, self.s, *self.lateral())  # length over ground per unit of s
        desired = self._desired_acceleration(order, metric)
        if self._steps % max(1, round(CHANGE_INTERVAL / h)) == 0:
            self._start_changes(desired, order)
        self._pending.append(desired)
        acceleration = self._pending.pop(0)
        decay = np.exp(-h / NOISE_TIME)
        kick = self._deviation * np.sqrt(1 - decay**2)
        self._noise = decay * self._noise + kick * self._rng.standard_normal(len(self.s))
        noise = self._noise * np.clip(self.speed / 3.0, 0.0, 1.0)
        speed = np.maximum(0.0, self.speed + h * np.maximum(acceleration + noise, -HARDEST_BRAKING))
        travelled = h * (self.speed + speed) / 2
        self.s = self.s + travelled / metric
        self.speed = speed
        self._share = self._share + travelled / self._change_length
        self._from = np.where(self._share < 1, self._from, -1)
        if self._lanes.taper > 0:
            self.lane[(self.lane == self._lanes.ending) & (self.s >= self._lanes.end)] = self._lanes.adjacent
        self.time += h
        self._steps += 1

    def _desired_acceleration(self, order: LaneOrder, metric: FloatArray) -> FloatArray:
        """Acceleration (N,), m/s^2, that the drivers want now; `metric` (N,) converts differences of s to metres."""
        drivers, s, v = self._fleet.drivers, self.s, self.speed
        limit = np.full(len(s), np.inf)
        for zone in self._slow_zones:
            limit = np.minimum(limit, zone.limit(self.lane, s, self.time))
        pull = np.zeros(len(s))
        for lane in (self.lane, self._also_in()):
            leader = order.ahead(lane, s)
            gap = (s[leader] - s) * metric - (self._fleet.length[leader] + self._fleet.length) / 2
            term = following_acceleration(v, np.maximum(gap, 0.0), v[leader], drivers)
            pull = np.minimum(pull, np.where(leader >= 0, term, 0.0))
        pull = np.minimum(np.minimum(pull, self._stops()), self._courtesy(order))
        free = free_acceleration(v, drivers, limit)
        near = (s >= self._lanes.opening) & (s < self._lanes.end)
        hurries = self._takes & near & np.isin(self.lane, [self._lanes.ending, self._lanes.adjacent])
        return np.maximum(np.where(hurries, HURRY, free) + pull, -HARDEST_BRAKING)

    def _stops(self) -> FloatArray:
        """Interaction with red lights and with the end of the ending lane (N,), m/s^2."""
        s, v, drivers = self.s, self.speed, self._fleet.drivers
        pull = np.zeros(len(s))
        for k, line in enumerate(self._stop_lines):
            closed = line.closed(self.time)
            gap = line.s - s - self._fleet.length / 2
            if closed and not self._was_closed[k]:
                self._passes[k] = v**2 / (2 * np.maximum(gap, 0.1)) > 1.5 * drivers.comfortable_deceleration
            self._was_closed[k] = closed
            if closed:
                waits = np.isin(self.lane, line.lanes) & (gap > -0.5) & ~self._passes[k]
                term = following_acceleration(v, np.maximum(gap, 0.0), np.zeros(len(s)), drivers)
                pull = np.minimum(pull, np.where(waits, term, 0.0))
        if self._lanes.ending >= 0 and self._lanes.taper == 0:
            gap = np.maximum(self._lanes.end - s - self._fleet.length / 2, 0.0)
            term = following_acceleration(v, gap, np.zeros(len(s)), drivers)
            pull = np.minimum(pull, np.where(self.lane == self._lanes.ending, term, 0.0))
        return pull

    def _courtesy(self, order: LaneOrder) -> FloatArray:
        """Zip merging (N,), m/s^2: a vehicle in the ending lane follows the next vehicle of the adjacent lane, and the
        vehicle behind it in that lane follows it; both brake comfortably at most, takers not at all.
        """
        pull = np.zeros(len(self.s))
        if self._lanes.ending < 0:
            return pull
        merging = (self.lane == self._lanes.ending) & (self.s >= self._lanes.opening) & self.on_road
        rows = np.flatnonzero(merging)
        target = np.full(len(rows), self._lanes.adjacent)
        pairs = ((rows, order.ahead(target, self.s[rows])), (order.behind(target, self.s[rows]), rows))
        for behind, front in pairs:
            both = (behind >= 0) & (front >= 0) & ~self._takes[behind]
            i, j = behind[both], front[both]
            gap = np.maximum(self.s[j] - self.s[i] - (self._fleet.length[i] + self._fleet.length[j]) / 2, 0.0)
            drivers = self._fleet.drivers.select(i)
            term = following_acceleration(self.speed[i], gap, self.speed[j], drivers)
            np.minimum.at(pull, i, np.maximum(term, -drivers.comfortable_deceleration))
        return pull

    def _start_changes(self, desired: FloatArray, order: LaneOrder) -> None:
        ending = self.lane == self._lanes.ending if self._lanes.ending >= 0 else np.zeros(len(self.s), dtype=np.bool_)
        free = (self._from < 0) & self.on_road & ((self.speed > SLOWEST_CHANGE) | ending)
        gains, targets = [], []
        for side in (-1, 1):
            target = self._lanes.neighbour(self.lane, side)
            target = np.where(free & self._lanes.may_change(self.lane, target, self.s), target, -1)
            drivers, length = self._fleet.drivers, self._fleet.length
            gains.append(lane_change_gain(drivers, length, self.s, self.speed, desired, target, ending, order))
            targets.append(target)
        better = gains[1] > gains[0]
        gain, target = np.where(better, gains[1], gains[0]), np.where(better, targets[1], targets[0])
        rows = best_lane_changes(gain, target)
        self._from[rows] = self.lane[rows]
        self.lane[rows] = target[rows]
        self._share[rows] = 0.0
        self._change_length[rows] = np.maximum(np.maximum(4.0 * self.speed[rows], 3.0 * self._fleet.length[rows]), 20.0)


def record_traffic(traffic: Traffic, steps: int) -> TrafficHistory:
    """Advance the traffic by `steps` time steps and record all of them, the present state first."""
    columns: list[tuple[object, ...]] = []
    for k in range(steps + 1):
        if k:
            traffic.step()
        d, slope = traffic.lateral()
        columns.append((traffic.time, traffic.s, traffic.speed, traffic.lane.copy(), d, slope, traffic.on_road))
    return TrafficHistory(*(np.array(column) for column in zip(*columns, strict=True)))


def split_trailers(
    vehicles: SimulatedTrajectories, lanes: Lanes, history: TrafficHistory, trailer: FloatArray
) -> tuple[SimulatedTrajectories, SimulatedTrajectories]:
    """The vehicles without their trailers, and the trailers; `trailer` (N,) are their lengths, m, 0 for none."""
    rows = np.flatnonzero(trailer > 0)
    if len(rows) == 0:
        return vehicles, vehicles.select(rows)
    whole, behind = vehicles.size[rows, 0], trailer[rows]
    truck = whole - behind - HITCH
    position, yaw, velocity = (x.copy() for x in (vehicles.position, vehicles.yaw, vehicles.velocity))
    position[:, rows], yaw[:, rows], velocity[:, rows] = _shifted(lanes, history, rows, (whole - truck) / 2)
    size = vehicles.size.copy()
    size[rows, 0] = truck
    pose = _shifted(lanes, history, rows, -(whole - behind) / 2)
    trailer_size = np.column_stack([behind, vehicles.size[rows, 1], vehicles.size[rows, 2]])
    trailers = SimulatedTrajectories(
        id=np.char.replace(vehicles.id[rows], "vehicle", "trailer"),
        label=np.full(len(rows), "trailer"),
        size=trailer_size,
        time=vehicles.time,
        position=pose[0],
        velocity=pose[2],
        yaw=pose[1],
        present=vehicles.present[:, rows],
    )
    return replace(vehicles, position=position, yaw=yaw, velocity=velocity, size=size), trailers


def _shifted(
    lanes: Lanes, history: TrafficHistory, rows: IntArray, by: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position (T, k, 2), heading (T, k) and velocity (T, k, 2) of points `by` (k,) m ahead of vehicles' centres."""
    lane, slope = history.lane[:, rows], history.slope[:, rows]
    position, heading = lanes.pose(lane, history.s[:, rows] + by, history.offset[:, rows] + slope * by, slope)
    heading = np.unwrap(heading, axis=0)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return position, heading, history.speed[:, rows, None] * direction
