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

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.errors import InputError, error_context
from saga_fg.numerics import FloatArray, IntArray, StrArray, wrap_angle
from saga_fg.types import Lane, Point, RoadMap, StopLine, TrafficLight

BEYOND = 12.0  # m from a stop line to its light
REACH = 30.0  # m beyond a stop line at which a movement shows its direction
TURN = np.radians(30.0)  # change of heading from which a movement is a turn
TOUCHING = 0.5  # m between the ends of stop lines that are one
SAME = 0.05  # m between points that are one
LONGEST = 1_000_000  # steps of a part of a cycle
COLOURS = {"red": "red", "yellow": "amber", "redYellow": "red", "green": "green", "inactive": ""}
MOVEMENTS = ("left", "straight", "right")
_ORDER = ("green", "amber", "red", "")  # of several lights the first counts


@dataclass(frozen=True, eq=False)
class Lanelet:
    """A piece of a lane: borders (k, 2) in the direction of travel; stop line (2, 2): left and right end, or None."""

    id: int
    left: FloatArray
    right: FloatArray
    successors: list[int]
    stop_line: FloatArray | None
    lights: list[int]

    @property
    def centre(self) -> FloatArray:
        """(k, 2) the middle of both borders."""
        count = max(len(self.left), len(self.right))
        return (_resampled(self.left, count) + _resampled(self.right, count)) / 2

    @property
    def width(self) -> float:
        """Mean of the widths at both ends, m."""
        return float(np.mean([np.hypot(*(self.left[k] - self.right[k])) for k in (0, -1)]))


@dataclass(frozen=True, eq=False)
class Light:
    """A light: the movements that it governs, and the colours (n,) of its cycle, each of whose parts ends at `ends`."""

    id: int
    movements: frozenset[str]
    colours: StrArray
    ends: IntArray
    offset: int

    def at(self, step: IntArray) -> StrArray:
        """Colours (n,) at steps (n,)."""
        part = np.searchsorted(self.ends, (step - self.offset) % self.ends[-1], side="right")
        return np.asarray(self.colours[part])


def road_of(entry: Any, what: str, steps: IntArray | None) -> tuple[RoadMap, dict[str, StrArray]]:
    """The road map, and by the name of each light its colours (K,) at `steps` (K,); without these no cycle is read.

    Raises `InputError` that begins with `what` for an entry that is not as above, and for a light without a cycle.
    """
    lanelets = {each.id: each for each in (_lanelet(one, what) for one in _unique(entry, "lanelets", what))}
    lights = {one["id"]: _light(one, what, steps is not None) for one in _unique(entry, "lights", what)}
    for lanelet in lanelets.values():
        for light in lanelet.lights:
            _expect(light in lights, f"{what}: lanelet {lanelet.id}: lights: there is no light {light}")
    mapped: dict[str, TrafficLight] = {}
    lines: list[StopLine] = []
    colours: dict[str, StrArray] = {}
    for governing, (left, right) in _stop_lines(lanelets, lights):
        name = "-".join(["light", *(str(light.id) for light in governing)])
        line = StopLine(f"line-{len(lines)}", _point(left), _point(right), name)
        lines.append(line)
        if name in mapped:
            continue
        ahead = np.array([np.cos(line.heading), np.sin(line.heading)])
        mapped[name] = TrafficLight(name, _point((left + right) / 2 + BEYOND * ahead))
        if steps is not None:
            shown = np.stack([light.at(steps) for light in governing])
            colours[name] = np.select([(shown == colour).any(axis=0) for colour in _ORDER], list(_ORDER), "")
    with error_context(what):
        return RoadMap(tuple(mapped.values()), tuple(lines), tuple(_lanes(lanelets))), colours


def _lanes(lanelets: dict[int, Lanelet]) -> Iterator[Lane]:
    """Lanes of lanelets without a branch in between."""
    into = Counter(successor for lanelet in lanelets.values() for successor in lanelet.successors)
    single = {each.id: each.successors[0] for each in lanelets.values() if len(each.successors) == 1}
    following = {one: other for one, other in single.items() if other in lanelets and into[other] == 1}
    continued = set(following.values())
    done: set[int] = set()
    for start in (*(each for each in lanelets if each not in continued), *lanelets):  # the latter for circles
        chain: list[Lanelet] = []
        at: int | None = start
        while at is not None and at not in done:
            done.add(at)
            chain.append(lanelets[at])
            at = following.get(at)
        if chain:
            points = np.concatenate([lanelet.centre for lanelet in chain])
            points = points[np.append(True, np.hypot(*np.diff(points, axis=0).T) > SAME)]
            width = float(np.median([lanelet.width for lanelet in chain]))
            if len(points) > 1:
                yield Lane(f"lane-{start}", tuple(map(_point, points)), max(width, SAME))


def _stop_lines(lanelets: dict[int, Lanelet], lights: dict[int, Light]) -> Iterator[tuple[Sequence[Light], FloatArray]]:
    """The stop lines that lights govern: these, left and right end (2, 2)."""
    found: list[tuple[list[Light], FloatArray]] = []
    for lanelet in lanelets.values():
        if lanelet.stop_line is not None and lanelet.lights:
            possible, its = _movements(lanelet, lanelets), [lights[light] for light in lanelet.lights]
            found.append(([light for light in its if possible <= light.movements] or its, lanelet.stop_line))
    while found:
        governing, ends = found.pop(0)
        k = 0
        while k < len(found):
            same, (left, right) = found[k][0] == governing, found[k][1]
            if same and np.hypot(*(ends[1] - left)) < TOUCHING:
                ends = np.stack([ends[0], right])
            elif same and np.hypot(*(ends[0] - right)) < TOUCHING:
                ends = np.stack([left, ends[1]])
            else:
                k += 1
                continue
            del found[k]
            k = 0
        yield governing, ends


