"""Crossings without lights, and a merge between cones: traffic under a known rule of right of way.

Vehicles keep to routes: a route comes in by an arm, goes on by an exit, and has a rank. Two routes are in conflict
where they come within `WIDTH` m of each other. There, vehicle i is to wait for j

    if the route of j has the better rank and j is there within the critical gap of driver i,
    or, at equal ranks, if j came to the line before i.

    all_way_stop   four arms, all ranks are equal, everybody halts at the line
    priority_road  four arms, of which two have priority; those who turn left wait for those who go straight on
    cone_merge     cones close the right of two lanes; zip merging: who comes to the line first goes first
    zebra          people cross a road of two lanes, and have priority
    midblock       they have not, and wait for a gap

Nobody enters where another one is already on the way through. A share `TAKERS` of the drivers do not wait for their
turn. Who goes in takes the right of way of j that has the better rank, or came first, could go, and comes to where
both meet before the first one has left that, or less than `MARGIN` s after. The drivers follow and halt as those of
`data_tools.simulator.road` do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, cast, get_args

import numpy as np

from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings
from data_tools.simulator.road import (
    HARDEST_BRAKING,
    Drivers,
    Fleet,
    following_acceleration,
    free_acceleration,
    sample_fleet,
    smooth_step,
)
from data_tools.simulator.scene_layout import CONE, CONE_SPACING
from data_tools.simulator.sensed_world import SensedWorld
from data_tools.simulator.settings import SimulatorSettings, TrafficSettings, lidar
from data_tools.simulator.traffic import SimulatedTrajectories, concatenated, static_objects
from data_tools.simulator.world import scene_from_world
from saga_fg.numerics import BoolArray, FloatArray, IntArray, yaw_transform
from saga_fg.tracking.right_of_way import free_time
from saga_fg.types import Boxes, Scene

Rule = Literal["all_way_stop", "priority_road", "cone_merge", "zebra", "midblock"]
UNSEEN = 1000  # first seed of scenes that no weight is fitted to, and no setting chosen on
STEP = 0.05  # s
KINDS = TrafficSettings(truck_share=0.08, bus_share=0.02)
RATE = 10.0  # 1/s, of frames
GRID = 0.5  # m between the points of a route
ARM, HALF, OFFSET = 80.0, 8.0, 1.75  # m from the middle: end of an arm, its line; and of a lane beside the middle
MERGE, TAPER = 90.0, 35.0  # m along a lane to the end of the taper, and its length
WIDTH = 2.4  # m between the middles of vehicles that would touch
JOINED = 5.0  # m after which those who have come together are one behind the other
ROOM = 14.0  # m behind the middle of the last vehicle, for another one
INTERVALS = {"all_way_stop": 7.0, "priority_road": 8.0, "cone_merge": 3.4, "zebra": 7.0, "midblock": 7.0}
"""Mean time between vehicles of one arm, s."""
PEOPLE = (-1.2, -0.4, 0.4, 1.2)  # m along the road, where people cross
WALK, KERB = 13.0, 4.5  # m from the middle of the road, where they come from, and where they wait
BEFORE_PEOPLE = 6.0  # m from the middle of the crossing to the line of vehicles
SEES_PEOPLE = 0.5  # share of the critical gap within which people come for whom drivers wait
PACE, PEOPLE_INTERVAL, PERSON = (1.1, 1.7), 30.0, (0.5, 0.55, 1.75)  # m/s; s between those of one place; m
HEADWAY = 2.0  # s, least time between them
TURN_SHARE = 0.1  # of vehicles, to either side
HURRY = 2.5  # m/s^2, of those who take another's turn at a merge
TURNING_SPEED = 6.0  # m/s
CRITICAL_GAP = (4.0, 6.0)  # s (Highway Capacity Manual 2010, exhibit 19-10: 4.1 to 7.1)
BOLD_GAP = 1.5  # s, that takers accept
MARGIN = 0.5  # s after one has left, before which another one would brake for it
TAKERS = 0.1
ARRIVES, LOOKS = 4.0, 25.0  # m before the line, where a vehicle counts as arrived, and heeds others
STANDING = 0.3  # m/s
POST = (-11.0, 11.0)  # m, place of the sensor


@dataclass(frozen=True, eq=False)
class Routes:
    """R routes: points (G, 2) every `GRID` m of each; the arm by which it comes and that to which it leads,
    rank (R,), the line, m along it, whether people walk it; and of each pair r, q
    (R, R): along r, m, where it comes near q, where it has left it, and up to where both are one."""

    points: tuple[FloatArray, ...]
    arm: IntArray
    leads_to: IntArray
    rank: IntArray
    turns: BoolArray
    line: FloatArray
    enter: FloatArray
    leave: FloatArray
    shared: FloatArray
    walks: BoolArray

    @classmethod
    def along(
        cls,
        points: list[FloatArray],
        arm: IntArray,
        leads_to: IntArray,
        rank: IntArray,
        turns: BoolArray,
        line: FloatArray,
        walks: BoolArray | None = None,
    ) -> Routes:
        """Routes through points; of vehicles if `walks` is not given."""
        n = len(points)
        walks = np.zeros(n, dtype=np.bool_) if walks is None else walks
        enter, leave, shared = np.full((n, n), np.inf), np.full((n, n), -np.inf), np.zeros((n, n))
        for r, mine in enumerate(points):
            for q, other in enumerate(points):
                near = np.linalg.norm(mine[:, None] - other, axis=-1).min(axis=1) < WIDTH
                if arm[r] == arm[q]:
                    shared[r, q] = np.inf if near.all() else GRID * np.argmin(near)
                elif near.any() and not (walks[r] and walks[q]):
                    enter[r, q], leave[r, q] = GRID * np.flatnonzero(near)[[0, -1]]
                    if leads_to[r] == leads_to[q]:
                        leave[r, q] = min(leave[r, q], enter[r, q] + JOINED)
        return cls(tuple(points), arm, leads_to, rank, turns, line, enter, leave, shared, walks)

    @property
    def length(self) -> FloatArray:
        """(R,) m."""
        return np.array([GRID * (len(each) - 1) for each in self.points])

    def pose(self, route: IntArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions (N, 2), m, and headings (N,), rad, of vehicles s (N,) m along their routes (N,)."""
        position, heading = np.zeros((len(s), 2)), np.zeros(len(s))
        for r, points in enumerate(self.points):
            rows, at = np.flatnonzero(route == r), GRID * np.arange(len(points))
            direction = np.gradient(points, axis=0)
            position[rows] = np.stack([np.interp(s[rows], at, x) for x in points.T], axis=-1)
            heading[rows] = np.arctan2(*(np.interp(s[rows], at, x) for x in direction.T[::-1]))
        return position, heading


