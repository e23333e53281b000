"""Runs of trackers through gaps of recordings, real and made, judged by identity and place.

A real gap lasts from the last moment at which a labelled object has a detection to the next one. Made gaps and errors
are those of `pipelines.learning.interactions`.

kept   the track that holds the object `SETTLING` s after the gap is the one that held it before
error  distance of that track, while it is not detected, to the label, m; `CAP` where it is not known or farther away
link   a track that is detected again after `SHORTEST` s or more; it is right if it holds the object it held before,
       false if it holds another, unknown if it holds none before or after

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
    waiting            a vehicle whose way meets that of another one, which comes there first and in the gap; this one
                       is slower than `SLOW` meanwhile
    going              a vehicle that comes there first and in the gap; the other one comes within `AFTER` s
    merging            both come there within `AFTER` s, the first of them in the gap, and go on in one direction
    for people         a vehicle that waits so for a person
    people crossing    a person whose way meets that of a vehicle within `AFTER` s, the first of them in the gap

The route is where the labels say that the object goes after the start, and straight on from the last of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Literal, NamedTuple, Protocol

import numpy as np

from data_tools.metrics import nees
from pipelines.learning.interactions import CAP, DETECTED, Contender, Errors, JudgedRun, classes_of, tracks_without
from pipelines.tracking import Progress
from saga_fg.learning.interaction_fit import ROAD_USERS
from saga_fg.learning.labelled_scene import LENGTHS, LONGEST, MOVING, Gap, LabelledScene, is_moving, made_gaps, reached
from saga_fg.model import Sensor
from saga_fg.numerics import FloatArray, feet, wrap_angle
from saga_fg.types import Boxes, Lane, LanesAcross, RoadMap, Scene, StopLine, Tracks

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
        if abs(self.own - self.other) <= AFTER and any(self.walks):
            if self.walks[0]:
                yield "people crossing"
        elif abs(self.own - self.other) <= AFTER:
            if self.own <= self.other:
                yield "going"
            if self.alike:
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


SHORTEST = 1.0  # s: real gaps
SEEN_BEFORE = 0.39  # s from the first to the last detection before a real gap: half a second of frames at 10 Hz
Life = Literal["kept", "shipped"]
LIVES: tuple[Life, ...] = ("kept", "shipped")


def real_gaps(labelled: LabelledScene) -> list[Gap]:
    """All gaps of `SHORTEST` to `LONGEST` s after which the object is detected again."""
    time, found = labelled.scene.timestamps, []
    for row in range(len(labelled.id)):
        seen = np.flatnonzero(labelled.detected[:, row])
        begins = np.flatnonzero(np.diff(seen) > 1)
        spell = 0.0 if len(seen) == 0 else float(time[seen[0]])
        for last, first in zip(seen[begins].tolist(), seen[begins + 1].tolist(), strict=True):
            length = float(time[first] - time[last])
            if length < SHORTEST - 1e-6:
                continue
            if length <= LONGEST + 1e-6 and time[last] - spell >= SEEN_BEFORE:
                found.append(Gap(row, last, first, length, is_moving(labelled, row, last, first)))
            spell = float(time[first])
    return found


@dataclass(frozen=True)
class Prediction:
    """A track without detections against the label of its object.

    error   m, however large;  nees: its square by the covariance of the position, chi-squared with 2 degrees of freedom
    nll     negative logarithm of the density of the true position, nats;  NaN, as nees, without a covariance
    """

    error: float
    nees: float
    nll: float


@dataclass(frozen=True)
class Judgement:
    """The outcome of a gap of an object.

    at          error at the end of each length that the gap reaches, m
    predicted   where the track that had the object is then, if it is among the results
    held, kept  whether a track had the object before, and whether that track has it after
    reported    whether that track is among the results at the last moment of the gap
    error       mean over the gap, m
    """

    at: Errors
    predicted: Mapping[float, Prediction]
    held: bool
    kept: bool
    reported: bool
    error: float


@dataclass(frozen=True)
class Links:
    """Tracks that were detected again after a gap, by whom they hold."""

    right: int = 0
    false: int = 0
    unknown: int = 0


@dataclass(frozen=True)
class LivedRun:
    """A contender's outcomes in the gaps of one recording; its tracks are kept alive, or end as configured.

    cluster     the first of the recordings that overlap with this one, or itself
    situations  of the object of each gap, by the length until which; none for real gaps
    links       of the run with all detections, if that was
    """

    recording: str
    cluster: str
    contender: str
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    situations: tuple[Mapping[float, frozenset[str]], ...]
    outcomes: tuple[Judgement, ...]
    life: Life
    links: Links | None


class ExtrapolatedRun(JudgedRun):
    """A run in which a track that is not reported is taken to move on as it was last reported."""

    def position(self, track: int, moment: int) -> FloatArray | None:
        """The place (2,) of a track, None before it was reported."""
        for k in range(moment, -1, -1):
            row, found = self.row_of[k].get(track), self.tracks[k]
            if row is not None:
                elapsed = float(self.tracks[moment].timestamp - found.timestamp)
                return np.asarray(found.boxes.position[row, :2] + elapsed * found.boxes.velocity[row])
        return None


CURVE = "curve"
"""Contender: the tracks of `kf`, hidden ones by `CurveRun`."""
FITTED, FADING, LATERAL = 1.0, 4.0, 4.0  # s; s; m/s^2


class CurveRun(JudgedRun):
    """A run whose tracks go on in a curve while they are hidden, independent of the engine.

    By a line through the velocities v that were reported in the last `FITTED` s in view, each track has an acceleration
    a along its course and a curvature k, which lasts. The acceleration fades (Singer, IEEE Trans. AES 6, 1970):

        dv/dt = a exp(-t / FADING),  v >= 0,      d course / ds = k

    Covariances stay those of the tracker.
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks]) -> None:
        past: dict[int, list[tuple[float, FloatArray, FloatArray]]] = {}
        curved = []
        for found in tracks:
            position = found.boxes.position.copy()
            for row, node in enumerate(found.id.tolist()):
                own, hidden = past.setdefault(node, []), found.coasting[row] > DETECTED
                if not hidden:
                    own.append((found.timestamp, position[row, :2].copy(), found.boxes.velocity[row]))
                elif own:
                    position[row, :2] = self._onward(own, found.timestamp)
            curved.append(replace(found, boxes=replace(found.boxes, position=position)))
        super().__init__(labelled, curved)

    @staticmethod
    def _onward(own: list[tuple[float, FloatArray, FloatArray]], until: float) -> FloatArray:
        """The place (2,) at a time, by times, places and velocities in view."""
        time, place, velocity = own[-1]
        near = [one for one in own if one[0] >= time - FITTED]
        v = float(np.hypot(*velocity))
        ahead = velocity / max(v, 1e-6)
        at, known = np.array([one[0] for one in near]) - time, np.array([one[2] for one in near])
        spread = ((at - at.mean()) ** 2).sum()
        pull = (at - at.mean()) @ known / spread if spread > 0 else np.zeros(2)
        a, across = float(pull @ ahead), float(np.clip(pull @ [-ahead[1], ahead[0]], -LATERAL, LATERAL))
        curvature = across / v**2 if v > UNDER_WAY else 0.0
        t = np.linspace(0.0, until - time, max(2, round(10 * (until - time)) + 1))
        speed = np.maximum(v + a * FADING * (1 - np.exp(-t / FADING)), 0.0)
        speed[np.minimum.accumulate(speed) == 0] = 0.0
        step = (speed[1:] + speed[:-1]) / 2 * np.diff(t)
        course = np.arctan2(velocity[1], velocity[0]) + curvature * (np.cumsum(step) - step / 2)
        return np.asarray(place + (step[:, None] * np.column_stack([np.cos(course), np.sin(course)])).sum(axis=0))


