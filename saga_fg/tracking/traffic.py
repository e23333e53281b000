"""Memory of traffic: where vehicles went lately and how fast, for paths and speeds of others.

A passage is a place of a track with its heading and speed there: where it was last, and every `SPACING` m. Passages
outlive their tracks and are forgotten after `memory` s. The passages of those that move make trails, and so do the
lanes of the road map: they tell where to go, at no speed, and are never forgotten.

The speeds of new tracks are predicted from this memory, and paths along the trails and the lanes of the map.

A trail is the row of passages of one track, or the centre of a lane. A path is predicted
from a place and a course h in steps of ds, with u the curvature that the vehicle has itself, which fades along the way.
With the trails j near its next place, of each the nearest point, d_j m away,

    k_j = exp( -d_j^2 / (2 reach^2) - (h_j - h - u ds)^2 / (2 TURN^2) ),   m, s^2: mean and variance of h_j - h
    h'  = h + c m + (1 - c) u ds,   c = K / (K + PRIOR) / (1 + s^2 / AGREEMENT^2),  K = sum of k_j

A turn is bounded by what a vehicle of its speed can do: at full speed nobody takes the way of those that turn off.
Where there are no trails, it goes on as it does; at a fork it keeps to the trail that it turns with; where they part
and it agrees with both, nothing is known of its course, until it is nearer to one of them. The mean of the speeds under
k_j is the typical speed at each place; lanes tell none.

Prior of the speed of a new track, from tracks of its class that head, or headed, the same way.

    k_j = weight * max over the passages of j of
              exp( -ahead^2 / (2 ahead_scale^2) - lateral^2 / (2 lateral_scale^2) - turn^2 / (2 heading_scale^2) )
    p(speed) ~ N(0, initial_speed_deviation^2) + sum_j k_j N(s_j, sigma_j^2 + spread^2)

Every neighbour j counts once, by its nearest passage within `memory`, with its speed s_j along its heading there
(parked ones with a speed near 0). The new track takes the mean and the variance of the mixture: as wide as the
neighbours disagree, and the prior of the class where there are none.

Where stationary objects are modelled (`saga_fg.tracking.track_filters`), neighbour j is stationary with probability b_j
and an unknown object with b_0. The new one is stationary with the mean of these, weighted by k, and the mixture is that
of the moving ones, with the weights 1 - b_0 and k_j (1 - b_j).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.kernels.components import speeds_ahead
from saga_fg.kernels.paths import points_by_cell, trail_paths
from saga_fg.kernels.tracks import prior_of_traffic
from saga_fg.model import Paths, ahead_and_aside, unit
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, common_numbers, shallow_copy
from saga_fg.settings import NonNegative, PositiveOrInf, Settings, setting, settings_group
from saga_fg.tracking.identities import exchanged
from saga_fg.tracking.track_filters import Kinematics
from saga_fg.types import Lane

SPACING = 2.0  # m between the passages of a track
BESIDE = 5.0  # m, of traffic that passes who is parked
FIRST_LANE = -2  # ids of lanes count down from here, so that they are never those of tracks


@dataclass(frozen=True)
class SpeedPriorSettings(Settings):
    """Prior speed of a new track from traffic that heads the same way, see above."""

    weight: NonNegative = setting(0.0, "weight of one neighbour against the prior without traffic; 0: off, usual 5")
    ahead_scale: PositiveOrInf = setting(
        15.0, "sigma of the kernel on the distance along the heading, m; higher: traffic further ahead counts"
    )
    lateral_scale: PositiveOrInf = setting(
        2.0, "sigma of the kernel on the distance across the heading, m; usual half a lane; higher: other lanes count"
    )
    max_speed_deviation: PositiveOrInf = setting(
        1.5, "use only tracks whose speed has a standard deviation below this, m/s; higher: more, less certain speeds"
    )


@dataclass(frozen=True)
class TrafficSettings(Settings):
    """Memory of where traffic went and how fast, see above."""

    memory: NonNegative = setting(
        0.0,
        "remember where tracks have passed for this long, s, for the paths of hidden objects (reach) and the speeds of "
        "new tracks (speed_prior); usual 5 to 120; higher: older traffic counts, 0: none",
    )
    reach: NonNegative = setting(
        1.5,
        "sigma of the kernel on the distance to the trails of earlier traffic and to lanes of the map, along which "
        "undetected objects with a course_time go, m; usual half a lane; higher: other lanes count, 0: no such paths",
    )
    speed_prior: SpeedPriorSettings = settings_group(
        SpeedPriorSettings, "speed of new tracks from the traffic around them"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speed_prior.weight > 0 and self.memory == 0:
            raise InputError("speed_prior.weight: expected 0 with a memory of 0 s, which tells no speeds")


@dataclass(frozen=True, eq=False)
class Passages(Columns):
    """n passages of tracks: id, class, position (n, 2), world, m, heading, rad, speed along it, m/s, its
    variance, probability of being stationary, time, s, and whether it moves."""

    id: IntArray
    label: StrArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    variance: FloatArray
    stationary: FloatArray
    time: FloatArray
    moves: BoolArray

    @classmethod
    def from_tracks(
        cls,
        ids: IntArray,
        label: StrArray,
        now: Kinematics,
        yaw: FloatArray,
        moves: BoolArray,
        time: float,
        stationary: FloatArray | None = None,
    ) -> Self:
        """The passages of tracks at a `time`, s, by their kinematics in the world.

        Those of unknown `yaw` head where they go; if they do not move either, they have none. stationary: 0 if not
        given.
        """
        heading, speed, variance = speeds_ahead(yaw, moves, now.velocity, now.P_velocity)
        stationary = np.zeros(len(ids)) if stationary is None else stationary
        found = cls(
            id=ids,
            label=label,
            position=now.position,
            heading=heading,
            speed=speed,
            variance=variance,
            stationary=stationary,
            time=np.full(len(ids), time),
            moves=moves,
        )
        return found if np.isfinite(heading).all() else found.select(np.isfinite(heading))

    @classmethod
    def empty(cls) -> Self:
        """No passages."""
        ids, none, moves = np.empty(0, dtype=np.int64), np.empty(0), np.empty(0, dtype=np.bool_)
        return cls(
            id=ids,
            label=np.empty(0, dtype="U1"),
            position=np.empty((0, 2)),
            heading=none,
            speed=none,
            variance=none,
            stationary=none,
            time=none,
            moves=moves,
        )


def _lane_points(lane: Lane, ids: int) -> Passages:
    """Passages along a lane, of no known speed."""
    centre = np.array(lane.centre)
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(centre, axis=0).T))])
    at = np.linspace(0.0, distance[-1], max(2, round(distance[-1] / SPACING) + 1))
    place = np.stack([np.interp(at, distance, each) for each in centre.T], axis=-1)
    heading, none = np.arctan2(*np.gradient(place, axis=0)[:, ::-1].T), np.zeros(len(at))
    number, moves = np.full(len(at), ids), np.ones(len(at), dtype=np.bool_)
    return Passages(
        id=number,
        label=np.full(len(at), lane.name),
        position=place,
        heading=heading,
        speed=none,
        variance=none + np.inf,
        stationary=none,
        time=none,
        moves=moves,
    )


@dataclass(eq=False)
class Trails:
    """Passages that make trails, found by cells. These are no part of a state: they are made at need."""

    points: Passages
    _cells: tuple[float, IntArray, IntArray] | None = field(default=None, init=False, repr=False)

    def __reduce__(self) -> tuple[type[Trails], tuple[Passages]]:
        return Trails, (self.points,)

    def __len__(self) -> int:
        return len(self.points)

    def by_cell(self, cell: float) -> tuple[IntArray, IntArray]:
        """The points by cells of this size, m, see `saga_fg.kernels.paths.points_by_cell`."""
        if self._cells is None or self._cells[0] != cell:
            self._cells = cell, *points_by_cell(self.points.position, cell)
        return self._cells[1:]


@dataclass(eq=False)
class Traffic:
    """The passages of the last `memory` seconds, and the trails along the lanes of the map.

    left    those that tracks have left behind, in the order of time
    marked  the latest of these of each track, by id
    latest  where tracks were last
    """

    settings: TrafficSettings
    left: Passages = field(default_factory=Passages.empty)
    marked: Passages = field(default_factory=Passages.empty)
    latest: Passages = field(default_factory=Passages.empty)
    lanes: Trails = field(default_factory=lambda: Trails(Passages.empty()))
    _known: Mapping[str, tuple[int, Lane]] = field(default_factory=dict)
    _next_lane: int = FIRST_LANE
    _oldest: float = -np.inf  # no passage is older, s
    _trails: Trails | None = field(default=None, init=False, repr=False)

    def copied(self) -> Traffic:
        """A memory that changes independently of this one."""
        twin = shallow_copy(self)
        twin._trails = None
        return twin

    def update(self, passing: Passages, time: float) -> None:
        """Remember where tracks are at `time`, s, every `SPACING` m, and forget what is older than `memory`."""
        if self.settings.memory == 0:
            return
        self._trails = None
        since = time - self.settings.memory
        left, marked, latest = self.left, self.marked, self.latest
        if self._oldest < since:
            left, marked, latest = _since(left, since), _since(marked, since), _since(latest, since)
            self._oldest = min(each.time.min(initial=time) for each in (left, marked, latest))
        self.latest = latest.select(_others(latest.id, passing.id)).append(passing)
        moved = _moved(passing, marked).nonzero()[0]
        if len(moved):
            new = passing.select(moved)
            left, marked = left.append(new), marked.select(_others(marked.id, new.id)).append(new)
            marked = marked.select(np.argsort(marked.id))
        self.left, self.marked = left, marked

    def exchange(self, a: int, b: int, since: float) -> None:
        """Two tracks, by id, have had each other's objects `since` a time, s."""

        def told_apart(known: Passages) -> Passages:
            return replace(known, id=np.where(known.time >= since, exchanged(known.id, a, b), known.id))

        self.left, self.latest, self._trails = told_apart(self.left), told_apart(self.latest), None
        self.marked = self.marked.select(~np.isin(self.marked.id, [a, b]))

    def add_lanes(self, lanes: Sequence[Lane]) -> None:
        """Take in lanes that are not known yet; one of a known name with another centre line replaces that."""
        known = {name: lane.centre for name, (_, lane) in self._known.items()}
        new = [lane for lane in lanes if known.get(lane.name) != lane.centre]
        if not new or self.settings.reach == 0:
            return
        ids = range(self._next_lane, self._next_lane - len(new), -1)
        replaced = [self._known[lane.name][0] for lane in new if lane.name in known]
        points = self.lanes.points.select(~np.isin(self.lanes.points.id, replaced))
        parts = [_lane_points(lane, number) for lane, number in zip(new, ids, strict=True)]
        self.lanes = Trails(Passages.concatenate([points, *parts]))
        self._known = {**self._known, **{lane.name: (k, lane) for k, lane in zip(ids, new, strict=True)}}
        self._next_lane -= len(new)

    def passes_beside(self, heading: FloatArray, position: FloatArray) -> BoolArray:
        """True (n,) where traffic of a heading (n,), rad, passed beside places (n, 2), world, m, none through them."""
        points = self.trails().points
        ahead, aside = ahead_and_aside(points.position - position[:, None], unit(heading)[:, None])
        alike = (np.abs(ahead) < SPACING) & (np.cos(points.heading - heading[:, None]) > np.cos(TURN))
        nearest = np.where(alike, np.abs(aside), np.inf).min(axis=1, initial=np.inf)
        return np.asarray((nearest > self.settings.reach) & (nearest < BESIDE))

    def trails(self) -> Trails:
        """The passages of those that move."""
        if self._trails is None:
            self._trails = Trails(self.left.select(self.left.moves).append(self.latest.select(self.latest.moves)))
        return self._trails