def crossing_routes(priority: bool) -> Routes:
    """The routes of four arms: straight on, to the left and to the right from each."""
    found, arm, leaves, rank, turns = [], [], [], [], []
    for k in range(4):
        for turn in (0, 1, -1):
            u, v = (np.array([np.cos(a), np.sin(a)]) for a in (k * np.pi / 2, (k + turn) * np.pi / 2))
            right, beyond = OFFSET * np.array([u[1], -u[0]]), OFFSET * np.array([v[1], -v[0]])
            corner = (right + beyond) if turn else right
            bend = np.linspace(0.0, 1.0, 40)[:, None]
            begin, end = right - HALF * u, beyond + HALF * v
            curve = (1 - bend) ** 2 * begin + 2 * bend * (1 - bend) * corner + bend**2 * end
            found.append(_resampled(np.concatenate([[right - ARM * u], curve, [beyond + ARM * v]])))
            arm.append(k)
            leaves.append((k + turn) % 4)
            turns.append(turn != 0)
            rank.append(2 * (k % 2) + (turn == 1) if priority else 0)
    line = np.full(len(found), ARM - HALF)
    return Routes.along(found, np.array(arm), np.array(leaves), np.array(rank), np.array(turns), line)


def merge_routes() -> Routes:
    """Two lanes, of which the right one joins the left one along the taper."""
    x = np.arange(0.0, MERGE + ARM, GRID)
    aside = -2 * OFFSET * (1 - smooth_step((x - MERGE + TAPER) / TAPER))
    points = [_resampled(np.column_stack([x - MERGE, y])) for y in (np.zeros(len(x)), aside)]
    none = np.zeros(2, dtype=np.int64)
    return Routes.along(points, np.arange(2), none, none, none > 0, np.full(2, MERGE - TAPER))


