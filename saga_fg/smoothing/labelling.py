"""Smoothed objects to labels, and the attributes that belong to a whole object: size, score, front, identity.

A chunk of a recording has all positions of its objects, and a part of the evidence on their sizes, scores and fronts.
The parts are summed: probabilities and opportunities of the score, metres and votes of the front, and of the size the
weights of all measured values, to half a millimetre where they are many.

Every chunk stitches tracklets into objects anew, and names an object after its first tracklet there. A tracklet that
was part of an object before stays so: the object keeps the name of its tracklets. Where they have several, it is that
of the tracklet that reaches furthest towards the chunk, so that an object's name does not change across the boundary.

The labels of a whole recording, each with what is known of its object, and the objects by what a look is worth.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import Any, Protocol, get_args

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, wrap_angle
from saga_fg.smoothing.association import Evidence
from saga_fg.smoothing.boxes import (
    Headings,
    constant_sizes,
    is_reversed,
    scalar_readings,
    size_weights,
    smooth_headings,
    smooth_walks,
    weighted_medians,
)
from saga_fg.smoothing.corrections import WholeObject
from saga_fg.smoothing.doubt import LEAST_GAIN, REASONS, Review, far_off, gain_parts, object_probabilities, step_doubt
from saga_fg.smoothing.passes import SmoothedObjects
from saga_fg.smoothing.settings import OfflineClass, SmoothingSettings
from saga_fg.smoothing.states import LabelCounts, Labels, Probabilities, Source, StateTable, quality_of
from saga_fg.types import Boxes, Tracks, class_values

NEAR_CORRECTION = 1.0  # time to a corrected box up to which a label is near one, s
HEIGHT_DRIFT = 0.1  # standard deviation of a centre's height after one second, m
YAW_DRIFT = (
    0.2  # standard deviation of the change of heading in one second, rad: detections of both sides in time tell more
)


@dataclass(frozen=True, eq=False)
class LabelColumns(Columns):
    """Columns of R labels, but those of whole objects; positions (R, 3) in the world, other shapes and units as in
    `Tracks` and `Labels`."""

    id: IntArray
    label: StrArray
    position: FloatArray
    yaw: FloatArray
    yaw_variance: FloatArray
    velocity: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray
    source: StrArray

    def labels(self, time: float, size: FloatArray, score: FloatArray, probability: Probabilities) -> Labels:
        """All rows as the labels of one moment, at `time` s; of their objects size (R, 3), m, score (R,) and doubt."""
        boxes = Boxes(self.label, self.position, size, self.yaw, self.velocity)
        tracks = Tracks(time, self.id, boxes, score, self.position_covariance, self.velocity_covariance, self.coasting)
        quality = quality_of(score, tracks.position_covariance)
        return Labels(tracks, self.yaw_variance, self.source, quality, probability)


@dataclass(frozen=True, eq=False)
class LabelledStates:
    """R smoothed states, their headings, and their labels as columns.

    log_step  log P that the detections before a state and at it are of one object, 0 without one
    rival     whether a better object of another class is at the same place
    """

    states: StateTable
    headings: Headings
    columns: LabelColumns
    log_step: FloatArray
    rival: BoolArray


def label_states(
    evidence: Evidence, objects: SmoothedObjects, wanted: FloatArray, settings: SmoothingSettings
) -> LabelledStates:
    """Labels of all states of a recording; the times `wanted` (M,), s, are those that count as observed or not."""
    lifespans, states = objects.lifespans, objects.states
    owner = lifespans.rows_of(states.id)
    rows = np.flatnonzero(objects.object_of >= 0)
    at = states.rows_of(evidence.moment[rows], objects.object_of[rows])
    duration = states.elapsed(evidence.times)
    heights = scalar_readings(at, evidence.boxes.position[rows, 2], evidence.z_noise[rows] ** 2)
    z, _ = smooth_walks(states, HEIGHT_DRIFT**2 * duration, heights)
    label = lifespans.label[owner]
    (lasting,) = class_values(settings.classes, OfflineClass, label, "position_bias")
    turning = np.where(_is_stationary(objects), 1e-6, YAW_DRIFT**2 * duration)
    (moving,) = class_values(settings.classes, OfflineClass, lifespans.label, "min_heading_speed")
    mine, weight = lifespans.rows_of(objects.object_of[rows]), size_weights(evidence)[rows]
    size = constant_sizes(mine, len(lifespans), evidence.boxes.size[rows], weight)
    headings = smooth_headings(states, lifespans, evidence, rows, at, turning, moving, size)
    P = states.covariance[:, :2, :2] + lasting[:, None, None] ** 2 * np.eye(2)
    gap = _time_to_detection(states, evidence.times, objects.object_of[rows], evidence.times[evidence.moment[rows]])
    columns = LabelColumns(
        id=states.id,
        label=label,
        position=np.concatenate([states.mean[:, :2] + evidence.origin, z[:, None]], axis=1),
        yaw=headings.yaw,
        yaw_variance=headings.variance,
        velocity=states.mean[:, 2:],
        position_covariance=P,
        velocity_covariance=states.covariance[:, 2:, 2:],
        coasting=gap,
        source=_sources(evidence, objects, wanted),
    )
    return LabelledStates(
        states, headings, columns, *step_doubt(evidence, objects.object_of, lifespans, states, size[:, 0])
    )


def dropped_boxes(evidence: Evidence, objects: SmoothedObjects, wanted: FloatArray) -> int:
    """Number of boxes of dropped objects at the times `wanted` (M,), s."""
    at, gone = np.searchsorted(evidence.times, wanted), objects.dropped
    return int((np.searchsorted(at, gone.last, side="right") - np.searchsorted(at, gone.first)).sum())


def _is_stationary(objects: SmoothedObjects) -> BoolArray:
    """(R,) which states are stationary."""
    stationary = np.zeros(len(objects.states), dtype=np.bool_)
    at = objects.states.rows_of(objects.stationary.moment, objects.stationary.id)
    stationary[at[at >= 0]] = True
    return stationary


def _time_to_detection(states: StateTable, times: FloatArray, object_of: IntArray, seen: FloatArray) -> FloatArray:
    """(R,) s from each state to the object's nearest detection; object_of (m,), seen (m,) s of the detections."""
    start, span = times[0], 2 * (times[-1] - times[0]) + 1.0
    keys = np.sort(object_of * span + (seen - start))
    wanted = states.id * span + (times[states.moment] - start)
    after = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.asarray(np.minimum(np.abs(keys[after] - wanted), np.abs(wanted - keys[np.maximum(after - 1, 0)])))


