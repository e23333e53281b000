"""Features of a regressor that predicts hidden objects without a filter.

Of the object, from its own detections before the gap: speed, acceleration, turn rate, and class. Ahead of it, on the
arc that it is on: the gap to its leader and the leader's motion, as far as the leader is detected during the gap, and
the next stop line and its light. Of the lane that it is in: how it bends. NaN stands for what is not known.

Other vehicles are where their labels are at the moments at which they are detected: an advantage over a tracker.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.learning.gaps import FOLLOWED, Gap
from saga_fg.learning.interaction_fit import ROAD_USERS
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.learning.route import ONWARD, Route
from saga_fg.learning.situations import first_line, leader_on, lights_at
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import wrap_angle

RECENT = 0.8  # s of detections that tell the velocity
LEAST_SPEED = 1.0  # m/s from which the direction of travel is a heading
TIGHTEST = 0.2  # 1/m, curvature of an arc
AHEAD = (10.0, 25.0, 45.0)  # m at which the bend of the lane is told
LANE_REACH = 2.5  # m
UNKNOWN = float("nan")


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one gap: those at its start, and the leader's, which go on during it.

    origin    (2,) m, world;  velocity (2,) m/s;  yaw of the axis along, rad
    known     (F,) features at the start
    leader    row of the leader, or None
    """

    labelled: LabelledScene
    gap: Gap
    origin: FloatArray
    velocity: FloatArray
    yaw: float
    known: FloatArray
    leader: int | None
    route: Route

    @classmethod
    def of(cls, labelled: LabelledScene, gap: Gap) -> Self | None:
        """None for an object with too few detections before the gap."""
        time, place, yaws = _detections(labelled, gap)
        recent = time >= -RECENT
        if recent.sum() < 3:
            return None
        line = np.polynomial.polynomial.polyfit(time[recent], place[recent], 1)
        curve = np.polynomial.polynomial.polyfit(time, place, 2) if len(time) > 4 else np.vstack([line, [0.0, 0.0]])
        velocity = line[1]
        speed = float(np.hypot(*velocity))
        yaw = float(np.arctan2(velocity[1], velocity[0]))
        if speed < LEAST_SPEED and np.isfinite(yaws).any():
            known = yaws[np.isfinite(yaws)]
            yaw = float(np.arctan2(np.sin(known).mean(), np.cos(known).mean()))
        along, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        acceleration = 2 * curve[2]
        turn = float(acceleration @ left) / max(speed, LEAST_SPEED)
        seen_turn = _turn_rate(time, yaws)
        rate = seen_turn if np.isfinite(seen_turn) else turn
        route = _arc(line[0], yaw, float(np.clip(rate / max(speed, LEAST_SPEED), -TIGHTEST, TIGHTEST)))
        leader = leader_on(labelled, gap.row, gap.start, route)
        own = [speed, *(float(vector @ axis) for vector in (curve[1], acceleration) for axis in (along, left))]
        own += [turn, seen_turn, float(np.hypot(*(place[-1] - place[0]))), float(labelled.label[gap.row] in ROAD_USERS)]
        known_now = np.array([*own, *_ahead(labelled, gap, leader, route), *_lane(labelled, gap, line[0], yaw)])
        return cls(labelled, gap, line[0], velocity, yaw, known_now, leader, route)

    def until(self, moment: int) -> FloatArray:
        """(F + 4,) with what is seen until a moment of the gap: the leader's way, the light of the line ahead."""
        time, start = self.labelled.scene.timestamps, self.gap.start
        half = start + int(np.argmin(np.abs(time[start:moment] - (time[start] + time[moment]) / 2)))
        seen = [self._led(half), self._led(moment)]
        road, closed = lights_at(self.labelled, float(time[moment]))
        line = first_line(road, self.route)
        at_end = UNKNOWN if line is None else float(line[1].light in closed)
        return np.array([*self.known, *seen, at_end, float(time[moment] - time[start])])

    def offset(self, place: FloatArray, moment: int) -> FloatArray:
        """(2,) along and across, m, from where constant velocity gets by a moment to a place."""
        away = place - self.origin - self._elapsed(moment) * self.velocity
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * away[0] + s * away[1], c * away[1] - s * away[0]])

    def place(self, offset: FloatArray, moment: int) -> FloatArray:
        """The place (2,) at an offset."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        away = np.array([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]])
        return np.asarray(self.origin + self._elapsed(moment) * self.velocity + away)

    def _elapsed(self, moment: int) -> float:
        return float(self.labelled.scene.timestamps[moment] - self.labelled.scene.timestamps[self.gap.start])

    def _led(self, moment: int) -> float:
        """m that the leader has travelled by its last detection until a moment, at its mean speed until that."""
        if self.leader is None:
            return UNKNOWN
        seen = np.flatnonzero(self.labelled.detected[self.gap.start + 1 : moment + 1, self.leader])
        if len(seen) == 0:
            return UNKNOWN
        last = self.gap.start + 1 + int(seen[-1])
        way = self.labelled.position[last, self.leader] - self.labelled.position[self.gap.start, self.leader]
        return float(np.hypot(*way)) * self._elapsed(moment) / self._elapsed(last)


def _detections(labelled: LabelledScene, gap: Gap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times before the start (n,), s, places (n, 2) and yaws (n,) of the object's detections."""
    begin = float(labelled.scene.timestamps[gap.start])
    time, place, yaw = [], [], []
    for frame, owner, boxes in zip(labelled.scene.frames, labelled.owner, labelled.boxes, strict=True):
        if begin - FOLLOWED - 1e-6 <= frame.timestamp <= begin + 1e-6:
            for k in np.flatnonzero(owner == gap.row)[:1].tolist():
                time.append(frame.timestamp - begin)
                place.append(boxes.position[k, :2])
                yaw.append(boxes.yaw[k])
    return np.array(time), np.array(place).reshape(-1, 2), np.array(yaw)