def _movements(lanelet: Lanelet, lanelets: dict[int, Lanelet]) -> frozenset[str]:
    """Directions, of left, straight, right, in which one can go on within some metres beyond the lanelet."""
    start, found = _heading(lanelet.centre), set()
    open_ends = [(successor, 0.0) for successor in lanelet.successors if successor in lanelets]
    for _ in range(1000):
        if not open_ends:
            break
        name, distance = open_ends.pop()
        centre = lanelets[name].centre
        distance += float(np.hypot(*np.diff(centre, axis=0).T).sum())
        onward = [(successor, distance) for successor in lanelets[name].successors if successor in lanelets]
        if distance < REACH and onward:
            open_ends += onward
        else:
            turn = wrap_angle(_heading(centre) - start)
            found.add("left" if turn > TURN else "right" if turn < -TURN else "straight")
    return frozenset(found)


def _heading(line: FloatArray) -> float:
    """Direction of the last part of a line, rad."""
    return float(np.arctan2(*(line[-1] - line[-2])[::-1]))


def _resampled(line: FloatArray, count: int) -> FloatArray:
    """`count` points at even distances along a line; the line itself where it has so many."""
    if len(line) == count:
        return line
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])


def _lanelet(entry: dict[str, Any], what: str) -> Lanelet:
    what = f"{what}: lanelet {entry['id']}"
    left, right = _points(entry, "left", what), _points(entry, "right", what)
    _expect(min(len(left), len(right)) > 1, f"{what}: left, right: expected at least two points")
    line, ends = entry.get("stop_line"), None
    if isinstance(line, str):
        ends = np.stack([left[-1], right[-1]])
    elif line is not None:
        ends = _points(entry, "stop_line", what)
        _expect(len(ends) == 2, f"{what}: stop_line: expected two points, got {len(ends)}")
        across, heading = ends[0] - ends[1], _heading(left)
        if np.cos(heading) * across[1] - np.sin(heading) * across[0] < 0:  # left is where drivers see it
            ends = ends[::-1]
    twice = ends is not None and bool((ends[0] == ends[1]).all())
    _expect(not twice, f"{what}: stop_line: expected two different ends, got one twice")
    ids = {key: _list(entry, key, what) for key in ("successor", "lights")}
    for key, found in ids.items():
        _expect(all(map(_whole, found)), f"{what}: {key}: expected whole numbers, got {found!r:.60}")
    successors, lights = (list(dict.fromkeys(found)) for found in ids.values())
    return Lanelet(entry["id"], left, right, successors, ends, lights)


def _light(entry: dict[str, Any], what: str, with_cycle: bool) -> Light:
    what, direction = f"{what}: light {entry['id']}", str(entry.get("direction", "all")).lower()
    movements = frozenset(each for each in MOVEMENTS if each in direction) or frozenset(MOVEMENTS)
    used: dict[str, Any] = entry if with_cycle else {"cycle": [["red", 1]]}
    cycle, offset = used.get("cycle"), used.get("time_offset", 0)
    if not isinstance(cycle, list) or not cycle:
        raise InputError(
            f"{what}: cycle: expected [colour, steps], ..., there is none; --road map leaves colours unknown"
        )
    for part in cycle:
        good = isinstance(part, list) and len(part) == 2 and part[0] in (*COLOURS,) and _whole(part[1])
        good = good and 0 < part[1] <= LONGEST
        _expect(good, f"{what}: cycle: expected [one of {', '.join(COLOURS)}, steps above 0], got {part!r:.60}")
    _expect(_whole(offset), f"{what}: time_offset: expected a whole number of steps, got {offset!r:.60}")
    colours = np.array([COLOURS[colour] for colour, _ in cycle])
    return Light(entry["id"], movements, colours, np.cumsum([steps for _, steps in cycle]), offset)


def _expect(good: bool, message: str) -> None:
    if not good:
        raise InputError(message)


def _unique(entry: Any, key: str, what: str) -> list[dict[str, Any]]:
    """The entries of a list, each of which has an id of its own."""
    found, seen = _list(entry, key, what), set()
    for one in found:
        name = one.get("id") if isinstance(one, dict) else None
        _expect(_whole(name), f"{what}: {key[:-1]}: id: expected a whole number, got {name!r:.60}")
        _expect(name not in seen, f"{what}: {key}: expected unique ids, {name} occurs twice")
        seen.add(name)
    return found


def _list(entry: Any, key: str, what: str) -> list[Any]:
    found = entry.get(key) if isinstance(entry, dict) else None
    _expect(isinstance(found, list), f"{what}: {key}: expected a list, got {found!r:.60}")
    return list(found or ())


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53


def _points(entry: Any, key: str, what: str) -> FloatArray:
    try:
        points = np.array(_list(entry, key, what), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.empty(0)
    good = points.ndim == 2 and points.shape[1] == 2 and bool((np.abs(points) < 1e9).all())
    _expect(good, f"{what}: {key}: expected points [x, y] of finite numbers, m")
    return points


def _point(position: FloatArray) -> Point:
    return float(position[0]), float(position[1])
