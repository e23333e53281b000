"""Situations of hidden objects, decided by the labels alone, until each length of a gap.

    all                every object
    moving             travels faster than `MOVING` over the gap;  stationary: does not
    visible leader     a vehicle whose leader has its detections in the gap: the nearest vehicle within `LEADER_REACH`
                       ahead and `PATH_HALF_WIDTH` beside its route at the start, that travels in its direction
    free               a vehicle without a leader, seen or not
    halting            travels at `UNDER_WAY` or more at the start, and stands at the end;  starting: the reverse
    turning            moving, and its heading changes by more than `TURN`
    at red             a vehicle that comes to a stop line within `LINE_REACH`, the first on its route, whose light was
                       last reported red or amber: it is the first at the line, or behind others
    waiting            a vehicle whose way meets that of another one, which comes there first and in the gap; this one
                       is slower than `SLOW` meanwhile
    going              a vehicle that comes there first and in the gap; the other one comes within `AFTER` s
    merging            both come there within `AFTER` s, the first of them in the gap, and go on in one direction
    for people         a vehicle that waits so for a person
    people crossing    a person whose way meets that of a vehicle within `AFTER` s, the first of them in the gap

The route is where the labels say that the object goes after the start, and straight on from the last of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from saga_fg.learning.interaction_fit import ROAD_USERS
from saga_fg.learning.labelled_scene import LONGEST, MOVING, Gap, LabelledScene, reached
from saga_fg.numerics import FloatArray, feet, wrap_angle
from saga_fg.types import Boxes, Lane, LanesAcross, RoadMap, StopLine

STEP = 0.5  # m between points: shorter ones are noise
ONWARD = 80.0  # m beyond the last label


def route_of(labelled: LabelledScene, row: int, start: int) -> FloatArray | None:
    """Points (k, 2), m, world, of an object's route from a moment on; None where nothing tells a direction."""
    labels = labelled.position[start:, row]
    points = [labels[0]]
    for point in labels[np.isfinite(labels[:, 0])]:
        if np.hypot(*(point - points[-1])) >= STEP:
            points.append(point)
    if len(points) > 2:
        onward = points[-1] - points[-3]
    else:
        yaw = labelled.yaw[start, row]
        onward = np.array([np.cos(yaw), np.sin(yaw)]) if np.isfinite(yaw) else points[-1] - points[0]
    length = float(np.hypot(*onward))
    return np.array([*points, points[-1] + ONWARD / length * onward]) if length > 0 else None


SITUATIONS = (
    *("all", "moving", "stationary", "visible leader", "free", "halting", "starting", "turning", "at red"),
    *("waiting", "going", "merging", "for people", "people crossing"),
)
PEOPLE = ("pedestrian",)
UNDER_WAY = 1.0  # m/s; an object stands below `MOVING`
LEADER_REACH, PATH_HALF_WIDTH = 50.0, 1.6  # m
SEEN_SHARE = 0.8  # of the moments of the gap at which a visible leader has a detection
TURN = np.radians(20.0)
LINE_REACH = 60.0  # m
REPORT_AGE = 3.0  # s: a light shows what it was last seen to show for so long
LIGHT_REACH = 3.0  # m, from a light of the map to its report
REPORT = "traffic_light_"
CLOSED = ("red", "amber")
TOUCHING = 1.0  # m: objects this close are no leaders but errors of labels
MEETING, ALIKE = 2.0, 0.8  # m between ways that meet; cosine between courses that go on alike
SLOW, AFTER = 2.0, 4.0  # m/s; s
HORIZON = LONGEST + 2 * AFTER  # s, in which both come there


def situations_of(labelled: LabelledScene, gap: Gap) -> Mapping[float, frozenset[str]]:
    """The situations of the object until each length that the gap reaches."""
    row, start = gap.row, gap.start
    speed = np.hypot(*labelled.velocity[:, row].T)
    always = {"all", "moving" if gap.moving else "stationary"}
    leader: int | None = None
    met = meetings(labelled, row, start) if labelled.label[row] in (*ROAD_USERS, *PEOPLE) else []
    if labelled.label[row] in ROAD_USERS and (route := route_of(labelled, row, start)) is not None:
        leader = leader_on(labelled, row, start, route)
        if leader is None:
            always.add("free")
        road, closed = lights_at(labelled, float(labelled.scene.timestamps[start]))
        line = first_line(road, route)
        if line is not None and line.light in closed:
            always.add("at red")
    found = {}
    for length, end in reached(labelled.scene.timestamps, gap).items():
        mine = set(always)
        if leader is not None and labelled.detected[start + 1 : end + 1, leader].mean() >= SEEN_SHARE:
            mine.add("visible leader")
        if speed[start] >= UNDER_WAY and speed[end] < MOVING:
            mine.add("halting")
        if speed[start] < MOVING and speed[end] >= UNDER_WAY:
            mine.add("starting")
        if gap.moving and abs(wrap_angle(labelled.yaw[end, row] - labelled.yaw[start, row])) > TURN:
            mine.add("turning")
        slow = np.nanmin(speed[start : end + 1]) < SLOW
        mine |= {name for one in met for name in one.situations(length, slow)}
        found[length] = frozenset(mine)
    return found