HINDSIGHT = "edges by hindsight"
"""Contender: of `saga` and `trails alone` the one with the lower error in each gap, the limit of choosing edges."""


def by_hindsight(runs: Sequence[LivedRun]) -> list[LivedRun]:
    """Runs of `HINDSIGHT` where there are both."""
    alone = {(run.recording, run.life): run for run in runs if run.contender == "trails alone"}
    pairs = [
        (run, alone[key]) for run in runs if run.contender == "saga" and (key := (run.recording, run.life)) in alone
    ]
    return [
        replace(mine, contender=HINDSIGHT, outcomes=tuple(map(_better, mine.outcomes, other.outcomes)))
        for mine, other in pairs
    ]


def _better(one: Judgement, other: Judgement) -> Judgement:
    """The lower error of two, at the end of each length and over the gap."""
    whole, other = (other, one) if other.error < one.error else (one, other)
    at, predicted = dict(other.at), dict(other.predicted)
    at |= {h: error for h, error in whole.at.items() if error <= at.get(h, np.inf)}
    mine = {h: found for h, found in whole.predicted.items() if h not in predicted or found.error < predicted[h].error}
    return replace(whole, at=at, predicted=predicted | mine)


def judgement(run: JudgedRun, gap: Gap) -> Judgement:
    """Judge one gap."""
    holder, at = run.holder(gap), run.outcome(gap)
    if holder is None:
        return Judgement(at, {}, False, False, False, CAP)
    ends = reached(run.labelled.scene.timestamps, gap)
    predicted = {h: found for h, k in ends.items() if (found := prediction(run, holder, gap.row, k)) is not None}
    after = run.last(run.track_of, str(run.labelled.id[gap.row]), gap.stop, back=False)
    errors = np.array([run.error(holder, gap.row, k) for k in range(gap.start + 1, gap.stop)])
    known = errors[np.isfinite(errors)]
    mean = float(known.mean()) if len(known) else float("nan")
    reported = holder in run.row_of[gap.stop - 1]
    return Judgement(at, predicted, True, after == holder, reported, mean)