def _since(passages: Passages, time: float) -> Passages:
    """The passages at or after a time, s."""
    old = passages.time < time
    return passages.select(~old) if old.any() else passages


def _others(ids: IntArray, known: IntArray) -> IntArray:
    """Rows of the ids (n,) that are not among the `known` (k,)."""
    names = set(known.tolist())
    return np.array([row for row, name in enumerate(ids.tolist()) if name not in names], dtype=np.int64)


def _moved(passing: Passages, marked: Passages) -> BoolArray:
    """(n,) whether tracks are at least `SPACING` m from their marks, or have none."""
    if len(marked) == 0:
        return np.ones(len(passing), dtype=np.bool_)
    at = np.minimum(np.searchsorted(marked.id, passing.id), len(marked) - 1)
    dx, dy = (passing.position - marked.position[at]).T
    return np.asarray((marked.id[at] != passing.id) | (dx * dx + dy * dy >= SPACING**2))


STEP = 3.0  # m between the points of a predicted path
NEAREST = 12  # passages that are compared with a place
PRIOR = 0.2  # weight of going on as before, against that of one trail right here: few leave the path of others
TURN = 0.3  # rad, sigma of the kernel on the difference of headings
AGREEMENT = 0.2  # rad, deviation of the headings of trails from which they say little
_BEND = 20.0  # m, along which a curvature of one's own fades
_MIN_REACH = 1e-9  # m
_NO_TRAILS = Trails(Passages.empty())


