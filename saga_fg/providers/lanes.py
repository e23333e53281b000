"""Attraction to lanes: vehicles that go along a lane keep to its centre line, r = e - c, r ~ N(0, deviation^2 / dt).

e is the offset from the line at the foot of where an object is, c how far the line lies aside of where the map has it,
a variable for all time with a prior (`factors.lane`). The loss is robust: it lets go of objects that change lanes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors import Robust, lane_keeping_factors, prior_factor
from saga_fg.errors import InputError
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.keys import MAP_NODE, OBJECT
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.model.edge_rules import VEHICLES
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.polyline import feet, on_it
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.types.road_map import Lane

_ALONG = 0.9  # cosine of the angle between a course and a lane within which an object goes along it
_LETS_GO = 3.0  # standard deviations
MIN_SPEED = 1.0  # ignore vehicles slower than this, m/s


@dataclass(frozen=True)
class LaneKeeping(Settings):
    """Attracts vehicles that drive along a lane to its centre line."""

    lanes: tuple[Lane, ...] = settings_group(tuple, "lanes in world coordinates")
    deviation: Positive = setting(
        0.5, "standard deviation of the offset left after one second in the lane, m; lower: stronger"
    )
    map_deviation: Positive = setting(0.3, "standard deviation of the lanes in the map, m")
    classes: tuple[str, ...] = setting(VEHICLES, "classes that keep to lanes")
    name = "lanes"

    def factors(self, view: GraphView) -> Additions:
        if not self.lanes:
            raise InputError("lanes: expected one at least")
        objects = [one for one in view.now(OBJECT).values() if one.label in self.classes and one.dim >= 4]
        if not objects or view.dt == 0:
            return Additions()
        states = np.array([view.state(one.key)[:4] for one in objects])  # (x, y, vx, vy, ...)
        known, new, factors = view.static(MAP_NODE), list[NewVariable](), list[Factor]()
        for number, lane in enumerate(self.lanes):
            mine, frames = self._in_lane(lane, states, view.origin)
            if len(mine) == 0:
                continue
            key = view.key(MAP_NODE, number, static=True)
            if number not in known:
                new.append(NewVariable(MAP_NODE, number, np.zeros(1), static=True, label=f"lane {lane.name}"))
                factors.append(prior_factor(key, np.zeros(1), [[self.map_deviation**2]]))
            for row, frame in zip(mine.tolist(), frames, strict=True):
                one = objects[row]
                rows, variance = np.array([[one.key, key]], dtype=np.uint64), self.deviation**2 / view.dt
                loss = Robust("cauchy", _LETS_GO)
                factors.append(lane_keeping_factors(rows, variance, frame, 1, one.dim, robust=loss))
        return Additions(new, factors)

    def _in_lane(self, lane: Lane, states: FloatArray, origin: FloatArray) -> tuple[IntArray, FloatArray]:
        """Rows (k,) of the states that go along a lane, and world_T_curve (k, 4, 4) at their feet."""
        centre, speed = np.array(lane.centre) - origin, np.hypot(*states[:, 2:].T)
        at = feet(centre, states[:, :2])
        along = np.einsum("ni,ni->n", at.direction, states[:, 2:])
        inside = on_it(centre, at.s) & (np.abs(at.e) < lane.width / 2)
        mine = np.flatnonzero(inside & (speed >= MIN_SPEED) & (along >= _ALONG * speed))
        frames = np.tile(np.eye(4), (len(mine), 1, 1))
        x, y = at.direction[mine].T
        frames[:, :2, 0], frames[:, :2, 1] = np.stack([x, y], axis=1), np.stack([-y, x], axis=1)
        frames[:, :2, 3] = at.point[mine]
        return mine, frames