def prediction(run: JudgedRun, track: int, row: int, moment: int) -> Prediction | None:
    """The track at a moment, None where it is not among the results or the object is not labelled."""
    truth, at = run.labelled.position[moment, row], run.row_of[moment].get(track)
    if at is None or not np.isfinite(truth[0]):
        return None
    error = run.tracks[moment].boxes.position[at, :2] - truth
    covariance = run.tracks[moment].position_covariance[at]
    squared = float(nees(error[None], covariance[None])[0])
    nll = (squared + np.linalg.slogdet(2 * np.pi * covariance)[1]) / 2 if np.isfinite(squared) else np.nan
    return Prediction(float(np.hypot(*error)), squared, float(nll))


def links(run: JudgedRun) -> Links:
    """Judge all tracks that were detected again."""
    time = run.labelled.scene.timestamps
    object_of = [{track: name for name, track in found.items()} for found in run.track_of]
    latest: dict[int, int] = {}
    right = false = unknown = 0
    for k, detected in enumerate(run.detected):
        for track in set(detected.id.tolist()):
            since = latest.get(track)
            latest[track] = k
            if since is None or not SHORTEST - 1e-6 <= time[k] - time[since] <= LONGEST + 1e-6:
                continue
            before = run.last(object_of, track, since, back=True)
            after = run.last(object_of, track, k, back=False)
            if before is None or after is None:
                unknown += 1
            elif before == after:
                right += 1
            else:
                false += 1
    return Links(right, false, unknown)


class SceneSource(Protocol):
    """Recordings by name, with ground truth and detections; clusters: the first of the recordings that overlap in time
    with each, by name, empty where none can."""

    @property
    def name(self) -> str: ...
    @property
    def clusters(self) -> Mapping[str, str]: ...
    def scene(self, recording: str) -> Scene: ...


@dataclass(frozen=True)
class GapBenchSettings:
    """Passes over each recording with made gaps, the lives compared, lengths of made gaps, s.

    real  whether the gaps of the recordings themselves are judged too, and the links
    of    situations, one of which objects are in at the end of made gaps; none: any
    """

    passes: int = 2
    lives: tuple[Life, ...] = LIVES
    lengths: tuple[float, ...] = LENGTHS
    real: bool = True
    of: tuple[str, ...] = ()


def bench_gaps(
    source: SceneSource,
    recordings: Sequence[str],
    contenders: Sequence[Contender],
    settings: GapBenchSettings,
    progress: Progress | None = None,
) -> list[LivedRun]:
    """All runs on some recordings of a set, of contenders that have the same sensors."""
    runs = list[LivedRun]()
    for name in recordings:
        labelled, gaps = prepared(source, name, settings, contenders[0].config.sensors)
        for contender, life in product(contenders, settings.lives):
            runs.append(run_of(labelled, gaps, contender, life, settings.real, source.clusters.get(name, name)))
            if progress is not None:
                each = len(contenders) * len(settings.lives)
                progress(f"{source.name} {name} {contender.name}", len(runs), len(recordings) * each)
    return runs


def prepared(
    source: SceneSource, recording: str, settings: GapBenchSettings, sensors: Mapping[str, Sensor]
) -> tuple[LabelledScene, list[Gap]]:
    """A recording and its gaps."""
    labelled = LabelledScene.from_scene(source.scene(recording), sensors)
    real = real_gaps(labelled) if settings.real else []

    def wanted(gap: Gap) -> bool:
        return not situations_of(labelled, gap).get(gap.length, frozenset()).isdisjoint(settings.of)

    chosen = wanted if settings.of else None
    return labelled, [*real, *made_gaps(labelled, settings.passes, 0, settings.lengths, chosen)]


def run_of(
    labelled: LabelledScene,
    gaps: Sequence[Gap],
    contender: Contender,
    life: Life,
    real: bool = True,
    cluster: str | None = None,
) -> LivedRun:
    """Track without the detections of each pass, and before, for `real` gaps and links, with all; judge."""
    outcomes: dict[int, Judgement] = {}
    found = Links() if real else None
    for number in sorted({*([0] if real else []), *(gap.run for gap in gaps)}):
        mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
        judged = judged_run(labelled, list(mine.values()), contender, life)
        outcomes |= {k: judgement(judged, gap) for k, gap in mine.items()}
        if number == 0:
            found = links(judged)
    name, ordered = labelled.scene.name, tuple(outcomes[k] for k in range(len(gaps)))
    situations = tuple(situations_of(labelled, gap) if gap.run > 0 else {} for gap in gaps)
    classes = classes_of(labelled, gaps)
    return LivedRun(name, cluster or name, contender.name, tuple(gaps), classes, situations, ordered, life, found)


def judged_run(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender, life: Life) -> JudgedRun:
    """Track without the detections of the made ones among the gaps of one run."""
    made, lived = [gap for gap in gaps if gap.run > 0], contender.kept_alive() if life == "kept" else contender
    kind = ExtrapolatedRun if contender.method == "centerpoint" else JudgedRun
    kind = CurveRun if contender.name == CURVE else kind
    return kind(labelled, tracks_without(labelled, made, lived))
