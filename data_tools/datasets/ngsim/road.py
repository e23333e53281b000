"""Lanes, stop lines and signals of lanelets: the road map of a scene, and the colours its lights show over time.

    lanelet   id, left, right ([x, y], ...), successor (ids), adjacent..., stop_line (null, two points, or text: the
              end of the lanelet), lights (ids)
    light     id, direction (movements that it governs: left, straight, right, straightRight, ..., all),
              cycle ([colour, steps], ...), time_offset (steps);   colour at step t: that at (t - time_offset) mod cycle

Lanelets that follow one another without a branch are one lane; where the map ends, the lane ends. Stop lines side by
side with the same lights are one line. A line is governed by those of its lights that are for all movements possible
from it, or by all of its lights if none is; it is open while one of them shows green. A light that is `inactive` shows
nothing. The maps give one point for all lights of an approach, so that a light is placed as a signal head is,
12 m beyond the line it governs.

Source: Bender, Ziegler and Stiller, Lanelets, IEEE IV 2014; CommonRoad, IEEE IV 2017.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from data_tools.files.error_messages import error_context
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.road_map import Lane, Point, RoadMap, StopLine, TrafficLight

BEYOND = 12.0  # m from a stop line to its light
REACH = 30.0  # m beyond a stop line at which a movement shows its direction
TURN = np.radians(30.0)  # change of heading from which a movement is a turn
TOUCHING = 0.5  # m between the ends of stop lines that are one
SAME = 0.05  # m between points that are one
COLOURS = {"red": "red", "yellow": "amber", "redYellow": "red", "green": "green", "inactive": ""}
_ORDER = ("green", "amber", "red", "")  # of several lights the first counts

Colours = Callable[[IntArray], StrArray]
"""Colours (n,) at steps (n,)."""


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A piece of a lane: borders (k, 2) in the direction of travel; stop line (2, 2): left and right end, or None."""

    id: int
    left: FloatArray
    right: FloatArray
    successors: tuple[int, ...]
    stop_line: FloatArray | None
    lights: tuple[int, ...]

    @property
    def centre(self) -> FloatArray:
        """(k, 2) the middle of both borders."""
        if len(self.left) == len(self.right):
            return (self.left + self.right) / 2
        count = max(len(self.left), len(self.right))
        return (_resampled(self.left, count) + _resampled(self.right, count)) / 2

    @property
    def width(self) -> float:
        """Mean of the widths at both ends, m."""
        return float(np.mean([np.hypot(*(self.left[k] - self.right[k])) for k in (0, -1)]))


@dataclass(frozen=True, eq=False)
class Light:
    """A light: the movements that it governs, and its cycle, empty if it has none."""

    id: int
    movements: frozenset[str]
    colours: tuple[str, ...]
    durations: tuple[int, ...]
    offset: int

    def __call__(self, step: IntArray) -> StrArray:
        """Colours (n,) at steps (n,)."""
        ends = np.cumsum(self.durations)
        phase = np.searchsorted(ends, (step - self.offset) % ends[-1], side="right")
        return np.asarray(np.array(self.colours)[phase])


@dataclass(frozen=True, eq=False)
class GoverningLights:
    """Several lights as one: the most open colour."""

    lights: tuple[Light, ...]

    def __call__(self, step: IntArray) -> StrArray:
        shown = np.stack([light(step) for light in self.lights])
        return np.asarray(np.select([(shown == colour).any(axis=0) for colour in _ORDER], list(_ORDER), ""))


def road_of(entry: Any, what: str, with_cycles: bool) -> tuple[RoadMap, dict[str, Colours]]:
    """The road map, and by the name of each light its colours over the steps; none of these without cycles.

    Raises `InputError` that begins with `what` for an entry that is not as above, and for a light without a cycle.
    """
    lanelets = _by_id([_lanelet(each, what) for each in _list(entry, "lanelets", what)], f"{what}: lanelets")
    lights = _by_id([_light(each, what, with_cycles) for each in _list(entry, "lights", what)], f"{what}: lights")
    for lanelet in lanelets.values():
        unknown = [light for light in lanelet.lights if light not in lights]
        if unknown:
            raise InputError(f"{what}: lanelet {lanelet.id}: lights: there is no light {unknown[0]}")
    mapped: list[TrafficLight] = []
    lines: list[StopLine] = []
    cycles: dict[str, Colours] = {}
    for (name, governing), ends in _stop_lines(lanelets, lights):
        left, right = ends
        line = StopLine(f"line-{len(lines)}", _point(left), _point(right), name)
        if name not in cycles:
            ahead = np.array([np.cos(line.heading), np.sin(line.heading)])
            mapped.append(TrafficLight(name, _point((left + right) / 2 + BEYOND * ahead)))
            cycles[name] = GoverningLights(governing)
        lines.append(line)
    with error_context(what):
        road = RoadMap(tuple(mapped), tuple(lines), tuple(_lanes(lanelets)))
    return road, cycles if with_cycles else {}