def paths(
    traffic: Traffic,
    ids: IntArray,
    position: FloatArray,
    heading: FloatArray,
    curvature: FloatArray,
    sharpest: FloatArray,
    steps: int,
) -> Paths:
    """Predict the paths of n tracks `ids` at `position` (n, 2), world, with a `curvature` (n,) of their own, 1/m.

    Their steps are `STEP` m long, their rows 0 to n - 1; `sharpest` (n, 2), rad: largest turns at once and in a step.
    """
    reach = max(traffic.settings.reach, _MIN_REACH)
    of_lanes, of_trails = (traffic.lanes, traffic.trails()) if traffic.settings.reach > 0 else (_NO_TRAILS, _NO_TRAILS)
    lanes, trails = of_lanes.points, of_trails.points
    (lane_cells, lane_latest), (trail_cells, trail_latest) = of_lanes.by_cell(2 * reach), of_trails.by_cell(2 * reach)
    found = trail_paths(
        lane_of=lanes.id,
        lane_points=lanes.position,
        lane_headings=lanes.heading,
        lane_speeds=lanes.speed,
        lane_timed=np.isfinite(lanes.variance),
        lane_cells=lane_cells,
        lane_latest=lane_latest,
        trail_of=trails.id,
        trail_points=trails.position,
        trail_headings=trails.heading,
        trail_speeds=trails.speed,
        trail_timed=np.isfinite(trails.variance),
        trail_cells=trail_cells,
        trail_latest=trail_latest,
        ids=ids,
        position=position,
        heading=heading,
        curvature=curvature,
        sharpest=sharpest,
        steps=steps,
        most=NEAREST,
        reach=reach,
        length=STEP,
        bend=_BEND,
        turning=TURN,
        prior=PRIOR,
        agreement=AGREEMENT,
    )
    return Paths(np.arange(len(ids)), *found)


