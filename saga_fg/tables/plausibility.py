"""Checks of detections and settings by their values: sizes, scores, times, names of classes; and what they show.

Checks return a `Finding` or None. Thresholds are such that the recordings of the tests raise none.
"""

import re
from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches

import numpy as np

from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types import FILL_IN, VEHICLES, Boxes, Finding, Frame, Mend

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
FRAME_COUNTS = {"frame", "frames", "step", "timestep", "tick", "sweep"}  # an index may be that of the row


def repeated_rows(frame: IntArray, boxes: Boxes, score: FloatArray) -> Finding | None:
    """Detections of frames (n,) that are given twice: of one place, size, class and score."""
    values = np.column_stack([frame, boxes.position, boxes.size, boxes.yaw, boxes.velocity, score])
    _, label = np.unique(boxes.label, return_inverse=True)
    again = len(values) - len(np.unique(np.column_stack([np.nan_to_num(values, nan=-1.0), label]), axis=0))
    if again < FEWEST or again < 0.05 * len(values):
        return None
    what = f"{again} of the first {len(values)} detections are repeated, with the same place, size, class and score"
    return Finding("repeated", what, "expected each once: two make one object more certain")


def scores_beyond_one(score: FloatArray) -> Finding | None:
    """Scores (n,), which should be shares, beyond 0 to 1: percent where none is negative, else logits."""
    beyond = share((score < -1e-6) | (score > 1 + 1e-6))
    if len(score) < FEWEST or beyond < 0.01:
        return None
    low, high = float(score.min()), float(score.max())
    what = f"scores are not from 0 to 1: {beyond:.0%} of them are outside, from {low:.3g} to {high:.3g}; "
    if low >= 0 and 5 < high <= 100.5:
        return Finding("scores", what + "they look like percent", "expected 0 to 1", Mend(units={"score": "percent"}))
    declared = 'put `sensors: {default: {score: logit}}` into a file for --config, or take Sensor(score="logit")'
    return Finding("scores", what + "they look like logits", declared)


def length_below_width(label: StrArray, size: FloatArray) -> Finding | None:
    """Boxes of vehicles, sizes (n, 3), that are mostly wider than long; barriers are, and pedestrians."""
    usual = {name: usual_class(name) for name in np.unique(label).tolist()}
    least = {None: 3.5, "barrier": np.inf, "pedestrian": np.inf, "bicycle": 1.2, "motorcycle": 1.2}
    longest = np.array([least.get(usual[name], 2.5) for name in label.tolist()])
    large = np.isfinite(size[:, :2]).all(axis=1) & (size[:, :2].max(axis=1, initial=-np.inf) >= longest)
    wide = size[large, 0] < 0.8 * size[large, 1]
    if large.sum() < FEWEST or share(wide) < 0.7:
        return None
    what = f"{share(wide):.0%} of the vehicles' boxes are wider than long: length and width look exchanged"
    exchanged = Mend(columns={"length": "width", "width": "length"})
    return Finding("sides", what, "expected the length along the heading", exchanged)


_USUAL_LENGTH = {"pedestrian": 0.7, "bicycle": 1.8, "motorcycle": 2.2, "car": 4.5, "bus": 11.0, "truck": 8.0}  # m


def unlikely_sizes(label: StrArray, size: FloatArray) -> Finding | None:
    """Lengths (of sizes (n, 3)) that no object of its class has: other units than metres."""
    names, of_row = np.unique(label, return_inverse=True)
    usual = np.array([_USUAL_LENGTH.get(usual_class(name) or "", np.nan) for name in names.tolist()])
    length, width = size[:, 0], size[:, 1]
    ratio = (length / usual[of_row])[np.isfinite(length) & np.isfinite(usual[of_row])]
    if len(ratio) < FEWEST:
        return None
    middle = float(np.median(ratio))
    unit = "mm" if middle > 250 else "cm" if middle > 25 else "km" if middle < 0.01 else ""
    cars = np.isfinite(size[:, :2]).all(axis=1) & (usual[of_row] == _USUAL_LENGTH["car"])
    if not unit and cars.sum() >= FEWEST:
        unit = "ft" if 11 < np.median(length[cars]) < 25 and 4 < np.median(width[cars]) < 10 else ""
    if not unit:
        return None
    what = f"objects are usually {middle:.3g} times as long as others of their class: this looks like {unit}"
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
        degrees = "degrees of latitude and longitude, where metres in a plane such as that of UTM are expected"
        return Finding("places", what + degrees, "", Mend(columns={"x": FILL_IN, "y": FILL_IN}))
    return Finding("places", what + "km", "expected metres", Mend(units={"length": "km"}))