def people_routes(priority: bool) -> Routes:
    """A road of two lanes, and people who cross it in either direction."""
    points = [np.array([[-ARM * u, -OFFSET * u], [ARM * u, -OFFSET * u]]) for u in (1, -1)]
    points += [np.array([[x, -WALK * u], [x, WALK * u]]) for x, u in zip(PEOPLE, (1, -1, 1, -1), strict=True)]
    arm = np.arange(len(points))
    walks = arm >= 2
    line = np.where(walks, WALK - KERB, ARM - BEFORE_PEOPLE)
    rank = (walks != priority).astype(np.int64)
    return Routes.along([_resampled(each) for each in points], arm, arm, rank, arm < 0, line, walks)


def _resampled(points: FloatArray) -> FloatArray:
    """The points of a line every `GRID` m."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], GRID)
    return np.stack([np.interp(at, along, x) for x in points.T], axis=-1)


@dataclass(frozen=True, eq=False)
class CrossingWorld(SensedWorld):
    """The world of a crossing; yields, takes (T, N, N): who waits for whom, and takes whose right of way;
    meet (N, N): whose routes do."""

    yields: BoolArray
    takes: BoolArray
    meet: BoolArray


class CrossingTraffic:
    """Vehicles on routes under a rule, advanced by `step`."""

    def __init__(self, rule: Rule, until: float, rng: np.random.Generator, takers: float = TAKERS) -> None:
        self.merging = rule == "cone_merge"
        self.routes = merge_routes() if self.merging else crossing_routes(rule == "priority_road")
        if rule in ("zebra", "midblock"):
            self.routes = people_routes(rule == "zebra")
        arm, start = [], []
        for number in np.unique(self.routes.arm).tolist():
            interval = PEOPLE_INTERVAL if self.routes.walks[self.routes.arm == number].all() else INTERVALS[rule]
            times = np.cumsum(HEADWAY + rng.exponential(interval - HEADWAY, int(2 * until / interval) + 8))
            times = times[times < until] - HEADWAY
            arm.append(np.full(len(times), number))
            start.append(times)
        self.start = np.concatenate(start)
        n = len(self.start)
        share = np.where(self.routes.turns, TURN_SHARE, 1 - 2 * TURN_SHARE)
        odds = share * (self.routes.arm == np.concatenate(arm)[:, None])
        self.route = (np.cumsum(odds / odds.sum(axis=1, keepdims=True), axis=1) > rng.random((n, 1))).argmax(axis=1)
        self.walks = self.routes.walks[self.route]
        self.fleet: Fleet = sample_fleet(n, float(rng.uniform(9.0, 13.0)), KINDS, rng)
        if self.walks.any():
            one, walks = self.fleet.drivers, self.walks
            pace, near = np.where(walks, rng.uniform(*PACE, n), one.desired_speed), np.where(walks, 0.5, 1.0)
            slow = replace(one, desired_speed=pace, minimum_gap=near * one.minimum_gap)
            self.fleet = replace(self.fleet, size=np.where(walks[:, None], PERSON, self.fleet.size), drivers=slow)
        self.bold = rng.random(n) < takers
        self.critical = rng.uniform(*CRITICAL_GAP, n) * np.where(self.walks.any() & ~self.walks, SEES_PEOPLE, 1.0)
        self.s, self.speed, self.time = np.zeros(n), 0.8 * self.fleet.drivers.desired_speed, 0.0
        self.entered, self.committed = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        self.stood = np.full(n, rule != "all_way_stop")
        self.arrival = np.full(n, np.inf)
        self.yields, self.takes = np.zeros((2, n, n), dtype=np.bool_)
        i, j = self.route[:, None], self.route
        routes = self.routes
        self._enter, self._leave, self._shared = (x[i, j] for x in (routes.enter, routes.leave, routes.shared))
        self._arm = routes.arm[j]
        self._length, self._line = routes.length[j], routes.line[j]
        self._goes_at = routes.enter[0, 1] if self.merging else self._line
        self._same_exit = (routes.leads_to[i] == routes.leads_to[j]) & (i != j) & np.isfinite(self._enter)
        self._each = Drivers(*(column[:, None] for column in vars(self.fleet.drivers).values()))

    @property
    def meet(self) -> BoolArray:
        """(N, N) pairs of vehicles of different arms whose routes meet."""
        return np.asarray(np.isfinite(self._enter))

    @property
    def on_road(self) -> BoolArray:
        """(N,) vehicles that are there."""
        return np.asarray(self.entered & (self.s < self._length))

    def step(self) -> None:
        """Advance all vehicles by one time step."""
        drivers, v, half = self.fleet.drivers, self.speed, self.fleet.length / 2
        self._enter_road()
        on, front = self.on_road, self.s + half
        self.arrival = np.where(np.isinf(self.arrival) & on & (front > self._line - ARRIVES), self.time, self.arrival)
        to_line = self._goes_at - front
        self.stood |= (v < STANDING) & (self._line - front < ARRIVES)
        self._judge(on, front, to_line)
        slow = self.routes.turns[self.route] & (np.abs(self.s - ARM) < 1.5 * HALF)
        hurries = self.merging & self.bold & (front > self._line) & (to_line > 0)
        pull = self._following(on)
        halts = (self.yields.any(axis=1) & ~self.merging) | ~self.stood
        term = following_acceleration(v, np.maximum(to_line + drivers.minimum_gap - 0.5, 0.0), 0 * v, drivers)
        pull = np.minimum(pull, np.where(halts & ~self.committed, term, 0.0))
        limit = np.where(slow, TURNING_SPEED, np.inf)
        free = np.where(hurries, HURRY, free_acceleration(v, drivers, limit))
        a = np.maximum(free + pull, -HARDEST_BRAKING)
        speed = np.where(on, np.maximum(0.0, v + STEP * a), v)
        self.s = self.s + np.where(on, STEP * (v + speed) / 2, 0.0)
        self.speed, self.time = speed, self.time + STEP

    def _enter_road(self) -> None:
        """Let vehicles in whose time has come, where there is room."""
        for k in np.flatnonzero(~self.entered & (self.start <= self.time)).tolist():
            mine = np.flatnonzero(self.on_road & (self._arm == self._arm[k]))
            last = mine[self.s[mine].argmin()] if len(mine) else None
            if last is None or self.s[last] > (ROOM if not self.walks[k] else PERSON[0] + 1):
                self.entered[k] = True
                self.speed[k] = self.speed[k] if last is None else min(self.speed[k], self.speed[last])

    def _following(self, on: BoolArray) -> FloatArray:
        """Interaction (N,), m/s^2, with those ahead on the same way; with `merging`, with those to wait for as well."""
        s, v, length = self.s, self.speed, self.fleet.length
        both = on[:, None] & on
        ahead = s - s[:, None]
        left = (self._length - s)[:, None] - (self._length - s)
        leads = both & (ahead > 0) & (s < self._shared.T)
        joined = both & self._same_exit & (left > 0) & (s > self._enter.T)
        gap = np.where(leads, ahead, np.where(joined, left, np.inf))
        if self.merging:
            gap = np.where(self.yields & (left > 0), np.minimum(gap, left), gap)
        gap = gap - (length[:, None] + length) / 2
        term = following_acceleration(v[:, None], np.maximum(gap, 0.0), v, self._each)
        soft = self.yields & ~leads & ~joined
        term = np.where(soft, np.maximum(term, -1.5 * self._each.comfortable_deceleration), term)
        return np.asarray(np.where(np.isfinite(gap), term, 0.0).min(axis=1, initial=0.0))

    def _judge(self, on: BoolArray, front: FloatArray, to_line: FloatArray) -> None:
        """Who waits for whom now."""
        v, half, rank = self.speed, self.fleet.length / 2, self.routes.rank[self.route]
        late = v**2 / (2 * np.maximum(to_line, 0.1)) > 1.5 * self.fleet.drivers.comfortable_deceleration
        last = self.s if self.merging else self.s - half
        past = last[:, None] > self._leave
        open_ = on[:, None] & on & np.isfinite(self._enter) & ~past & ~past.T
        time = np.maximum(self._enter - front[:, None], 0.0) / np.maximum(v, 2.0)[:, None]
        better, equal = rank < rank[:, None], rank == rank[:, None]
        first = equal & (self.arrival < self.arrival[:, None])
        ahead = on & ~self.committed & (self.s > self.s[:, None]) & (self._arm == self._arm[:, None])
        heeds = ((to_line < LOOKS) & ~ahead.any(axis=1))[:, None]
        due = open_ & heeds & (first | (better & (self.critical[:, None] > time.T)))
        bold = open_ & heeds & better & (time.T < BOLD_GAP)
        through = open_ & heeds & self.committed
        own = np.where(self.bold[:, None], bold, due)
        self.yields = (own | through) & ~self.committed[:, None]
        goes = on & ~self.committed & ((to_line < 0) | (late & ~self.yields.any(axis=1) & self.stood))
        if self.merging:
            goes = on & ~self.committed & (to_line < 0)
        leaves = free_time(self._leave - last[:, None], v[:, None])
        comes = free_time(self._enter.T - front, v)
        free = ~self.committed & ~(self.yields & ~self.takes.T).any(axis=1)
        taken = goes[:, None] & open_ & (first | better) & free & (comes < leaves + MARGIN)
        self.takes = (self.takes | taken) & open_
        self.committed |= goes


def build_crossing(
    rule: Rule, seed: int, duration: float = 60.0, warm_up: float = 15.0, takers: float = TAKERS
) -> CrossingWorld:
    """The world of a scene of `duration` s, after `warm_up` s; both count for what traffic there is."""
    rng, error = np.random.default_rng(seed).spawn(2)
    traffic = CrossingTraffic(rule, warm_up + duration, rng, takers)
    for _ in range(round(warm_up / STEP)):
        traffic.step()
    columns = []
    for _ in range(int(np.ceil(duration / STEP)) + 2):
        position, heading = traffic.routes.pose(traffic.route, traffic.s)
        velocity = traffic.speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        now = (traffic.time, position, velocity, heading, traffic.on_road)
        traffic.step()
        columns.append((*now, traffic.yields, traffic.takes))
    time, position, velocity, heading, present, yields, takes = (np.array(x) for x in zip(*columns, strict=True))
    fleet = traffic.fleet
    names = np.array([f"vehicle-{k:03d}" for k in range(len(fleet))])
    yaw = np.unwrap(heading, axis=0)
    label = np.where(traffic.walks, "pedestrian", fleet.label)
    vehicles = SimulatedTrajectories(names, label, fleet.size, time, position, velocity, yaw, present)
    cones = _cones(error) if traffic.merging else Boxes.empty()
    marks = static_objects(np.array([f"cone-{k:03d}" for k in range(len(cones))], dtype=np.str_), cones, time)
    pose = yaw_transform(*POST, 0.0, 0.0)
    both = concatenated([vehicles, marks])
    return CrossingWorld(both, Boxes.empty(), lambda time: pose, (), None, yields, takes, traffic.meet)


def simulated_crossings(scenes: int) -> Recordings:
    """Vehicles without cones, as recorded traffic; the rules in turn, in scenes of seeds from `UNSEEN` on."""
    rules = get_args(Rule)
    names = tuple(f"{rules[k % len(rules)]}-{UNSEEN + k // len(rules)}" for k in range(scenes))

    def read(name: str) -> RecordedTraffic:
        rule, _, seed = name.rpartition("-")
        world = build_crossing(cast(Rule, rule), int(seed))
        vehicles = world.objects.select(np.arange(len(world.meet)))
        return RecordedTraffic(name, vehicles).moments(slice(None, None, round(PERIOD / STEP)))

    return Recordings(names, read)


def crossing_scene(world: CrossingWorld, seed: int) -> Scene:
    """What a LiDAR on a post sees of a world."""
    sensor = replace(lidar(), position=(0.0, 0.0, 7.0), max_range=90.0, reach=90.0, clutter_rate=1.0)
    duration = STEP * (len(world.objects.time) - 2)
    settings = SimulatorSettings(duration=duration, annotation_range=90.0, traffic=KINDS, sensors={"lidar": sensor})
    return scene_from_world(world, settings, seed)


def _cones(rng: np.random.Generator) -> Boxes:
    """Cones along the taper and beyond it."""
    x = np.arange(-TAPER, 20.0, CONE_SPACING)
    y = np.interp(x, [-TAPER, 0.0], [-3 * OFFSET, -OFFSET - 0.2]) + rng.normal(0.0, 0.1, len(x))
    position, n = np.column_stack([x, y, np.full(len(x), CONE[2] / 2)]), len(x)
    return Boxes(np.full(n, "traffic_cone"), position, np.tile(np.array(CONE), (n, 1)), np.zeros(n), np.zeros((n, 2)))
