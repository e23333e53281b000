"""Smoothed objects solved again with a person's corrections (`saga_fg.smoothing.corrections`) as factors.

Corrections are taken in the order given, each about an object as smoothed so far; those that find none wait for what
the others bring about, such as a box that moved an object to where a later correction says it is.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from saga_fg.graph import FactorProvider
from saga_fg.model import FieldOfView, Sensor
from saga_fg.numerics import BoolArray, IntArray, near_pairs
from saga_fg.smoothing.association import Evidence, EvidenceFrame, assign_free_detections, evidence_scores
from saga_fg.smoothing.batch_states import StationaryStates, stationary_states
from saga_fg.smoothing.corrections import Correction, Place, WholeObject
from saga_fg.smoothing.passes import ASSOCIATION_GATE, EXTENSION, MAX_FREE_DISTANCE, Passes, SmoothedObjects
from saga_fg.smoothing.settings import PRIOR_OPPORTUNITY_TIME, SmoothingSettings
from saga_fg.smoothing.states import Lifespans, StateTable
from saga_fg.tracking import TrackerSettings
from saga_fg.types import Boxes

PERSON = Sensor(field_of_view=FieldOfView(max_range=1e-9))  # who looks at one object misses no other
log = logging.getLogger(__name__)

REACH = 2.0  # between a place and the object that it names, m
LATE = 0.5  # between a correction and the moment that it is moved to, s
SPEED_DOUBT = 0.3  # of the way of an object in that time, as a standard deviation
AROUND = 20.0  # distance of objects whose edges count where one is solved again, m
NEW_ID = 10**7  # ids of objects that corrections bring about begin here
SIZE_WEIGHT = 25.0  # of a person's size with a deviation of 1 m, in detections from near
ROUNDS = 5


@dataclass(eq=False)
class CorrectedObjects:
    """Evidence with the boxes of a person, the objects solved with them, what was said of whole objects by id, and
    what became of each correction by its number: "" where it holds."""

    evidence: Evidence
    objects: SmoothedObjects
    whole: dict[int, WholeObject]
    outcome: dict[int, str]


def correct_objects(
    evidence: Evidence,
    objects: SmoothedObjects,
    corrections: Sequence[tuple[int, Correction]],
    settings: SmoothingSettings,
    tracker: TrackerSettings,
    providers: Sequence[FactorProvider] = (),
) -> CorrectedObjects:
    """Solve again with corrections, by their numbers; objects: as smoothed without them."""
    edits = _Edits(evidence, objects)
    result = CorrectedObjects(evidence, objects, edits.whole, edits.outcome)
    waiting = list(corrections)
    for _ in range(ROUNDS):
        late = [(number, one) for number, one in waiting if not edits.take(number, one, result.objects)]
        if len(late) == len(waiting):
            break
        waiting = late
        if edits.changed:
            result.evidence, result.objects = edits.solved(settings, tracker, providers)
    for number, one in waiting:
        edits.outcome[number] = edits.why_not(one)
    return result


def _superseded_by(later: Correction) -> str:
    return f"contradicted by {later.origin}, which comes later and counts"


def _apart_from(box: Correction, time: float, standing: Correction) -> bool:
    """True if a box at a time, s, is more than `REACH` from where the object is said to stand then."""
    away = np.hypot(box.box["x"] - standing.at.x, box.box["y"] - standing.at.y)
    return bool(standing.at.time <= time <= standing.until and away > REACH)


class _Edits:
    """Assignments of the detections without corrections, changed by these; and the boxes of a person."""

    def __init__(self, evidence: Evidence, objects: SmoothedObjects) -> None:
        self._evidence, self._objects = evidence, objects
        self._object_of, self._track_of = objects.object_of.copy(), objects.track_of.copy()
        self._boxes: dict[tuple[int, int], tuple[int, Correction]] = {}  # by object and moment: number, and the box
        self._standing: dict[int, tuple[int, Correction]] = {}  # by number: the object, and what stands
        self._said: dict[tuple[object, ...], tuple[int, object]] = {}
        self._moved: list[tuple[int, float, int]] = []  # objects that from a time on, s, are others
        self.changed: set[int] = set()
        self.whole: dict[int, WholeObject] = {}
        self.outcome: dict[int, str] = {}

    def take(self, number: int, one: Correction, now: SmoothedObjects) -> bool:
        """Take a correction of objects as smoothed now; False where there are none such yet."""
        if problem := one.too_far:
            self.outcome[number] = problem
            return True
        moment, id_ = self._moment(one.time), self._object_at(one.at, now)
        if id_ < 0 and moment >= 0 and (one.what != "exists" or one.value):
            id_ = self._revived(number, one)
        if id_ < 0 or moment < 0:
            return False
        if one.other is not None:
            other = self._object_at(one.other, now)
            if other < 0:
                return False
            if one.value and other != id_ and (apart := self._apart(id_, other)):
                self.outcome[number] = f"both are seen at the same time, {apart:.1f} m apart: they are two objects"
                return True
            self._say(("same", *sorted({id_, other})), number, one)
            if one.value and other != id_:
                self._join(id_, other)
            elif not one.value and other == id_:
                self._cut(id_, number, one, now)
        elif problem := self._elsewhere(id_, moment, number, one):
            self.outcome[number] = problem
            return True
        elif one.what == "standing":
            self._standing[number] = id_, one
            self.changed.add(id_)
        else:
            if one.what == "box":
                self._say(("box", id_, moment), number, one)
                self._boxes[id_, moment] = number, one
                self.changed.add(id_)
            if one.label and one.label not in self._evidence.boxes.label:
                log.warning("%s: class %s: taken over, no detection has it", one.origin, one.label)
            self._say(("exists" if one.what == "box" else one.what, id_), number, one)
            self._tell(id_, one.whole)
        self.outcome.setdefault(number, "")
        return True

    def _elsewhere(self, id_: int, moment: int, number: int, one: Correction) -> str:
        """Why one that stands, or a box of one that does, is not taken; earlier ones that contradict it go."""
        evidence = self._evidence
        if one.what == "standing":
            mine, times = self._object_of == id_, evidence.times[evidence.moment]
            mine &= (times >= one.at.time) & (times <= one.until)
            away = np.hypot(*(evidence.boxes.position[mine, :2] + evidence.origin - [one.at.x, one.at.y]).T)
            if len(away) and (apart := float(np.median(away))) > REACH:
                return f"half of its detections are {apart:.1f} m and more from there: it does not stand"
            boxes = [(k, given, evidence.times[at]) for (i, at), (k, given) in self._boxes.items() if i == id_]
            others = {k: given for k, given, time in boxes if _apart_from(given, time, one)}
        elif one.what == "box":
            stand = [(k, given) for k, (i, given) in self._standing.items() if i == id_]
            others = {k: given for k, given in stand if _apart_from(one, evidence.times[moment], given)}
        else:
            return ""
        if max(others, default=-1) > number:
            return _superseded_by(others[max(others)])
        self.outcome |= dict.fromkeys(others, _superseded_by(one))
        self._boxes = {key: each for key, each in self._boxes.items() if each[0] not in others}
        self._standing = {k: each for k, each in self._standing.items() if k not in others}
        return ""

    def why_not(self, one: Correction) -> str:
        """Why a correction was not taken."""
        for time in (one.at.time, one.time, *([] if one.other is None else [one.other.time])):
            if self._moment(time) < 0:
                return f"no moment within {LATE:g} s of {time:g} s"
        names = "no object within" if one.what != "box" else "nor a label for a new one: no object within"
        return f"{names} {REACH:g} m"

    def _say(self, about: tuple[object, ...], number: int, one: Correction) -> None:
        """Note what a correction says; an earlier one that contradicts it is superseded."""
        said = {"exists": one.whole.exists, "class": one.label, "same": one.value}.get(str(about[0]), one.box)
        before, self._said[about] = self._said.get(about), (number, said)
        if before is not None and before[1] != said:
            self.outcome[before[0]] = _superseded_by(one)

    def _tell(self, id_: int, said: WholeObject) -> None:
        self.whole[id_] = self.whole.get(id_, WholeObject()).updated(said)

    def _moment(self, time: float) -> int:
        """The nearest moment, -1 if it is too far away."""
        times = self._evidence.times
        k = int(np.argmin(np.abs(times - time)))
        return k if abs(times[k] - time) <= LATE else -1

    def _object_at(self, place: Place, now: SmoothedObjects) -> int:
        """The object whose state is nearest, those of its class first; -1 for none."""
        k = self._moment(place.time)
        if k < 0:
            return -1
        rows = now.states.at(k)
        mean, ids = now.states.mean[rows], now.states.id[rows]
        there = mean[:, :2] + self._evidence.origin + (place.time - self._evidence.times[k]) * mean[:, 2:]
        distance = np.hypot(*(there - [place.x, place.y]).T)
        label = now.lifespans.label[now.lifespans.rows_of(ids)]
        distance = np.where(distance > REACH, np.inf, distance + REACH * ((label != place.label) & (place.label != "")))
        boxes = [(id_, one.box) for (id_, moment), (_, one) in self._boxes.items() if moment == k]
        ids = np.concatenate([ids, np.array([id_ for id_, _ in boxes], dtype=np.int64)])
        given = np.array([np.hypot(box["x"] - place.x, box["y"] - place.y) for _, box in boxes])
        distance = np.append(distance, np.where(given > REACH, np.inf, given))
        if not (distance <= 2 * REACH).any():
            return -1
        found = int(ids[np.argmin(distance)])
        for id_, time, new in self._moved:
            found = new if found == id_ and place.time >= time else found
        return found

    def _revived(self, number: int, one: Correction) -> int:
        """A new object of the free detections at a place, or of a box alone; -1 for none."""
        evidence, place = self._evidence, one.at
        free = np.flatnonzero(self._object_of < 0)
        apart = np.abs(evidence.times[evidence.moment[free]] - place.time)
        away = np.hypot(*(evidence.boxes.position[free, :2] + evidence.origin - [place.x, place.y]).T)
        wrong = (evidence.boxes.label[free] != place.label) & (place.label != "")
        near = free[(apart <= LATE) & (away <= REACH) & ~wrong]
        if len(near):
            row = near[np.argmin((apart + away)[np.isin(free, near)])]
            track = int(self._track_of[row])
            mine = free[self._track_of[free] == track] if track >= 0 else np.array([row])
            id_ = track if track >= 0 else NEW_ID + number
            self._object_of[mine], self._track_of[mine] = id_, id_
        elif one.what == "box" and one.label and self._moment(place.time) >= 0:
            id_ = NEW_ID + number
        else:
            return -1
        self.changed.add(id_)
        return id_

    def _apart(self, a: int, b: int) -> float:
        """Median distance of two objects when both are detected, m; 0 where it is within their length or `REACH`."""
        boxes, moment = self._evidence.boxes, self._evidence.moment
        rows = [np.flatnonzero(self._object_of == id_) for id_ in (a, b)]
        _, first, second = np.intersect1d(moment[rows[0]], moment[rows[1]], return_indices=True)
        distance = np.linalg.norm(boxes.position[rows[0][first], :2] - boxes.position[rows[1][second], :2], axis=1)
        apart = float(np.median(distance)) if len(distance) else 0.0
        longest = np.fmax.reduce(boxes.size[np.concatenate(rows), 0], initial=REACH)
        return apart if apart > longest else 0.0

    def _join(self, a: int, b: int) -> None:
        """Make two objects one, which keeps the name of the first."""
        self._object_of[self._object_of == b] = a
        self._boxes = {(a if id_ == b else id_, k): box for (id_, k), box in self._boxes.items()}
        self._standing = {k: (a if id_ == b else id_, one) for k, (id_, one) in self._standing.items()}
        self._tell(a, self.whole.pop(b, WholeObject()))
        self._moved.append((b, -np.inf, a))
        self.changed |= {a, b}

    def _cut(self, id_: int, number: int, one: Correction, now: SmoothedObjects) -> None:
        """Cut an object at its least certain step between two times."""
        assert one.other is not None
        evidence, states = self._evidence, now.states
        begin, end = sorted((one.at.time, one.other.time))
        rows = np.flatnonzero(self._object_of == id_)
        time = evidence.times[evidence.moment[rows]]
        at = states.rows_of(evidence.moment[rows], np.full(len(rows), id_))
        gap = np.diff(time)
        moved = np.diff(evidence.boxes.position[rows, :2], axis=0)
        jump = np.hypot(*(moved - states.mean[at[:-1], 2:] * gap[:, None]).T)
        inside = (time[1:] > begin) & (time[:-1] < end)
        if not inside.any():
            self.outcome[number] = "no step between two detections lies between the two times"
            return
        last = int(np.argmax(np.where(inside, jump + gap, -1.0)))
        later = rows[last + 1 :]
        new = NEW_ID + number
        self._object_of[later], self._track_of[later] = new, new
        cut = float(time[last : last + 2].mean())
        self._say(("same", *sorted((id_, new))), number, one)
        self._moved.append((id_, cut, new))
        self._boxes = {
            (new if i == id_ and evidence.times[k] >= cut else i, k): box for (i, k), box in self._boxes.items()
        }
        self.changed |= {id_, new}

    def solved(
        self, settings: SmoothingSettings, tracker: TrackerSettings, providers: Sequence[FactorProvider]
    ) -> tuple[Evidence, SmoothedObjects]:
        """Solve the changed objects again."""
        old = self._objects
        evidence, order, owner = self._with_boxes()
        object_of, track_of = (np.concatenate([column, owner])[order] for column in (self._object_of, self._track_of))
        passes = Passes(evidence, settings, tracker, providers)
        changed = np.array(sorted(self.changed), dtype=np.int64)
        others = ~np.isin(old.lifespans.id, changed)

        def lives() -> tuple[IntArray, Lifespans]:
            mine = np.where(np.isin(object_of, changed), object_of, -1)
            return mine, self._named(evidence.lifespans(mine))

        mine, lifespans = lives()
        states = passes.alone(lifespans, mine, EXTENSION)
        free = object_of < 0
        object_of = assign_free_detections(evidence, object_of, lifespans, states, ASSOCIATION_GATE, MAX_FREE_DISTANCE)
        track_of[free & (object_of >= 0)] = -1
        if (object_of[free] >= 0).any():
            mine, lifespans = lives()
            states = passes.alone(lifespans, mine, EXTENSION)
        within = states.within(lifespans)
        found = stationary_states(within, lifespans, evidence, mine, settings.position_drift, settings.classes)
        held = self._held(within, evidence)
        score = evidence_scores(evidence, mine, lifespans, within, PRIOR_OPPORTUNITY_TIME)
        longer = passes.reaching_back(lifespans, mine, score)
        around = _around(old.states, within, others & bool(tracker.edges), old.lifespans)
        context = old.lifespans.select(around)
        everyone = _in_order(longer.append(context))
        before, kept = old.stationary, ~np.isin(old.stationary.id, changed)
        stationary = _together(replace(before, moment=before.moment[kept], id=before.id[kept]), found, held)
        final = passes.final(
            everyone,
            np.where(np.isin(object_of, everyone.id), object_of, -1),
            states.merged(old.states.within(context)),
            stationary,
        )
        final = final.select(np.isin(final.id, changed))
        rest = old.lifespans.select(others)
        states, judged = (each.select(np.isin(each.id, rest.id)) for each in (old.states, old.judged))
        return evidence, SmoothedObjects(
            lifespans=_in_order(rest.append(lifespans)),
            object_of=object_of,
            track_of=track_of,
            states=states.merged(final),
            judged=judged.merged(within),
            stationary=stationary,
            dropped=old.dropped.select(~np.isin(old.dropped.id, changed)),
            held=held,
        )

    def _named(self, lifespans: Lifespans) -> Lifespans:
        """Objects of which nothing but boxes is known have the class that was said."""
        label = lifespans.label.astype("U64")
        for row, id_ in enumerate(lifespans.id.tolist()):
            label[row] = self.whole.get(id_, WholeObject()).label or label[row]
        return replace(lifespans, label=label)

    def _held(self, states: StateTable, evidence: Evidence) -> StationaryStates:
        """The states in which objects are said to stand."""
        time = evidence.times[states.moment]
        there = np.zeros(len(states), dtype=np.bool_)
        for id_, one in self._standing.values():
            there |= (states.id == id_) & (time >= one.at.time - 1e-3) & (time <= one.until + 1e-3)
        return StationaryStates(self._objects.stationary.position_drift, states.moment[there], states.id[there])

    def _with_boxes(self) -> tuple[Evidence, IntArray, IntArray]:
        """The evidence with the boxes of a person, the order (N + M,) of its rows among those before and the boxes, and
        the objects (M,) of the boxes."""
        evidence, old = self._evidence, self._objects
        keys = sorted(self._boxes, key=lambda key: key[1])
        owner, moment = np.array(keys, dtype=np.int64).reshape(-1, 2).T
        given = [self._boxes[key][1] for key in keys]
        n, count = len(keys), len(evidence.frames)
        names = ("x", "y", "z", "yaw")
        values = np.array([[one.box.get(name, np.nan) for name in names] for one in given]).reshape(n, 4)
        deviation = np.array([list(one.deviation.values()) for one in given]).reshape(n, 4)
        known = old.states.rows_of(moment, owner)
        velocity = np.where((known >= 0)[:, None], old.states.mean[known, 2:] if len(old.states) else 0.0, 0.0)
        late = np.array([one.time for one in given]) - evidence.times[moment]
        place = values[:, :2] - evidence.origin - velocity * late[:, None]
        spread = deviation[:, 0] ** 2 + (SPEED_DOUBT * np.hypot(*velocity.T) * late) ** 2
        unknown, detected = np.isnan(values[:, 2]), evidence.boxes
        own = [np.flatnonzero(self._object_of == id_) for id_ in owner.tolist()]
        height = np.array([detected.position[rows, 2].mean() if len(rows) else 0.0 for rows in own])
        label = [
            one.label or (str(detected.label[rows[0]]) if len(rows) else "object")
            for one, rows in zip(given, own, strict=True)
        ]
        boxes = Boxes(
            np.array(label, dtype="U64"),
            np.column_stack([place, np.where(unknown, height, values[:, 2])]),
            np.array([one.size for one in given]).reshape(n, 3),
            values[:, 3],
            np.full((n, 2), np.nan),
        )
        frames = [*evidence.frames, *(EvidenceFrame(k, PERSON, np.eye(4)) for k in moment.tolist())]
        by_time = np.argsort([frame.moment for frame in frames], kind="stable")
        rank = np.empty(len(frames), dtype=np.int64)
        rank[by_time] = np.arange(len(frames))
        frame = rank[np.concatenate([evidence.frame, count + np.arange(n)])]
        order = np.argsort(frame, kind="stable")
        R = np.zeros((n, 4, 4))
        R[:, [0, 1], [0, 1]], R[:, [2, 3], [2, 3]] = spread[:, None], 1.0
        new: dict[str, Any] = {
            "probability": np.ones(n),
            "R": R,
            "with_velocity": np.zeros(n, dtype=np.bool_),
            "z_noise": np.where(unknown, 10.0, deviation[:, 1]),
            "yaw_noise": deviation[:, 2],
            "distance": np.full(n, np.nan),
            "class_likelihood": np.ones((n, len(evidence.confused))),
            "corrected": SIZE_WEIGHT / deviation[:, 3] ** 2,
        }
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(evidence, name), column])[order] for name, column in new.items()
        }
        boxes = Boxes.concatenate([evidence.boxes, boxes]).select(order)
        ordered = tuple(frames[k] for k in by_time.tolist())
        return replace(evidence, frames=ordered, frame=frame[order], boxes=boxes, **columns), order, owner


def _around(states: StateTable, mine: StateTable, others: BoolArray, lifespans: Lifespans) -> BoolArray:
    """(n,) which of the `others` (n,) come near the states of objects that are solved again."""
    near = np.zeros(len(lifespans), dtype=np.bool_)
    for k in np.unique(mine.moment).tolist() if others.any() else ():
        a, b = states.at(k), mine.at(k)
        place = mine.mean[b, :2]
        pairs, _ = near_pairs(states.mean[a, :2], place, np.full(a.stop - a.start, AROUND))
        near[lifespans.rows_of(states.id[a.start + pairs])] = True
    return near & others


def _in_order(lifespans: Lifespans) -> Lifespans:
    return lifespans.select(np.argsort(lifespans.id))


def _together(*parts: StationaryStates) -> StationaryStates:
    moment, id_ = (np.concatenate([getattr(part, name) for part in parts]) for name in ("moment", "id"))
    pairs = np.unique(np.stack([moment, id_]), axis=1)
    return replace(parts[0], moment=pairs[0], id=pairs[1])
