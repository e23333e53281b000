"""Road maps: lanes, walls, stop lines, the lights that control them, and the lanes across each line.

All are in world coordinates. A stop line without a light is that of a stop sign, of a yield sign or of a crossing of
people: there `saga_fg.tracking.edge_record` expects vehicles to halt.

A `Frame` may carry a map (`frame.road_map`), such as a tile along the drive, or the configuration holds one
(`tracker.road_map`). Every element becomes a node of the scene graph: its place is a state with a standard deviation,
as maps err too.

The state of a traffic light: a hidden Markov belief in continuous time, from reported colours and from who moves.

    red -> starting -> green -> amber -> red, each after an exponential time of its mean duration:
    p(t + dt) = p(t) exp(G dt),    G_kk = -1 / duration_k,    G_k,next(k) = 1 / duration_k
    p_k <- p_k P(reported colour | k) / sum,    P = accuracy for the true colour, (1 - accuracy) / 2 for each other
    p_k <- p_k N(dv; a_k T, V) / sum            first vehicle before a line: its change of speed dv in T seconds

`starting` is green as well: drivers have not reacted yet. a_k is the acceleration that the edge rules expect in state
k (`saga_fg.tracking.map_nodes`).

The belief is the discrete part of a hybrid node; it mixes the interaction functions of the node's edges: with
probability p_closed = p_red + p_amber a stop line holds traffic, with p_green it lets it go, so that the rates of those
edges are multiplied by them, which is the mean of the dynamics (the first moment of an interacting-multiple-model
prediction, Blom and Bar-Shalom 1988).

Source: Rabiner, A tutorial on hidden Markov models, 1989 (forward recursion).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np
import scipy.linalg

from saga_fg.errors import InputError
from saga_fg.numerics import Feet, FloatArray, IntArray, Polylines
from saga_fg.settings import Positive, Settings, required_setting, setting

Point = tuple[float, float]
LIGHT, STOP_LINE, LANE, WALL = "traffic_light", "stop_line", "lane", "wall"
MAP_CLASSES = (LIGHT, STOP_LINE, LANE, WALL)  # classes of the nodes that a map brings


@dataclass(frozen=True)
class TrafficLight:
    """A traffic light that can be seen, known by its name."""

    name: str = required_setting("its name")
    position: Point = required_setting("(x, y) in the world, m")

    def __post_init__(self) -> None:
        _require_name(self.name)
        _require_points(f"traffic light {self.name}: position", (self.position,))


@dataclass(frozen=True)
class StopLine(Settings):
    """A line where traffic halts or yields; `left` and `right` are its ends as approaching drivers see them."""

    name: str = required_setting("its name")
    left: Point = required_setting("left end (x, y), m")
    right: Point = required_setting("right end (x, y), m")
    light: str = setting("", "name of the light that governs it, if there is one")
    sign: Literal["stop", "yield", "crossing"] = setting(
        "stop", "without a light: stop or yield sign, or crossing of people; stop: more vehicles are expected to halt"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_name(self.name)
        _require_points(f"stop line {self.name}: left, right", (self.left, self.right))
        if self.left == self.right:
            raise InputError(f"stop line {self.name}: expected two different ends, got {self.left} twice")

    @property
    def ends(self) -> FloatArray:
        """(2, 2): left, right, m."""
        return np.array([self.left, self.right])

    @property
    def heading(self) -> float:
        """Direction of travel across the line, rad."""
        x, y = self.ends[0] - self.ends[1]
        return math.atan2(-x, y)


@dataclass(frozen=True)
class Lane(Settings):
    """A lane: its centre line in the direction of travel."""

    name: str = required_setting("its name")
    centre: tuple[Point, ...] = required_setting("points (x, y) of the centre line in the direction of travel, m")
    width: Positive = setting(3.5, "its width, m")

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_name(self.name)
        _require_points(f"lane {self.name}: centre", self.centre)
        if len(self.centre) < 2 or not np.hypot(*np.diff(np.array(self.centre), axis=0).T).all():
            raise InputError(f"lane {self.name}: centre: expected at least two points, neighbours apart")


@dataclass(frozen=True)
class Wall:
    """An obstacle to pedestrians: a house front, a fence."""

    name: str = required_setting("its name")
    points: tuple[Point, ...] = required_setting("points (x, y) of its foot, m")

    def __post_init__(self) -> None:
        _require_name(self.name)
        _require_points(f"wall {self.name}: points", self.points)
        if len(self.points) < 2:
            raise InputError(f"wall {self.name}: points: expected at least two, got {len(self.points)}")


@dataclass(frozen=True)
class RoadMap(Settings):
    """Elements of the road with names of their own, and how well their places are known."""

    lights: tuple[TrafficLight, ...] = setting((), "traffic lights")
    stop_lines: tuple[StopLine, ...] = setting((), "stop lines, with the names of their lights")
    lanes: tuple[Lane, ...] = setting((), "lanes")
    deviation: Positive = setting(0.2, "standard deviation of the positions in the map, m")
    walls: tuple[Wall, ...] = setting((), "walls, which pedestrians keep away from (edge rule repulsion)")

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [e.name for group in (self.lights, self.stop_lines, self.lanes, self.walls) for e in group]
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice is not None:
            raise InputError(f"road map: expected unique names, {twice!r} occurs twice")
        lights = {light.name for light in self.lights}
        for line in self.stop_lines:
            if line.light and line.light not in lights:
                raise InputError(f"stop line {line.name}: light: there is no traffic light {line.light!r} in the map")

    def __len__(self) -> int:
        return len(self.lights) + len(self.stop_lines) + len(self.lanes) + len(self.walls)


def _require_name(name: str) -> None:
    if not isinstance(name, str) or not name:
        raise InputError(f"name: expected a name, got {name!r}")


def _require_points(what: str, points: tuple[Point, ...]) -> None:
    array = np.array(points, dtype=np.float64) if points else np.empty((0, 2))
    if array.ndim != 2 or array.shape[1] != 2 or not np.isfinite(array).all():
        raise InputError(f"{what}: expected points (x, y) of finite numbers, m")


COLOURS = ("red", "amber", "green")
STATES = ("red", "amber", "starting", "green")
COLOUR_OF_STATE = np.array([0, 1, 2, 2])  # (4,) numbers in COLOURS
COLOUR_LABELS = tuple(f"traffic_light_{colour}" for colour in COLOURS)  # labels of detections that report a colour
START_DELAY = 1.5  # s, mean time from green until the first driver starts; usual 1 to 2
NON_COMPLIANCE = 0.1  # h, share of drivers who turn at red or cannot leave at green; usual 0.05 to 0.3
MIN_BELIEF = 1e-6  # no state is ever ruled out
MAX_LIGHT_DISTANCE = 4.0  # a reported light belongs to no known light further away than this, m


@dataclass(frozen=True)
class SignalSettings(Settings):
    """Colour changes of traffic lights, and the effect of the belief on stop lines."""

    red_duration: Positive = setting(
        15.0, "mean duration of red, s; usual 10 to 60; higher: lights are believed to stay red longer"
    )
    amber_duration: Positive = setting(
        3.0, "mean duration of amber, s; usual 3 to 5; higher: lights are believed to stay amber longer"
    )
    green_duration: Positive = setting(
        15.0, "mean duration of green, s; usual 10 to 60; higher: lights are believed to stay green longer"
    )
    driver_noise: Positive = setting(
        2.0,
        "spectral density of the acceleration of drivers before a line about that of the rules, m^2/s^3; usual 0.5 to "
        "4; higher: colours are inferred from traffic more slowly",
    )

    @cached_property
    def _durations(self) -> FloatArray:
        """(4,) s."""
        return np.array([self.red_duration, self.amber_duration, START_DELAY, self.green_duration])

    @cached_property
    def generator(self) -> FloatArray:
        """G (4, 4), 1/s."""
        following = np.array([STATES.index(name) for name in ("starting", "red", "green", "amber")])
        G = -np.diag(1 / self._durations)
        G[np.arange(len(STATES)), following] = 1 / self._durations
        return G

    @property
    def stationary(self) -> FloatArray:
        """(4,) belief without observations: the shares of the durations."""
        return np.asarray(self._durations / self._durations.sum())

    def predicted(self, belief: FloatArray, dt: float) -> FloatArray:
        """Beliefs (n, 4) dt seconds later."""
        return np.asarray(belief @ scipy.linalg.expm(self.generator * dt))

    def closed(self, belief: FloatArray) -> FloatArray:
        """(n,) weight with which stop lines of lights with these beliefs (n, 4) hold traffic."""
        return np.asarray(belief[:, 0] + belief[:, 1])

    def open(self, belief: FloatArray) -> FloatArray:
        """(n,) weight with which stop lines of lights with these beliefs (n, 4) let waiting vehicles go."""
        return np.asarray(belief[:, 3])


def colours(belief: FloatArray) -> FloatArray:
    """Probabilities (3,) of red, amber and green of a belief (4,)."""
    return np.asarray(np.bincount(COLOUR_OF_STATE, belief, len(COLOURS)), dtype=np.float64)


def colour_updated(belief: FloatArray, colour: int, accuracy: float) -> FloatArray:
    """The belief (4,) after a report of a colour (its number) that is right with the chance `accuracy`."""
    return updated(belief, np.log(np.where(colour == COLOUR_OF_STATE, accuracy, (1 - accuracy) / 2) + 1e-300))


def updated(belief: FloatArray, log_likelihood: FloatArray) -> FloatArray:
    """The belief (4,) after an observation with these logarithms of its likelihoods (4,)."""
    posterior = belief * np.exp(log_likelihood - log_likelihood.max())
    posterior = np.maximum(posterior / posterior.sum(), MIN_BELIEF)
    return np.asarray(posterior / posterior.sum())


class InLane(NamedTuple):
    """Vehicles in lanes, m pairs: vehicle (m,) and lane (m,), and the feet of the vehicles on the centres."""

    vehicle: IntArray
    lane: IntArray
    feet: Feet


@dataclass(frozen=True, eq=False)
class LanesAcross:
    """P pairs of a stop line and one of L lanes that crosses it.

    centre, width       of the lanes: polylines in world coordinates, (L,) m
    low, high           (L, 2) corners of the boxes about the lanes, m
    line, lane          (P,) of the pairs, in the order of the lines
    s, e, direction     (P,), (P,), (P, 2): where the middle of the line is along the lane and to its left, m, and the
                        direction of the lane there
    origin              (2,) of the coordinates in which vehicles are placed, world, m
    """

    centre: Polylines
    width: FloatArray
    low: FloatArray
    high: FloatArray
    line: IntArray
    lane: IntArray
    s: FloatArray
    e: FloatArray
    direction: FloatArray
    origin: FloatArray

    @classmethod
    def from_lanes(cls, lanes: Sequence[Lane], lines: Sequence[StopLine]) -> Self:
        """A lane crosses a line in its direction of travel, between its ends; straight on before and after it."""
        ends = np.array([line.ends for line in lines]).reshape(-1, 2, 2)
        heading = np.array([line.heading for line in lines])
        line, lane = np.divmod(np.arange(len(lines) * len(lanes)), max(len(lanes), 1))
        centre = Polylines.from_points([np.array(each.centre) for each in lanes])
        at = centre.feet(lane, ends.mean(axis=1)[line])
        travel = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        half = np.hypot(*(ends[:, 0] - ends[:, 1]).T) / 2
        crosses = (np.einsum("pi,pi->p", at.direction, travel[line]) > 0) & (np.abs(at.e) <= half[line])
        at, line = at.select(crosses), line[crosses]
        kept, lane = np.unique(lane[crosses], return_inverse=True)  # without lanes that cross no line
        points = [np.array(lanes[k].centre) for k in kept.tolist()]
        width = np.array([lanes[k].width for k in kept.tolist()])
        box = np.array([[each.min(axis=0), each.max(axis=0)] for each in points]).reshape(-1, 2, 2)
        low, high = box[:, 0] - width[:, None], box[:, 1] + width[:, None]
        return cls(
            centre=Polylines.from_points(points),
            width=width,
            low=low,
            high=high,
            line=line,
            lane=lane,
            s=at.s,
            e=at.e,
            direction=at.direction,
            origin=np.zeros(2),
        )

    def placed(self, origin: FloatArray, moved: FloatArray, rows: IntArray) -> LanesAcross:
        """The lanes for vehicles in coordinates about `origin` (2,), with the lines moved by `moved` (lines, 2), m, and
        named `rows` (lines,), increasing."""
        by, (x, y) = moved[self.line], self.direction.T
        along = np.einsum("pi,pi->p", self.direction, by)
        return replace(
            self, origin=origin, line=rows[self.line], s=self.s + along, e=self.e + x * by[:, 1] - y * by[:, 0]
        )

    def of_nodes(self, rows: IntArray) -> LanesAcross:
        """The lanes across the lines that are among the nodes `rows` (k,), ascending, which are counted from 0 then."""
        place = np.searchsorted(rows, self.line).clip(max=max(len(rows) - 1, 0))
        kept = rows[place] == self.line if len(rows) else np.zeros(len(self.line), dtype=np.bool_)
        line, lane, s, e = place[kept], self.lane[kept], self.s[kept], self.e[kept]
        return replace(self, line=line, lane=lane, s=s, e=e, direction=self.direction[kept])

    def inside(self, position: FloatArray, facing: FloatArray) -> InLane:
        """Vehicles at `position` (V, 2), m, in lanes that lead where they are `facing`, unit vectors (V, 2)."""
        place = position + self.origin
        near = ((place[:, None] >= self.low) & (place[:, None] <= self.high)).all(axis=-1)
        vehicle, lane = np.nonzero(near)
        at = self.centre.feet(lane, place[vehicle])
        inside = (np.abs(at.e) <= self.width[lane] / 2) & (at.s >= 0) & (at.s <= self.centre.length[lane])
        inside &= np.einsum("mi,mi->m", at.direction, facing[vehicle]) > 0
        return InLane(vehicle[inside], lane[inside], at.select(inside))

    def crossings(self, line: IntArray) -> tuple[IntArray, IntArray]:
        """Rows of `line` (E,) and the pairs of a line and a lane that each has."""
        first, end = np.searchsorted(self.line, line), np.searchsorted(self.line, line, side="right")
        count = end - first
        row = np.repeat(np.arange(len(line)), count)
        return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + first[row]