def _lanes(lanelets: dict[int, Lanelet]) -> Iterator[Lane]:
    """Lanes of lanelets without a branch in between."""
    before: dict[int, list[int]] = {}
    for lanelet in lanelets.values():
        for successor in lanelet.successors:
            before.setdefault(successor, []).append(lanelet.id)
    single = {lanelet.id: lanelet.successors[0] for lanelet in lanelets.values() if len(lanelet.successors) == 1}
    following = {one: other for one, other in single.items() if other in lanelets and len(before[other]) == 1}
    continued = set(following.values())
    starts = [each for each in lanelets if each not in continued]
    done: set[int] = set()
    for start in (*starts, *lanelets):  # the latter for lanes that end where they begin
        chain: list[Lanelet] = []
        at: int | None = start
        while at is not None and at not in done:
            done.add(at)
            chain.append(lanelets[at])
            at = following.get(at)
        if not chain:
            continue
        points = np.concatenate([lanelet.centre for lanelet in chain])
        apart = np.append(True, np.hypot(*np.diff(points, axis=0).T) > SAME)
        if apart.sum() > 1:
            width = float(np.median([lanelet.width for lanelet in chain]))
            yield Lane(f"lane-{start}", tuple(map(_point, points[apart])), max(width, SAME))


_Governed = tuple[str, tuple[Light, ...]]


def _stop_lines(lanelets: dict[int, Lanelet], lights: dict[int, Light]) -> list[tuple[_Governed, FloatArray]]:
    """The stop lines that lights govern: name and lights, left and right end (2, 2)."""
    found: list[tuple[_Governed, FloatArray]] = []
    for lanelet in lanelets.values():
        if lanelet.stop_line is None or not lanelet.lights:
            continue
        all_lights = tuple(lights[light] for light in lanelet.lights)
        possible = _movements(lanelet, lanelets)
        governing = tuple(light for light in all_lights if possible <= light.movements) or all_lights
        name = "-".join(["light", *(str(light.id) for light in governing)])
        found.append(((name, governing), lanelet.stop_line))
    joined: list[tuple[_Governed, FloatArray]] = []
    while found:
        governed, ends = found.pop(0)
        k = 0
        while k < len(found):
            (name, _), (left, right) = found[k]
            if name == governed[0] and np.hypot(*(ends[1] - left)) < TOUCHING:
                ends = np.stack([ends[0], right])
            elif name == governed[0] and np.hypot(*(ends[0] - right)) < TOUCHING:
                ends = np.stack([left, ends[1]])
            else:
                k += 1
                continue
            del found[k]
            k = 0
        joined.append((governed, ends))
    return joined


def _movements(lanelet: Lanelet, lanelets: dict[int, Lanelet]) -> frozenset[str]:
    """Directions, of left, straight, right, in which one can go on within some metres beyond the lanelet."""
    start, found = _heading(lanelet.centre), set()
    open_ends = [(successor, 0.0) for successor in lanelet.successors]
    for _ in range(1000):
        if not open_ends:
            break
        name, way = open_ends.pop()
        if name not in lanelets:
            continue
        its = lanelets[name]
        way += float(np.hypot(*np.diff(its.centre, axis=0).T).sum())
        onward = [(successor, way) for successor in its.successors if successor in lanelets]
        if way < REACH and onward:
            open_ends += onward
        else:
            turn = wrap_angle(_heading(its.centre) - start)
            found.add("left" if turn > TURN else "right" if turn < -TURN else "straight")
    return frozenset(found)


