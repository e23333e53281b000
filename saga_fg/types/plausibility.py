"""Suspicions about data and settings: units, coordinates, classes, times, and what mends them.

Checks of detections, one function for each suspicion, over the arrays of a sample.

Each returns a `Finding` or None. Shares and numbers are such that recordings which come with tests raise none.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import pairwise
from typing import Literal, Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import transform_points, wrap_angle
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame

__all__ = [
    "FILL_IN",
    "Finding",
    "Mend",
    "Sample",
    "days_taken_for_times",
    "ego_taken_for_world",
    "far_too_fast",
    "findings_of",
    "frames_taken_for_seconds",
    "headings_against_motion",
    "headings_in_degrees",
    "headings_of_frames",
    "idle_lanes",
    "idle_rules",
    "known_velocities",
    "length_below_width",
    "scores_beyond_one",
    "settings_without_data",
    "strange_time_steps",
    "unlikely_sizes",
    "usual_class",
    "usual_classes",
    "velocities_between_frames",
    "within_a_metre",
]

FILL_IN = "..."
"""Stands for a name that only the owner of the data knows."""


@dataclass(frozen=True)
class Mend:
    """Entries of a `TableImport` that mend a suspicion.

    columns      by our name: the column, by our name for it as it is read now, that it should be read from
    classes      by the name as it is read now; `FILL_IN` where it is not known
    units        by kind
    coordinates  of rows that say none, "" to leave them
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    classes: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    coordinates: Literal["", "ego"] = ""


@dataclass(frozen=True)
class Finding:
    """One suspicion.

    kind      names it; each is told once
    what      what is seen, and what it looks like
    expected  what should be given instead
    mend      what mends it where a table is read; None for none
    """

    kind: str
    what: str
    expected: str
    mend: Mend | None = None

    def text(self, option: str = "") -> str:
        """One line, with the `option` of the command that mends it; "" where it has none."""
        if not option:
            return f"{self.what}; {self.expected}"
        return f"{self.what}; {'fill in and add' if FILL_IN in option else 'add'} {option}"


_WORDS = {
    "pedestrian": "pedestrian pedestrians person people human walker adult child",
    "bicycle": "bicycle bicyclist bike cyclist cycle",
    "motorcycle": "motorcycle motorcyclist motorbike scooter moped",
    "trailer": "trailer semitrailer",
    "bus": "bus buses coach",
    "truck": "truck lorry hgv tractor",
    "car": "car cars vehicle sedan suv van taxi pickup auto automobile passenger",
    "barrier": "barrier fence wall guardrail",
}
_WORD_OF = {word: ours for ours, words in _WORDS.items() for word in words.split()}
_ORDER = tuple(_WORDS)  # a "vehicle.truck" is a truck, and a "vehicular_trailer" a trailer
_LARGE = re.compile(r"large|heavy")