def far_too_fast(label: StrArray, velocity: FloatArray) -> Finding | None:
    """Measured velocities (n, 2), of which many are beyond what the class can do."""
    names, of_row = np.unique(label, return_inverse=True)
    usual = [usual_class(name) for name in names.tolist()]
    limits = [_FASTEST.get(name or "", _FASTEST_VEHICLE if name else _FASTEST_OTHER) for name in usual]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    for k, name in enumerate(names.tolist()):
        mine = speed[(of_row == k) & np.isfinite(speed)]
        beyond = share(mine > limits[k])
        if len(mine) >= FEWEST and beyond > 0.05:
            what = f"{beyond:.0%} of the velocities of {name} are above {limits[k]:g} m/s, up to {mine.max():.3g}"
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
    if not words & {*FRAME_COUNTS, "index", "idx"} or len(known) < 3 or (known % 1).any():
        return None
    what = f"times are whole numbers of the column {column[:40]!r}: they look like frames, such as 10 a second"
    return Finding("frames", what, "expected seconds", Mend(units={"time": "10Hz"}))


def seconds_taken_for_frames(count: FloatArray) -> Finding | None:
    """Times (n,) read as counts of frames, which are no whole numbers."""
    if share(count % 1 > 0) < 0.5:
        return None
    what = "times are read as counts of frames and are no whole numbers: they look like seconds"
    return Finding("frames", what, "expected counts of frames", Mend(units={"time": "s"}))


def days_taken_for_times(time: FloatArray) -> Finding | None:
    """Times (n,), s, of dates, all of which are of midnight."""
    known = time[np.isfinite(time)]
    if len(known) < 2 or (known % 86_400).any():
        return None
    what = "dates have no time of day: all rows of a day are one frame"
    return Finding("days", what, "expected a date and time for each frame")


def share(mask: BoolArray) -> float:
    """Share of a mask that is set, 0 of an empty one."""
    return float(np.mean(mask)) if len(mask) else 0.0


TRAFFIC, LONGEST_STEP = 5, 0.6  # vehicles at a time; s between frames: leaders and trails matter from here on
STANDING = 1.0  # m, within which a sensor stays that stands


def seems_dense_traffic(frames: Sequence[Frame]) -> str:
    """Why the frames of a recording, its first seconds perhaps, show dense road traffic; "" if they do not.

    They do with five vehicles at a time, each with a heading, at 2 Hz or more, by a sensor that stays where it is.
    """
    detections = [frame.detections.boxes for frame in frames if len(frame.detections)]
    poses = np.array([frame.world_T_ego[:2, 3] for frame in frames if frame.world_T_ego is not None]).reshape(-1, 2)
    if not detections or any(frame.coordinates != "world" and frame.world_T_ego is None for frame in frames):
        return ""
    vehicles = [np.isin(boxes.label, VEHICLES) for boxes in detections]
    headed = [np.isfinite(boxes.yaw[of]) for boxes, of in zip(detections, vehicles, strict=True)]
    count, times = float(np.median([of.sum() for of in vehicles])), np.unique([frame.timestamp for frame in frames])
    step = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    stands = len(poses) == 0 or bool((np.ptp(poses, axis=0) <= STANDING).all())
    if not stands or count < TRAFFIC or step > LONGEST_STEP:
        return ""
    if np.concatenate(vehicles).mean() <= 0.5 or np.concatenate(headed).mean() < 0.9:
        return ""
    seen = "from a sensor that stands or hovers" if len(poses) else "and no pose of a vehicle that moves"
    return f"{count:.0f} vehicles at a time with headings, {1 / step:.3g} Hz, {seen}"