def _heading(line: FloatArray) -> float:
    """Direction of the last part of a line, rad."""
    x, y = line[-1] - line[-2]
    return float(np.arctan2(y, x))


def _resampled(line: FloatArray, count: int) -> FloatArray:
    """`count` points at even distances along a line."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def _lanelet(entry: Any, what: str) -> Lanelet:
    name = _id(entry, f"{what}: lanelet")
    what = f"{what}: lanelet {name}"
    left, right = _points(entry, "left", what), _points(entry, "right", what)
    if min(len(left), len(right)) < 2:
        raise InputError(f"{what}: left, right: expected at least two points")
    line = entry.get("stop_line")
    ends = None
    if isinstance(line, str):
        ends = np.stack([left[-1], right[-1]])
    elif line is not None:
        ends = _points(entry, "stop_line", what)
        if len(ends) != 2:
            raise InputError(f"{what}: stop_line: expected two points, got {len(ends)}")
        along = np.array([np.cos(_heading(left)), np.sin(_heading(left))])
        across = ends[0] - ends[1]
        if along[0] * across[1] - along[1] * across[0] < 0:  # left is where drivers see it
            ends = ends[::-1]
    if ends is not None and (ends[0] == ends[1]).all():
        raise InputError(f"{what}: stop_line: expected two different ends, got {ends[0].tolist()} twice")
    return Lanelet(name, left, right, _ids(entry, "successor", what), ends, _ids(entry, "lights", what))


def _light(entry: Any, what: str, with_cycle: bool) -> Light:
    name = _id(entry, f"{what}: light")
    what = f"{what}: light {name}"
    direction = str(entry.get("direction", "all")).lower()
    movements = frozenset(each for each in ("left", "straight", "right") if each in direction)
    movements = movements or frozenset(("left", "straight", "right"))
    if not with_cycle:
        return Light(name, movements, (), (), 0)
    cycle = entry.get("cycle")
    if not isinstance(cycle, list) or not cycle:
        raise InputError(
            f"{what}: cycle: expected [colour, steps], ..., there is none; --road map leaves colours unknown"
        )
    for part in cycle:
        if not (isinstance(part, list) and len(part) == 2 and part[0] in COLOURS and _whole(part[1]) and part[1] > 0):
            raise InputError(f"{what}: cycle: expected [one of {', '.join(COLOURS)}, steps above 0], got {part!r:.60}")
    offset = entry.get("time_offset", 0)
    if not _whole(offset):
        raise InputError(f"{what}: time_offset: expected a whole number of steps, got {offset!r:.60}")
    colours, durations = tuple(COLOURS[part[0]] for part in cycle), tuple(int(part[1]) for part in cycle)
    return Light(name, movements, colours, durations, int(offset))


_Numbered = TypeVar("_Numbered", Lanelet, Light)


def _by_id(entries: list[_Numbered], what: str) -> dict[int, _Numbered]:
    found: dict[int, _Numbered] = {}
    for each in entries:
        if each.id in found:
            raise InputError(f"{what}: expected unique ids, {each.id} occurs twice")
        found[each.id] = each
    return found


def _list(entry: Any, key: str, what: str) -> list[Any]:
    found = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(found, list):
        raise InputError(f"{what}: {key}: expected a list, got {found!r:.60}")
    return found


def _id(entry: Any, what: str) -> int:
    found = entry.get("id") if isinstance(entry, dict) else None
    if not _whole(found):
        raise InputError(f"{what}: id: expected a whole number, got {found!r:.60}")
    return int(found)  # type: ignore[arg-type]


def _ids(entry: Any, key: str, what: str) -> tuple[int, ...]:
    found = _list(entry, key, what)
    odd = next((each for each in found if not _whole(each)), None)
    if odd is not None:
        raise InputError(f"{what}: {key}: expected whole numbers, got {odd!r:.60}")
    return tuple(dict.fromkeys(found))


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53


def _points(entry: Any, key: str, what: str) -> FloatArray:
    try:
        points = np.array(_list(entry, key, what), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or not (np.abs(points) < 1e9).all():
        raise InputError(f"{what}: {key}: expected points [x, y] of finite numbers, m")
    return points


def _point(position: FloatArray) -> Point:
    return float(position[0]), float(position[1])