def usual_class(name: str) -> str | None:
    """Our class that a name means, such as "car" for REGULAR_VEHICLE; None for a name that means none of them."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    found: set[str] = set()
    for text in (name, parted):
        found = found or {_WORD_OF[word] for word in re.findall(r"[a-z]+", text.lower()) if word in _WORD_OF}
    if "car" in found and _LARGE.search(name.lower()):
        found.add("truck")
    return next((ours for ours in _ORDER if ours in found), None)


def usual_classes(names: Iterable[str], known: Collection[str]) -> dict[str, str]:
    """For those of the names that are none of the `known` classes: the known one that they mean."""
    found = {name: usual_class(name) for name in names if name not in known}
    return {name: ours for name, ours in found.items() if ours is not None and ours in known}


def idle_rules(acting: Collection[str], classes: Collection[str]) -> Finding | None:
    """Edge rules that act on classes (`acting`), none of which the objects have."""
    if not acting or not classes or set(acting) & set(classes):
        return None
    meant = usual_classes(sorted(classes), acting) or dict.fromkeys(sorted(classes), FILL_IN)
    what = (
        f"no edges: tracker.edges act on {', '.join(sorted(acting))}, and the tracks are of "
        f"{', '.join(sorted(classes))}; objects are tracked one by one"
    )
    expected = "name the classes as the rules do, or the rules' `classes` as the data"
    return Finding("edges", what, expected, Mend(classes=meant))


def idle_lanes() -> Finding:
    """Lanes of `tracker.road_map` where neither a class nor an edge rule reads lanes."""
    what = "tracker.road_map.lanes: no class follows them (motion.course_time), and no rule of tracker.edges reads them"
    return Finding("lanes", what, "set course_time of a curvilinear motion, or add a rule such as in_lane")


def settings_without_data(where: str, set_up: Collection[str], there: Collection[str]) -> Finding | None:
    """Settings at `where` for classes or sensors (`set_up`) that the data lack, while they have others without any."""
    idle, plain = sorted(set(set_up) - set(there)), sorted(set(there) - set(set_up))
    if not idle or not plain:
        return None
    nearest = get_close_matches(idle[0].lower(), [name.lower() for name in plain], n=1, cutoff=0.6)
    hint = next((name for name in plain if name.lower() == nearest[0]), plain[0]) if nearest else plain[0]
    what = f"{where}.{idle[0]} has settings and the data have none of it; {', '.join(plain[:6])} have the default ones"
    return Finding(where, what, f"is {where}.{hint} meant?")


FEWEST = 20  # values that allow a judgement
_FASTEST = {"pedestrian": 12.0, "bicycle": 25.0}  # m/s
_FASTEST_VEHICLE, _FASTEST_OTHER = 75.0, 110.0  # m/s
_COUNTS = {"frame", "frames", "step", "timestep", "tick", "index", "idx", "sweep"}
_TRAVELLED = 3.0  # m of the vehicle, from which it shows what moves with it
_PAIRS = 20  # pairs of frames that are compared


def headings_in_degrees(yaw: FloatArray) -> Finding | None:
    """Headings (n,), as they were given, of which many are beyond a full turn of 2 pi."""
    known = np.abs(yaw[np.isfinite(yaw)])
    share = _share(known > 2 * np.pi + 0.1)
    if len(known) < FEWEST or share < 0.05:
        return None
    what = f"headings look like degrees: {share:.0%} of them are beyond 2 pi, the largest is {known.max():.4g}"
    return Finding("degrees", what, "expected rad", Mend(units={"angle": "deg"}))


_MOVES = 2.0  # m/s, from which the direction of motion tells the heading of a vehicle
_ASTRAY = 0.5  # rad between them
_CONVENTIONS = {"clockwise": ("clockwise", 0.0), "compass": ("clockwise from north", np.pi / 2)}
_UNIT_OF = {"rad": {"clockwise": "clockwise", "compass": "compass_rad"}}
_UNIT_OF["deg"] = {"clockwise": "clockwise_deg", "compass": "compass"}


def headings_against_motion(label: StrArray, yaw: FloatArray, velocity: FloatArray, unit: str) -> Finding | None:
    """Headings (n,), rad, of vehicles that move otherwise, velocities (n, 2), as in another convention.

    unit: in which they were given, rad or deg
    """
    usual = {name: usual_class(name) or name for name in np.unique(label).tolist()}
    walks = np.isin(label, [name for name, ours in usual.items() if ours in ("pedestrian", "barrier")])
    moves = (np.hypot(*velocity.T) > _MOVES) & np.isfinite(yaw) & ~walks
    if moves.sum() < 2 * FEWEST or unit not in _UNIT_OF:
        return None
    direction, given = np.arctan2(velocity[moves, 1], velocity[moves, 0]), yaw[moves]
    astray = {name: _share(_apart(offset - given, direction) > _ASTRAY) for name, (_, offset) in _CONVENTIONS.items()}
    best, now = min(astray, key=lambda name: astray[name]), _share(_apart(given, direction) > _ASTRAY)
    if now < 0.15 or astray[best] > now / 3:
        return None
    what = f"headings look {_CONVENTIONS[best][0]}: {now:.0%} of those of moving vehicles differ from their motion"
    expected = f"expected counter-clockwise from x; read so, {astray[best]:.0%} differ"
    return Finding("headings", what, expected, Mend(units={"angle": _UNIT_OF[unit][best]}))


MIN_STEP = 1e-6  # s between two frames, of which a velocity can be told


def velocities_between_frames(time: FloatArray, label: StrArray, position: FloatArray) -> FloatArray:
    """Velocities (n, 2) of detections at times (n,), s, and places (n, 2) in the world; NaN where they are not clear.

    That of a detection is to the nearest of its class in the next frame, if it is the nearest of that in turn, and the
    second nearest is three times as far.
    """
    from scipy.spatial import cKDTree

    found, known = np.full(position.shape, np.nan), np.isfinite(time) & np.isfinite(position).all(axis=1)
    for name in np.unique(label).tolist():
        mine = np.flatnonzero((label == name) & known)
        moments = np.unique(time[mine])[: MAX_FRAMES + 1]
        mine = mine[time[mine] <= moments.max(initial=-np.inf)]
        frames = [mine[time[mine] == moment] for moment in moments]
        for now, later in pairwise(frames):
            distance, nearest = cKDTree(position[later]).query(position[now], k=2)
            _, back = cKDTree(position[now]).query(position[later])
            clear = (back[nearest[:, 0]] == np.arange(len(now))) & (distance[:, 1] > 3 * distance[:, 0])
            clear &= time[later[0]] - time[now[0]] > MIN_STEP
            rows, to = now[clear], later[nearest[clear, 0]]
            found[rows] = (position[to] - position[rows]) / (time[to] - time[rows])[:, None]
    return found


def known_velocities(
    velocity: FloatArray, time: FloatArray, label: StrArray, position: FloatArray, in_world: bool
) -> FloatArray:
    """Velocities (n, 2) as they were measured; where none was, `velocities_between_frames` of places in the world."""
    if in_world and not np.isfinite(velocity).any():
        return velocities_between_frames(time, label, position)
    return velocity


def headings_of_frames(frames: Sequence[Frame]) -> Finding | None:
    """`headings_against_motion` of the first frames."""
    first = [frame for frame in frames[:MAX_FRAMES] if len(frame)]
    boxes = Boxes.concatenate([frame.detections.boxes for frame in first])
    time = np.repeat([frame.timestamp for frame in first], [len(frame) for frame in first])
    in_world = all(frame.coordinates == "world" for frame in first)
    velocity = known_velocities(boxes.velocity, time, boxes.label, boxes.position[:, :2], in_world)
    return headings_against_motion(boxes.label, boxes.yaw, velocity, "rad")


def _apart(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.abs(wrap_angle(a - b))


def scores_beyond_one(score: FloatArray) -> Finding | None:
    """Scores (n,), which should be shares, beyond 0 to 1: percent where none is negative, else logits."""
    share = _share((score < -1e-6) | (score > 1 + 1e-6))
    if len(score) < FEWEST or share < 0.01:
        return None
    low, high = float(score.min()), float(score.max())
    what = f"scores are not from 0 to 1: {share:.0%} of them are outside, from {low:.3g} to {high:.3g}; "
    if low >= 0 and 5 < high <= 100.5:
        return Finding("scores", what + "they look like percent", "expected 0 to 1", Mend(units={"score": "percent"}))
    declared = 'put `sensors: {default: {score: logit}}` into a file for --config, or take Sensor(score="logit")'
    return Finding("scores", what + "they look like logits", declared)


def length_below_width(label: StrArray, size: FloatArray) -> Finding | None:
    """Large boxes, sizes (n, 3), that are mostly wider than long; barriers are."""
    large = np.isfinite(size[:, :2]).all(axis=1) & (size[:, :2].max(axis=1) >= 2.5)
    large &= ~np.isin(label, [name for name in np.unique(label).tolist() if usual_class(name) == "barrier"])
    wide = size[large, 0] < 0.8 * size[large, 1]
    if large.sum() < FEWEST or _share(wide) < 0.7:
        return None
    what = f"{_share(wide):.0%} of the large boxes are wider than long: length and width look exchanged"
    exchanged = Mend(columns={"length": "width", "width": "length"})
    return Finding("sides", what, "expected the length along the heading", exchanged)


def unlikely_sizes(label: StrArray, size: FloatArray) -> Finding | None:
    """Lengths (of sizes (n, 3)) that no object has: other units than metres."""
    length, width = size[:, 0], size[:, 1]
    known = np.isfinite(length)
    cars = known & np.isin(label, [name for name in np.unique(label).tolist() if usual_class(name) == "car"])
    if known.sum() < FEWEST:
        return None
    middle = float(np.median(length[known]))
    unit = "mm" if middle > 1000 else "cm" if middle > 80 else "km" if middle < 0.02 else ""
    if not unit and cars.sum() >= FEWEST and np.isfinite(width[cars]).any():
        feet = 11 < np.median(length[cars]) < 25 and 4 < np.nanmedian(width[cars]) < 10
        middle, unit = (float(np.median(length[cars])), "ft") if feet else (middle, "")
    if not unit:
        return None
    what = f"objects have a usual length of {middle:.3g}: this looks like {unit}"
    return Finding("lengths", what, "expected metres", Mend(units={"length": unit}))


def within_a_metre(frame: IntArray, position: FloatArray) -> Finding | None:
    """Positions (n, 3) of frames (n,) with several objects, all of them within a metre."""
    several = np.flatnonzero(np.bincount(frame, minlength=1) >= 3)
    mine = position[np.isin(frame, several), :2]
    if len(mine) < FEWEST:
        return None
    spread = float(np.ptp(mine, axis=0).max())
    if spread >= 1.0:
        return None
    what = f"all objects of all frames are within {spread:.2g} m: positions look like "
    middle = np.abs(np.median(mine, axis=0))
    if middle.max() > 5 and middle.min() <= 90 and middle.max() <= 180:
        return Finding("places", what + "degrees of latitude and longitude", "expected metres in a plane, such as UTM")
    return Finding("places", what + "km", "expected metres", Mend(units={"length": "km"}))


def far_too_fast(label: StrArray, velocity: FloatArray) -> Finding | None:
    """Measured velocities (n, 2), of which many are beyond what the class can do."""
    names, of_row = np.unique(label, return_inverse=True)
    usual = [usual_class(name) for name in names.tolist()]
    limits = [_FASTEST.get(name or "", _FASTEST_VEHICLE if name else _FASTEST_OTHER) for name in usual]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    for k, name in enumerate(names.tolist()):
        mine = speed[(of_row == k) & np.isfinite(speed)]
        share = _share(mine > limits[k])
        if len(mine) >= FEWEST and share > 0.05:
            what = f"{share:.0%} of the velocities of {name} are above {limits[k]:g} m/s, up to {mine.max():.3g}"
            return Finding("speeds", f"{what}: they look like km/h", "expected m/s", Mend(units={"speed": "km/h"}))
    return None


def strange_time_steps(time: FloatArray, sensor: StrArray) -> Finding | None:
    """Times (f,) of the frames of sensors (f,), s, which are mostly a thousand times too far apart, or too near."""
    steps = [np.diff(np.unique(time[sensor == name])) for name in np.unique(sensor).tolist()]
    step = np.concatenate([np.empty(0), *steps])
    if len(step) < 3:
        return None
    middle = float(np.median(step))
    if middle >= 20:
        unit = "ms" if middle < 2e4 else "us" if middle < 2e7 else "ns"
        what = f"frames are usually {middle:.4g} s apart: their times look like {unit}"
        return Finding("times", what, "expected seconds", Mend(units={"time": unit}))
    if middle <= 1e-4:
        what = f"frames are usually {middle:.1g} s apart: their times look like a coarser unit than seconds"
        return Finding("times", what, "expected seconds", Mend(units={"time": "s"}))
    return None


def frames_taken_for_seconds(column: str, time: FloatArray) -> Finding | None:
    """Times (n,) read as s from a column whose name is that of a count, and which are whole numbers."""
    words = set(re.findall(r"[a-z]+", column.lower()))
    known = np.unique(time[np.isfinite(time)])
    if not words & _COUNTS or len(known) < 3 or (known % 1).any():
        return None
    what = f"times are whole numbers of the column {column[:40]!r}: they look like frames, such as 10 a second"
    return Finding("frames", what, "expected seconds", Mend(units={"time": "10Hz"}))


def days_taken_for_times(time: FloatArray) -> Finding | None:
    """Times (n,), s, of dates, all of which are of midnight."""
    known = time[np.isfinite(time)]
    if len(known) < 2 or (known % 86_400).any():
        return None
    what = "dates have no time of day: all rows of a day are one frame"
    return Finding("days", what, "expected a date and time for each frame")


def ego_taken_for_world(
    frame: IntArray, position: FloatArray, world_T_ego: FloatArray, in_world: BoolArray, sensor: StrArray
) -> Finding | None:
    """Positions (n, 3) of frames (n,) that are said to be in the world, and move with the vehicle.

    Either they lie about the origin and the vehicle is far from it; or objects stay nearer to where they were if they
    are placed by the poses of the vehicle (f, 4, 4), NaN where unknown.
    """
    from scipy.spatial import cKDTree

    finding = Finding(
        "frame",
        "positions look like coordinates of the vehicle, but are taken for the world: they move with it",
        "expected world coordinates, or coordinates: ego",
        Mend(coordinates="ego"),
    )
    posed = in_world & np.isfinite(world_T_ego).all(axis=(1, 2))
    rows = np.flatnonzero(posed[frame])
    if len(rows) < FEWEST:
        return None
    ego = world_T_ego[:, :2, 3]
    from_ego = np.hypot(*(position[rows, :2] - ego[frame[rows]]).T)
    if np.median(from_ego) > 300 and np.median(np.hypot(*position[rows, :2].T)) < 150:
        return finding
    as_given, as_placed = [], []
    for name in np.unique(sensor[posed]).tolist():
        mine = np.flatnonzero(posed & (sensor == name))
        mine = mine[np.bincount(frame, minlength=len(sensor))[mine] > 0]
        for k in mine[:: max(1, len(mine) // _PAIRS)].tolist():
            later = mine[(mine > k) & (np.hypot(*(ego[mine] - ego[k]).T) >= _TRAVELLED)]
            if len(later):
                a, b = position[frame == k], position[frame == later[0]]
                placed = transform_points(world_T_ego[k], a), transform_points(world_T_ego[later[0]], b)
                as_given.append(cKDTree(b[:, :2]).query(a[:, :2])[0])
                as_placed.append(cKDTree(placed[1][:, :2]).query(placed[0][:, :2])[0])
    if sum(map(len, as_given)) < FEWEST:
        return None
    given, placed_apart = float(np.median(np.concatenate(as_given))), float(np.median(np.concatenate(as_placed)))
    return finding if given > 1.0 and placed_apart < 0.5 * given else None


def _share(mask: BoolArray) -> float:
    return float(np.mean(mask)) if len(mask) else 0.0


MAX_FRAMES = 200


@dataclass(frozen=True, eq=False)
class Sample:
    """N detections of F frames of one recording.

    time (F,) s, sensor (F,), world_T_ego (F, 4, 4) NaN where unknown, in_world (F,): whether coordinates are "world";
    frame (N,), boxes, score (N,)
    """

    time: FloatArray
    sensor: StrArray
    world_T_ego: FloatArray
    in_world: BoolArray
    frame: IntArray
    boxes: Boxes
    score: FloatArray

    @classmethod
    def from_frames(cls, frames: Sequence[Frame]) -> Self:
        """The first frames of a recording."""
        first = frames[:MAX_FRAMES]
        unknown = np.full((4, 4), np.nan)
        poses = [unknown if frame.world_T_ego is None else frame.world_T_ego for frame in first]
        return cls(
            np.array([frame.timestamp for frame in first]),
            np.array([frame.sensor for frame in first], dtype=np.str_),
            np.array(poses).reshape(-1, 4, 4),
            np.array([frame.coordinates == "world" for frame in first], dtype=np.bool_),
            np.repeat(np.arange(len(first)), [len(frame) for frame in first]),
            Boxes.concatenate([frame.detections.boxes for frame in first]),
            np.concatenate([np.empty(0), *(frame.detections.score for frame in first)]),
        )


def findings_of(sample: Sample, logits: Callable[[str], bool] = lambda sensor: False) -> list[Finding]:
    """All that is doubtful in a sample. `logits` says of which sensors the scores are declared as such."""
    boxes, label = sample.boxes, sample.boxes.label
    declared = {name: logits(name) for name in np.unique(sample.sensor).tolist()}
    shares = np.array([not declared[name] for name in sample.sensor.tolist()], dtype=np.bool_)[sample.frame]
    found = (
        strange_time_steps(sample.time, sample.sensor),
        scores_beyond_one(sample.score[shares]),
        unlikely_sizes(label, boxes.size),
        length_below_width(label, boxes.size),
        within_a_metre(sample.frame, boxes.position),
        far_too_fast(label, boxes.velocity),
        ego_taken_for_world(sample.frame, boxes.position, sample.world_T_ego, sample.in_world, sample.sensor),
    )
    return [finding for finding in found if finding is not None]
