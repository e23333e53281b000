"""Smoothed objects to labels, and the attributes that belong to a whole object: size, score, front, identity.

A chunk of a recording has all positions of its objects, and a part of the evidence on their sizes, scores and fronts.
The parts are summed: probabilities and opportunities of the score, metres and votes of the front, and of the size the
weights of all measured values, to half a millimetre where they are many.

Every chunk stitches tracklets into objects anew, and names an object after its first tracklet there. A tracklet that
was part of an object before stays so: the object keeps the name of its tracklets. Where they have several, it is that
of the tracklet that reaches furthest towards the chunk, so that an object's name does not change across the boundary.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import get_args

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray
from saga_fg.smoothing.association import Evidence
from saga_fg.smoothing.boxes import (
    Headings,
    constant_sizes,
    scalar_readings,
    size_weights,
    smooth_headings,
    smooth_walks,
    weighted_medians,
)
from saga_fg.smoothing.corrections import WholeObject
from saga_fg.smoothing.doubt import step_doubt
from saga_fg.smoothing.passes import SmoothedObjects
from saga_fg.smoothing.settings import OfflineClass, SmoothingSettings
from saga_fg.smoothing.states import Labels, Probabilities, Source, StateTable, quality_of
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
        P, P_velocity = self.position_covariance, self.velocity_covariance
        tracks = Tracks(time, self.id, boxes, score, P, P_velocity, self.coasting)
        return Labels(tracks, self.yaw_variance, self.source, quality_of(score, P), probability)


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
    headings = smooth_headings(states, lifespans, evidence, rows, at, turning, moving)
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
    mine, weight = lifespans.rows_of(objects.object_of[rows]), size_weights(evidence)[rows]
    size = constant_sizes(mine, len(lifespans), evidence.boxes.size[rows], weight)
    doubt = step_doubt(evidence, objects.object_of, lifespans, states, size[:, 0])
    return LabelledStates(states, headings, columns, *doubt)


def source_counts(source: StrArray) -> dict[str, int]:
    """Numbers of boxes by what they rest on."""
    return {kind: int((source == kind).sum()) for kind in get_args(Source)}


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
        known = np.isfinite(size).all(axis=1)
        for axis, values in enumerate(self.sizes):
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
        if self.sizes[0].shape[1]:
            self.sizes = [np.array([[size], [float(self.detections)]]) for size in median_sizes([self])[0]]


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