class Meeting(NamedTuple):
    """When an object and another one first come to where their ways meet, s after the start of a gap; whether they go
    on alike from there, and which of them are people."""

    own: float
    other: float
    alike: bool
    walks: tuple[bool, bool]

    def situations(self, until: float, slow: bool) -> Iterator[str]:
        """The situations of the object until then, which was `slow` meanwhile or not."""
        if min(self.own, self.other) > until:
            return
        if self.other < self.own and slow and not self.walks[0]:
            yield "for people" if self.walks[1] else "waiting"
        if abs(self.own - self.other) > AFTER:
            return
        if self.walks[0]:
            yield "people crossing"
        if self.own <= self.other and not any(self.walks):
            yield "going"
        if self.alike and not any(self.walks):
            yield "merging"


def meetings(labelled: LabelledScene, row: int, start: int) -> list[Meeting]:
    """Where the labelled way of an object from a moment on meets those of others, neither of which is there yet."""
    time = labelled.scene.timestamps[start:] - labelled.scene.timestamps[start]
    way = labelled.position[start : start + np.searchsorted(time, HORIZON)]
    walks = np.isin(labelled.label, PEOPLE)
    met = np.isin(labelled.label, ROAD_USERS) | (walks & ~walks[row])
    others, found = met & np.isfinite(way[0, :, 0]), []
    others[row] = False
    for other in np.flatnonzero(others).tolist():
        apart = np.linalg.norm(way[:, row, None] - way[:, other], axis=-1)
        near = np.nan_to_num(apart, nan=np.inf) < MEETING
        if near.any() and not near[0].any() and not near[:, 0].any():
            own = int(near.any(axis=1).argmax())
            at = int(near[own].argmax())
            turned = labelled.yaw[start + own, row] - labelled.yaw[start + at, other]
            both = bool(walks[row]), bool(walks[other])
            found.append(Meeting(float(time[own]), float(time[at]), bool(np.cos(turned) > ALIKE), both))
    return found


def leader_on(labelled: LabelledScene, row: int, start: int, route: FloatArray) -> int | None:
    """The row of the nearest vehicle ahead of an object, None where there is none."""
    place = labelled.position[start]
    at = feet(route, np.nan_to_num(place))
    ahead = np.isfinite(place[:, 0]) & (at.s > TOUCHING) & (at.s <= LEADER_REACH) & (np.abs(at.e) <= PATH_HALF_WIDTH)
    turned = labelled.yaw[start] - np.arctan2(at.direction[:, 1], at.direction[:, 0])
    ahead &= ~(np.cos(turned) < 0.5)  # a heading that is not known is none against it
    ahead &= np.isin(labelled.label, ROAD_USERS)
    ahead[row] = False
    rows = np.flatnonzero(ahead)
    return int(rows[np.argmin(at.s[rows])]) if len(rows) else None


def first_line(road: RoadMap | None, route: FloatArray) -> StopLine | None:
    """The first stop line that a route crosses within `LINE_REACH`, in the direction of travel."""
    lines = road.stop_lines if road is not None else ()
    if not lines:
        return None
    across = LanesAcross.from_lanes([Lane("route", tuple((x, y) for x, y in route.tolist()))], lines)
    ahead = np.flatnonzero((across.s >= 0) & (across.s <= LINE_REACH))
    return lines[across.line[ahead[np.argmin(across.s[ahead])]]] if len(ahead) else None


def lights_at(labelled: LabelledScene, time: float) -> tuple[RoadMap | None, frozenset[str]]:
    """The road map at a time, and the names of its lights that were last reported closed."""
    road, shown = colours_at(labelled, time)
    return road, frozenset(name for name, colour in shown.items() if colour in CLOSED)


@lru_cache(maxsize=64)
def colours_at(labelled: LabelledScene, time: float) -> tuple[RoadMap | None, Mapping[str, str]]:
    """The road map at a time, and the colours of its lights by their names, where these were reported lately."""
    road: RoadMap | None = None
    shown: dict[str, str] = {}
    recent: list[Boxes] = []
    for frame, boxes in zip(labelled.scene.frames, labelled.boxes, strict=True):
        if frame.timestamp > time + 1e-6:
            break
        road = road if frame.road_map is None else frame.road_map
        if frame.timestamp >= time - REPORT_AGE:
            recent.append(boxes)
    if road is None or not road.lights:
        return road, {}
    lights = np.array([light.position for light in road.lights])
    for boxes in recent:
        for k in np.flatnonzero(np.char.startswith(boxes.label, REPORT)).tolist():
            away = np.hypot(*(lights - boxes.position[k, :2]).T)
            nearest = int(away.argmin())
            if away[nearest] <= LIGHT_REACH:
                shown[road.lights[nearest].name] = str(boxes.label[k]).removeprefix(REPORT)
    return road, shown