def _sources(evidence: Evidence, objects: SmoothedObjects, wanted: FloatArray) -> StrArray:
    """(R,) extended before and after the detections of the online tracks; else observed at the wanted moment that is
    nearest to a detection, filled elsewhere; corrected where a person's box is or the object was said to stand, near up
    to `NEAR_CORRECTION` from there."""
    states, times = objects.states, evidence.times
    rows = np.flatnonzero(objects.object_of >= 0)
    at = np.searchsorted(times, wanted)
    middle = (wanted[1:] + wanted[:-1]) / 2
    nearest = at[np.searchsorted(middle, times[evidence.moment[rows]])]
    observed = np.zeros(len(states), dtype=np.bool_)
    hit = states.rows_of(nearest, objects.object_of[rows])
    observed[hit[hit >= 0]] = True
    online = evidence.lifespans(np.where(objects.track_of >= 0, objects.object_of, -1))
    row = online.rows_of(states.id)
    beyond = (states.moment < online.first[row]) | (states.moment > online.last[row])
    source = np.where(beyond, "extended", np.where(observed, "observed", "filled"))
    boxes = rows[evidence.corrected[rows] > 0]
    moment = np.concatenate([evidence.moment[boxes], objects.held.moment])
    owner = np.concatenate([objects.object_of[boxes], objects.held.id])
    if len(owner):
        gap = _time_to_detection(states, times, owner, times[moment])
        source = np.where(gap == 0, "corrected", np.where(gap <= NEAR_CORRECTION, "near", source))
    return source


RESOLUTION = 5e-4  # m, of the sizes that are kept
MAX_VALUES = 4096  # kept before equal ones are put together