def _turn_rate(time: FloatArray, yaw: FloatArray) -> float:
    """rad/s, of the headings that are known; NaN of fewer than five."""
    known = np.isfinite(yaw)
    if known.sum() < 5:
        return UNKNOWN
    return float(np.polynomial.polynomial.polyfit(time[known], np.unwrap(yaw[known]), 1)[1])


def _arc(origin: FloatArray, yaw: float, curvature: float) -> Route:
    """`ONWARD` m of an arc."""
    way = np.arange(0.0, ONWARD + 1.0, 4.0)
    heading = yaw + curvature * way
    step = np.diff(way)[:, None] * np.column_stack([np.cos(heading[1:]), np.sin(heading[1:])])
    return Route.through(np.vstack([origin, origin + np.cumsum(step, axis=0)]))


def _ahead(labelled: LabelledScene, gap: Gap, leader: int | None, route: Route) -> list[float]:
    """Gap to the leader, its speed and change of speed; way to the next stop line, and whether that is closed."""
    found = [UNKNOWN] * 3
    if leader is not None:
        way, _, _ = route.project(labelled.position[gap.start, leader][None])
        speed = np.hypot(*labelled.velocity[max(gap.start - 5, 0) : gap.start + 1, leader].T)
        found = [float(way[0]), float(speed[-1]), float(speed[-1] - speed[0])]
    road, closed = lights_at(labelled, float(labelled.scene.timestamps[gap.start]))
    line = first_line(road, route)
    return [*found, *((UNKNOWN, UNKNOWN) if line is None else (line[0], float(line[1].light in closed)))]


def _lane(labelled: LabelledScene, gap: Gap, origin: FloatArray, yaw: float) -> list[float]:
    """Direction of the lane at some distances ahead against the heading, and how far its middle is to the right."""
    road, _ = lights_at(labelled, float(labelled.scene.timestamps[gap.start]))
    best: tuple[float, list[float]] | None = None
    for lane in road.lanes if road is not None else ():
        centre = Route.through(np.array(lane.centre))
        way, aside, direction = (float(each[0]) for each in centre.project(origin[None]))
        on_it = abs(aside) <= LANE_REACH and way <= centre.way[-1] and np.cos(direction - yaw) > 0.8
        if on_it and (best is None or abs(aside) < best[0]):
            at = np.searchsorted(centre.way, way + np.array(AHEAD)) - 1
            bend = wrap_angle(centre.direction[np.clip(at, 0, len(centre.direction) - 1)] - yaw)
            best = abs(aside), [*np.where(way + np.array(AHEAD) < centre.way[-1], bend, UNKNOWN).tolist(), aside]
    return [UNKNOWN] * (len(AHEAD) + 1) if best is None else best[1]