def straight_paths(ids: IntArray, position: FloatArray, heading: FloatArray, steps: int) -> Paths:
    """The paths of those who go straight on, see `paths`."""
    none = np.zeros((len(ids), 2))
    return paths(_NO_TRAFFIC, ids, position, heading, none[:, 0], none, steps)


_NO_TRAFFIC = Traffic(TrafficSettings(reach=0.0))
_FARTHEST = 80.0  # exponent from which a passage is too far away to count among the digits
HEADING_SCALE = 0.3  # sigma of the kernel on the difference of headings, rad
SPREAD = 2.0  # standard deviation of the difference between the speeds of neighbours, m/s


class SpeedPrior(NamedTuple):
    """Prior of k new tracks, each (k,): probability of being stationary; if moving, speed ahead, and its variance."""

    stationary: FloatArray
    speed: FloatArray
    variance: FloatArray


def speed_prior(
    traffic: Traffic,
    label: StrArray,
    position: FloatArray,
    heading: FloatArray,
    variance: FloatArray,
    stationary: float = 0.0,
) -> SpeedPrior:
    """The prior of new tracks at `position` (k, 2).

    variance (k,) and probability `stationary` of objects without neighbours
    """
    settings, left, latest = traffic.settings.speed_prior, traffic.left, traffic.latest
    if settings.weight == 0 or len(label) == 0 or len(left) + len(latest) == 0:
        return SpeedPrior(np.full(len(label), stationary), np.zeros(len(label)), variance.copy())
    left_class, latest_class, new_class = common_numbers(left.label, latest.label, label)
    found = prior_of_traffic(
        left=left.id,
        left_class=left_class,
        left_position=left.position,
        left_heading=left.heading,
        left_speed=left.speed,
        left_variance=left.variance,
        left_stationary=left.stationary,
        latest=latest.id,
        latest_class=latest_class,
        latest_position=latest.position,
        latest_heading=latest.heading,
        latest_speed=latest.speed,
        latest_variance=latest.variance,
        latest_stationary=latest.stationary,
        new_class=new_class,
        position=position,
        heading=heading,
        variance=variance,
        stationary=stationary,
        weight=settings.weight,
        ahead_scale=settings.ahead_scale,
        lateral_scale=settings.lateral_scale,
        heading_scale=HEADING_SCALE,
        spread=SPREAD,
        most_variance=settings.max_speed_deviation**2,
        farthest=_FARTHEST,
    )
    return SpeedPrior(*found)