@dataclass(slots=True)
class ObjectSummary:
    """One object so far: sums for the score and the front, and its sizes.

    yaw, sign  latest heading written, rad, and -1 where the latest headings are half a turn off those at its start
    log_one    log P that it is one object all along; weakest: of its least certain step, and when that is, s
    said       by a person
    boxes, rivals  number of its labels, and of those at the place of a better object of another class
    sizes      lengths, widths and heights: of each, measured values, m, and their weights (2, m)
    """

    probability: float = 0.0
    detections: int = 0
    opportunities: int = 0
    path: float = 0.0
    votes: float = 0.0
    yaw: float = np.nan
    sign: float = 1.0
    log_one: float = 0.0
    weakest: tuple[float, float] = (0.0, np.nan)
    boxes: int = 0
    rivals: int = 0
    said: WholeObject = field(default_factory=WholeObject)
    sizes: list[FloatArray] = field(default_factory=lambda: [np.empty((2, 0))] * 3)

    def heading_sign(self, yaw: float) -> float:
        """-1 where a chunk's headings are half a turn off those at the object's start, else 1.

        yaw: the chunk's heading at the moment of the latest one written, rad
        """
        if not np.isfinite(self.yaw) or not np.isfinite(yaw):
            return self.sign
        return self.sign * (-1.0 if np.cos(yaw - self.yaw) < 0 else 1.0)

    def add_detections(self, probability: float, size: FloatArray, weight: FloatArray) -> None:
        """Add detections (m,): the sum of their probabilities, size (m, 3) in m, NaN for unmeasured, and its weight."""
        self.probability += probability
        self.detections += len(size)
        for axis, values in enumerate(self.sizes):
            known = np.isfinite(size[:, axis])
            more = np.concatenate([values, np.array([size[known, axis], weight[known]])], axis=1)
            if more.shape[1] > MAX_VALUES:
                steps, index = np.unique(np.rint(more[0] / RESOLUTION), return_inverse=True)
                more = np.stack([steps * RESOLUTION, np.bincount(index, more[1])])
            self.sizes[axis] = more

    def add_headings(self, sign: float, yaw: float, path: float, votes: float) -> None:
        """Add headings up to `yaw` (rad), of a `heading_sign`, with the metres moved along them and their votes."""
        self.path += sign * path
        self.votes += sign * votes
        self.sign, self.yaw = sign, yaw

    def add_steps(self, log_right: FloatArray, time: FloatArray) -> None:
        """Add steps (m,) from a detection to the next, at s: log P that both are of the object."""
        self.log_one += float(log_right.sum())
        k = int(np.argmin(log_right))
        self.weakest = min(self.weakest, (float(log_right[k]), float(time[k])))

    def close(self) -> None:
        """Keep the medians of the sizes alone, weighted by the number of detections."""
        medians = median_sizes([self])[0]
        self.sizes = [np.array([[size], [float(self.detections)]])[:, : int(np.isfinite(size))] for size in medians]


def median_sizes(summaries: Sequence[ObjectSummary]) -> FloatArray:
    """(n, 3) length, width and height of objects, m: the medians, NaN where none was measured."""
    result = np.empty((len(summaries), 3))
    for axis in range(3):
        owner = np.repeat(np.arange(len(summaries)), [each.sizes[axis].shape[1] for each in summaries])
        value, weight = np.concatenate([np.empty((2, 0)), *(each.sizes[axis] for each in summaries)], axis=1)
        result[:, axis] = weighted_medians(owner, len(summaries), value, weight)
    return result


class Identities:
    """Names of objects that hold over all chunks. joined: number of tracklets so far stitched to another."""

    def __init__(self) -> None:
        self.joined = 0
        self._owner: dict[int, tuple[int, float]] = {}  # by tracklet: its object's name, and when it was last used

    def name(
        self, ids: IntArray, object_of: IntArray, track_of: IntArray, times: FloatArray, span: tuple[float, float]
    ) -> dict[int, int]:
        """The names of objects (n,), ascending, in a chunk [begin, end), s, that may be infinite.

        Names are unique: an object whose names are all taken gets that of another one that no longer needs it.

        object_of, track_of (N,): of the detections in order of time, -1 for none; times (N,), s
        """
        begin, end = span
        rows = np.flatnonzero((track_of >= 0) & np.isin(object_of, ids))
        pairs = np.unique(np.stack([object_of[rows], track_of[rows]], axis=1), axis=0)
        tracklets, begins = np.unique(track_of[rows], return_index=True)
        first = dict(zip(tracklets.tolist(), times[rows[begins]].tolist(), strict=True))
        names: dict[int, int] = {}
        others, taken = ids.tolist(), set[int]()
        own = [np.searchsorted(pairs[:, 0], ids, side).tolist() for side in ("left", "right")]
        for id_, low, high in zip(others, *own, strict=True):
            tracks = self._in_order(pairs[low:high, 1].tolist(), first, begin)
            known = [self._owner[track][0] for track in tracks if track in self._owner]
            names[id_] = next(name for name in chain(known, [id_], others) if name not in taken)
            taken.add(names[id_])
            for k, track in enumerate(tracks):
                if k == 0 or first[track] < end:
                    self.joined += track != names[id_] and track not in self._owner
                    self._owner[track] = (names[id_], begin)
        return names

    def forget(self, before: float) -> None:
        """Forget tracklets of chunks that begin before a time, s."""
        self._owner = {track: owner for track, owner in self._owner.items() if owner[1] >= before}

    @staticmethod
    def _in_order(tracks: Sequence[int], first: dict[int, float], begin: float) -> list[int]:
        """Tracklets from before a chunk, the latest first; then those that begin in it, the earliest first."""
        old = sorted((track for track in tracks if first[track] < begin), key=lambda track: -first[track])
        return old + sorted((track for track in tracks if first[track] >= begin), key=lambda track: first[track])


