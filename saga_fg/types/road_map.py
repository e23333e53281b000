"""Road maps: traffic lights, the stop lines they control, lanes and walls, in world coordinates.

A `Frame` may carry a map (`frame.road_map`), such as a tile along the drive, or the configuration holds one
(`tracker.road_map`). Every element becomes a node of the scene graph: its place is a state with a standard deviation,
as maps err too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
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
class StopLine:
    """A line where a red light stops traffic; `left` and `right` are its ends as approaching drivers see them."""

    name: str = required_setting("its name")
    left: Point = required_setting("left end (x, y), m")
    right: Point = required_setting("right end (x, y), m")
    light: str = required_setting("name of the light that governs it")

    def __post_init__(self) -> None:
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
    stop_lines: tuple[StopLine, ...] = setting((), "stop lines, each with the name of its light")
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
            if line.light not in lights:
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
