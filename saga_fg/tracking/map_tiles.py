"""Elements of several maps, such as tiles along a drive: which are the same, and a name of its own for each.

Two elements of one class are the same if they have one name and lie beside each other, as in a map that was corrected
or cut elsewhere; or if they lie in one place under two names, and none of that place has this name already. Another
element of a name that is taken gets a number after it. Elements of one map are never the same.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import replace
from itertools import count
from typing import TypeVar

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight, Wall

Element = TrafficLight | StopLine | Lane | Wall
E = TypeVar("E", TrafficLight, StopLine, Lane, Wall)

BESIDE = 4.0  # m, to which corrections move an element; others of its name are farther away
SAME = 0.1  # m, within which maps that write one place twice agree
_NUMBER = " ("  # before the number of a name that occurs again


def elements(road_map: RoadMap) -> tuple[Element, ...]:
    """All elements of a map."""
    return *road_map.lights, *road_map.stop_lines, *road_map.lanes, *road_map.walls


def in_known_names(road_map: RoadMap, known: Mapping[str, Element]) -> RoadMap:
    """A map with the names of the `known` elements for those that are the same, and new names for all others."""
    if not known or all(known.get(each.name) == each for each in elements(road_map)):
        return road_map
    own = {each.name for each in elements(road_map)}
    name: dict[str, str] = {}
    for each in elements(road_map):
        alike = (other for found, other in known.items() if found.partition(_NUMBER)[0] == each.name)
        same = next((other for other in alike if _beside(each, other)), None)
        if same is not None:
            name[each.name] = same.name
    left = [other for other in known.values() if other.name not in name.values()]
    for each in elements(road_map):
        if each.name in name:
            continue
        same = next((other for other in left if _in_place(each, other)), None)
        if same is not None:
            left.remove(same)
        name[each.name] = _free(each.name, known, own) if same is None else same.name
    if all(old == new for old, new in name.items()):
        return road_map

    def named(group: Iterable[E]) -> tuple[E, ...]:
        return tuple(replace(each, name=name[each.name]) for each in group)

    lines = tuple(replace(line, light=name[line.light]) for line in named(road_map.stop_lines))
    return replace(
        road_map,
        lights=named(road_map.lights),
        stop_lines=lines,
        lanes=named(road_map.lanes),
        walls=named(road_map.walls),
    )


def _free(name: str, *taken: Container[str]) -> str:
    """The name, if no known element has it, or with the first number with which it is free."""
    if name not in taken[0]:
        return name
    numbered = (f"{name}{_NUMBER}{k})" for k in count(2))
    return next(each for each in numbered if not any(each in names for names in taken))


def _points(of: Element) -> FloatArray:
    """(k, 2) m."""
    if isinstance(of, TrafficLight):
        return np.array([of.position])
    return of.ends if isinstance(of, StopLine) else np.array(of.centre if isinstance(of, Lane) else of.points)


def _in_place(a: Element, b: Element) -> bool:
    """True if two elements of one class are the same points."""
    if type(a) is not type(b):
        return False
    p, q = _points(a), _points(b)
    return p.shape == q.shape and bool(np.abs(p - q).max() < SAME)


def _beside(a: Element, b: Element) -> bool:
    """True if two elements are of one class and the middle of each is beside the other."""
    if type(a) is not type(b):
        return False
    p, q = (_dense(_points(each)) for each in (a, b))
    return all(np.hypot(*(x - y[len(y) // 2]).T).min() < BESIDE for x, y in ((p, q), (q, p)))


def _dense(points: FloatArray) -> FloatArray:
    """Points every metre or so along a line."""
    if len(points) == 1:
        return points
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, way[-1], max(3, round(way[-1]) | 1))
    return np.stack([np.interp(at, way, each) for each in points.T], axis=-1)