class LabelParts(Protocol):
    """Where the labels of a recording wait, chunk by chunk, as named arrays: a list, or files."""

    def append(self, part: Mapping[str, Any], /) -> None:
        """Add a chunk."""
        ...

    def __iter__(self) -> Iterator[Mapping[str, Any]]: ...


class RecordingLabels:
    """The labels of a recording, added chunk by chunk, and read back when it is over: iterating gives those of each
    chunk, one table a moment."""

    def __init__(self, parts: LabelParts) -> None:
        self._parts = parts
        self._id = np.empty(0, dtype=np.int64)  # of all objects, ascending; then their attributes
        self._size, self._score, self._agreement = np.empty((0, 3)), np.empty(0), np.empty(0)
        self._turned, self._gone = np.empty((2, 0), dtype=np.bool_)
        self._label = np.empty(0, dtype="U64")
        self._boxes, self._weakest = np.empty(0, dtype=np.int64), np.empty((0, 2))
        self._probability = Probabilities(*(np.empty(0),) * 4)

    def add(
        self,
        wanted: FloatArray,
        at: IntArray,
        labelled: LabelledStates,
        names: Mapping[int, int],
        signs: Mapping[int, float],
    ) -> None:
        """Add the labels at the times `wanted` (M,), s, which are the moments `at` (M,) of the states.

        names: the final id of each object; signs: -1 where its headings are half a turn off those before, else 1
        """
        spans = [labelled.states.at(moment) for moment in at.tolist()]
        rows = np.concatenate([np.empty(0, dtype=np.int64), *(np.arange(span.start, span.stop) for span in spans)])
        ids = labelled.states.id[rows].tolist()
        columns = replace(labelled.columns.select(rows), id=np.array([names[id_] for id_ in ids], dtype=np.int64))
        self._parts.append(
            {
                "time": wanted,
                "bounds": np.cumsum([0, *(span.stop - span.start for span in spans)]),
                "reversed": np.array([signs[id_] < 0 for id_ in ids], dtype=np.bool_),
                **vars(columns),
            }
        )

    def finish(self, summaries: Mapping[int, ObjectSummary], prior: float) -> None:
        """Take the final attributes of all objects.

        prior: opportunities without a detection that every object starts with
        """
        found = [summaries[id_] for id_ in sorted(summaries)]
        self._id, self._size = np.array(sorted(summaries), dtype=np.int64), median_sizes(found)

        def column(name: str) -> FloatArray:
            return np.array([getattr(each, name) for each in found], dtype=np.float64)

        weight, detections, votes = column("probability"), column("detections"), column("votes")
        self._score = weight / (np.maximum(column("opportunities"), detections) + prior)
        self._turned = is_reversed(column("path"), votes)
        self._agreement = np.abs(votes) / np.maximum(weight, 1e-9)
        self._boxes, rivals = column("boxes").astype(np.int64), column("rivals") / np.maximum(column("boxes"), 1)
        self._weakest = np.array([each.weakest for each in found]).reshape(len(found), 2)
        one, path = np.exp(column("log_one")), column("path")
        p = object_probabilities(self._score, detections, weight, rivals, path, votes, one)
        said = [each.said for each in found]
        real = np.array([each.exists is True for each in said], dtype=np.bool_)
        self._gone = np.array([each.exists is False for each in said], dtype=np.bool_)
        self._label = np.array([each.label for each in said], dtype="U64")
        self._score = np.where(real, 1.0, self._score)
        size = np.array([each.size for each in said]).reshape(-1, 3)
        self._size = np.where(np.isnan(size), self._size, size)
        self._probability = Probabilities(
            np.where(real, 1.0, p.exists), np.where(self._label != "", 1.0, p.label), p.one, p.heading
        )

    def counts(self) -> LabelCounts:
        """Where the boxes come from."""
        return LabelCounts.sum(
            LabelCounts(**{kind: int((columns.source == kind).sum()) for kind in get_args(Source)})
            for _, _, _, columns in self._chunks()
        )

    def __iter__(self) -> Iterator[tuple[Labels, ...]]:
        for times, rows, at, columns in self._chunks():
            size, score, doubt = self._size[at], self._score[at], self._probability.select(at)
            moments = zip(times.tolist(), rows, strict=True)
            yield tuple(
                columns.select(mine).labels(time, size[mine], score[mine], doubt.select(mine)) for time, mine in moments
            )

    def review(self, least_gain: float = LEAST_GAIN) -> Review:
        """The objects with a gain of `least_gain` at least, those first that are most worth a look."""
        n = len(self._id)
        off, worst, clearest = np.zeros(n), np.full((n, 4), -np.inf), np.full((n, 4), -np.inf)
        headed = np.zeros(n, dtype=np.int64)
        label = np.full(n, "", dtype="U64")
        place = np.full((n, 3), np.nan)  # time, x, y at the weakest step
        for times, rows, at, columns in self._chunks():
            time = np.repeat(times, [mine.stop - mine.start for mine in rows])
            P, speed = columns.position_covariance, np.hypot(*columns.velocity.T)
            known = self._size[at, 0], self._score[at], self._agreement[at]
            doubt = far_off(P, columns.yaw_variance, speed, *known)
            np.add.at(off, at, doubt)
            np.add.at(headed, at, np.isfinite(columns.yaw))
            label[at] = columns.label
            where = np.column_stack([time, columns.position[:, :2]])
            _keep_largest(worst, at, doubt, where)
            _keep_largest(clearest, at, -columns.coasting - np.trace(P, axis1=1, axis2=2), where)
            later = time >= self._weakest[at, 1]
            first = later & ~(place[at, 0] <= time)
            place[at[first][::-1]] = where[first][::-1]
        p = self._probability
        parts = gain_parts(p, self._boxes, headed, off)
        why = REASONS[np.argmax(parts, axis=1)]
        place = np.where(np.isnan(place), clearest[:, 1:], place)
        shown = np.select([why[:, None] == "box", why[:, None] == "identity"], [worst[:, 1:], place], clearest[:, 1:])
        gain = parts.sum(axis=1)
        found = Review(self._id, label, self._boxes, gain, why, shown[:, 0], shown[:, 1:], p, off)
        order = np.lexsort((self._id, -gain))
        return found.select(order[((self._boxes > 0) & ~self._gone & (gain >= least_gain))[order]])

    def _chunks(self) -> Iterator[tuple[FloatArray, list[slice], IntArray, LabelColumns]]:
        """Yield the times of a chunk's moments, s, their rows, the objects of all rows, and their columns."""
        for part in self._parts:
            stored = dict(part)
            times, bounds, backward = (stored.pop(name) for name in ("time", "bounds", "reversed"))
            at = np.searchsorted(self._id, stored["id"])
            turned = backward ^ self._turned[at]
            yaw = np.where(turned, wrap_angle(stored["yaw"] + np.pi), stored["yaw"])
            label = np.where(self._label[at] != "", self._label[at], stored["label"])
            kept = ~self._gone[at]
            columns = LabelColumns(**{**stored, "yaw": yaw, "label": label}).select(kept)
            bounds = np.concatenate([[0], np.cumsum(kept)])[bounds]
            yield times, [slice(a, b) for a, b in pairwise(bounds.tolist())], at[kept], columns


def _keep_largest(best: FloatArray, at: IntArray, value: FloatArray, where: FloatArray) -> None:
    """Put value and `where` (m, 3) into the rows `at` (m,) of `best` (n, 4) that have a smaller value."""
    order = np.argsort(value, kind="stable")
    better = order[value[order] > best[at[order], 0]]
    best[at[better]] = np.column_stack([value, where])[better]
