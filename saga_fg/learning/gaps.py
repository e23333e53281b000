"""Gaps in recordings, made by taking detections away, and the situations of objects in them.

A gap lasts from the last moment with a detection before it to the first moment with one after it. An object *moves* if
it travels faster than `MOVING` over the gap.

Situations of hidden objects, decided by the labels alone, until each length of a gap.

    all                every object
    moving             travels faster than `MOVING` over the gap;  stationary: does not
    visible leader     a vehicle whose leader has its detections in the gap: the nearest vehicle within `LEADER_REACH`
                       ahead and `PATH_HALF_WIDTH` beside its route at the start, that travels in its direction
    free               a vehicle without a leader, seen or not
    halting            travels at `UNDER_WAY` or more at the start, and stands at the end;  starting: the reverse
    turning            moving, and its heading changes by more than `TURN`
    at red             a vehicle that comes to a stop line within `LINE_REACH`, the first on its route, whose light was
                       last reported red or amber: it is the first at the line, or behind others

The route is where the labels say that the object goes after the start, and straight on from the last of them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from saga_fg.learning.interaction_fit import ROAD_USERS
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import feet, wrap_angle
from saga_fg.types.boxes import Boxes
from saga_fg.types.road_map import Lane, LanesAcross, RoadMap, StopLine

MOVING = 0.5  # m/s
LONGEST = 6.0  # s, of all gaps
LENGTHS = (1.0, 2.0, 3.0, 5.0)  # s: made gaps
FOLLOWED, FOLLOWED_SHARE = 1.5, 0.8  # s before a made gap, and the share of its moments with a detection
SPACING = 20.0  # m between objects that are hidden at the same time
STARTS = 0.5  # s between moments at which a made gap may start
TRIALS = 4000  # of a pass: windows that are tried


@dataclass(frozen=True)
class Gap:
    """One object without detections after moment `start`, its last with one, until moment `stop`.

    row       of the object in the `LabelledScene`
    length    s: of a real gap from `start` to `stop`, of a made one as wanted, from `start` to the last moment without
    run       0 for real gaps, the number of the pass for made ones
    """

    row: int
    start: int
    stop: int
    length: float
    moving: bool
    run: int = 0


def reached(time: FloatArray, gap: Gap) -> dict[float, int]:
    """The moments of a gap at which the lengths that it reaches end; time (K,) of all moments."""
    period = float(np.median(np.diff(time)))
    since = time[gap.start + 1 : gap.stop] - time[gap.start]
    found = {}
    for length in LENGTHS if len(since) else ():
        k = int(np.argmin(np.abs(since - length)))
        if abs(since[k] - length) < 0.6 * period:
            found[length] = gap.start + 1 + k
    return found


def made_gaps(
    labelled: LabelledScene,
    passes: int,
    seed: int,
    lengths: Sequence[float] = LENGTHS,
    chosen: Callable[[Gap], bool] | None = None,
) -> list[Gap]:
    """Windows in which objects can be hidden: well followed before, labelled throughout, detected at the end.

    chosen  the windows that count, all if not given

    In one pass an object may be hidden several times; objects that are hidden at the same time are `SPACING` apart.
    """
    time = labelled.scene.timestamps
    if len(time) < 3:
        return []
    rng = np.random.default_rng([seed, zlib.crc32(labelled.scene.name.encode())])
    possible = [gap for gap in windows(labelled, rng, lengths) if chosen is None or chosen(gap)]
    gaps: list[Gap] = []
    for number in range(1, passes + 1):
        order = rng.permutation(len(possible))
        order = order[np.argsort([not possible[k].moving for k in order], kind="stable")]  # these are fewer
        taken = _Taken(labelled)
        for k in order[:TRIALS].tolist():
            if taken.free(possible[k]):
                taken.add(possible[k])
                gaps.append(replace(possible[k], run=number))
    return gaps


def windows(labelled: LabelledScene, rng: np.random.Generator, lengths: Sequence[float]) -> list[Gap]:
    """All gaps that are possible, by row and every `STARTS` s; a length is chosen at random for each."""
    time, found = labelled.scene.timestamps, []
    period = float(np.median(np.diff(time)))
    known = np.isfinite(labelled.position[..., 0])
    until = {length: _ends(time, length) for length in lengths}
    before = np.searchsorted(time, time - FOLLOWED - period / 4)
    stride = max(1, round(STARTS / period))
    counts = np.concatenate([np.zeros((1, len(labelled.id)), dtype=np.int64), labelled.detected.cumsum(axis=0)])
    named = np.concatenate([np.zeros((1, len(labelled.id)), dtype=np.int64), known.cumsum(axis=0)])
    for start in range(int(rng.integers(stride)), len(time), stride):
        if time[start] - time[0] < FOLLOWED - period / 2:
            continue
        first = int(before[start])
        hits = counts[start + 1] - counts[first]
        followed = labelled.detected[start] & (hits >= FOLLOWED_SHARE * (start + 1 - first))
        possible: dict[int, list[tuple[float, int]]] = {}
        for length in lengths:
            stop = int(until[length][start]) + 1
            if stop < len(time) and abs(time[stop - 1] - time[start] - length) < 0.6 * period:
                whole = named[stop + 1] - named[start] == stop + 1 - start
                for row in np.flatnonzero(followed & whole & labelled.detected[stop]).tolist():
                    possible.setdefault(row, []).append((length, stop))
        for row, choices in possible.items():
            length, stop = choices[int(rng.integers(len(choices)))]
            found.append(Gap(row, start, stop, length, is_moving(labelled, row, start, stop)))
    return found


def _ends(time: FloatArray, length: float) -> FloatArray:
    """(K,) the moment nearest to `length` s after each."""
    after = np.clip(np.searchsorted(time, time + length), 1, len(time) - 1)
    nearer = np.abs(time[after - 1] - time - length) < np.abs(time[after] - time - length)
    return np.asarray(after - nearer)


class _Taken:
    """The windows of one pass."""

    def __init__(self, labelled: LabelledScene) -> None:
        self._labelled = labelled
        self._windows: list[tuple[int, int, int]] = []

    def add(self, gap: Gap) -> None:
        self._windows.append((gap.row, gap.start, gap.stop))

    def free(self, gap: Gap) -> bool:
        """Return True if no window of the object, or of one near it, is in the way."""
        if not self._windows:
            return True
        time, position = self._labelled.scene.timestamps, self._labelled.position
        row, start, stop = np.array(self._windows).T
        apart = np.maximum(time[start] - time[gap.stop], time[gap.start] - time[stop])
        if (apart[row == gap.row] < FOLLOWED).any():
            return False
        near: BoolArray = np.zeros(len(row), dtype=np.bool_)
        for at in (np.maximum(start, gap.start), np.minimum(stop, gap.stop)):
            at = np.clip(at, gap.start, gap.stop)
            offset = position[at, row] - position[at, gap.row]
            near |= ~(np.hypot(offset[:, 0], offset[:, 1]) >= SPACING)
        return not ((apart < FOLLOWED) & (row != gap.row) & near).any()


def is_moving(labelled: LabelledScene, row: int, start: int, stop: int) -> bool:
    a, b = labelled.position[[start, stop], row]
    elapsed = float(labelled.scene.timestamps[stop] - labelled.scene.timestamps[start])
    return bool(np.hypot(*(b - a)) > MOVING * elapsed)


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


SITUATIONS = ("all", "moving", "stationary", "visible leader", "free", "halting", "starting", "turning", "at red")
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


def situations_of(labelled: LabelledScene, gap: Gap) -> Mapping[float, frozenset[str]]:
    """The situations of the object until each length that the gap reaches."""
    row, start = gap.row, gap.start
    speed = np.hypot(*labelled.velocity[:, row].T)
    always = {"all", "moving" if gap.moving else "stationary"}
    leader: int | None = None
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
        found[length] = frozenset(mine)
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
