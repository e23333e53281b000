"""Smoothed objects to labels: size, height, heading, score and quality of every box at the moments wanted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.smoothing.passes import SmoothedObjects
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns
from saga_fg.smoothing import (
    Evidence,
    Headings,
    LabelCounts,
    Labels,
    Lifespans,
    OfflineClass,
    SmoothingSettings,
    StateTable,
    constant_sizes,
    lifespans_of,
    quality_of,
    scalar_readings,
    smooth_headings,
    smooth_walks,
)
from saga_fg.types.boxes import Boxes
from saga_fg.types.by_class import class_values
from saga_fg.types.track import Tracks

HEIGHT_DRIFT = 0.1  # standard deviation of a centre's height after one second, m


@dataclass(frozen=True, eq=False)
class LabelColumns(Columns):
    """Columns of R labels; positions (R, 3) in the world, other shapes and units as in `Tracks` and `Labels`."""

    id: IntArray
    label: StrArray
    position: FloatArray
    size: FloatArray
    yaw: FloatArray
    yaw_variance: FloatArray
    velocity: FloatArray
    position_covariance: FloatArray
    velocity_covariance: FloatArray
    coasting: FloatArray
    score: FloatArray
    source: StrArray
    quality: StrArray

    def labels(self, time: float) -> Labels:
        """All rows as the labels of one moment, at `time` s."""
        boxes = Boxes(self.label, self.position, self.size, self.yaw, self.velocity)
        P, P_velocity = self.position_covariance, self.velocity_covariance
        tracks = Tracks(time, self.id, boxes, self.score, P, P_velocity, self.coasting)
        return Labels(tracks, self.yaw_variance, self.source, self.quality)


@dataclass(frozen=True, eq=False)
class LabelledStates:
    """R smoothed states, their headings, and their labels as columns."""

    states: StateTable
    headings: Headings
    columns: LabelColumns

    def at(self, moment: int, time: float) -> Labels:
        """The labels of a moment of the evidence, which is at `time` s."""
        return self.columns.select(self.states.at(moment)).labels(time)


def label_moments(
    evidence: Evidence, objects: SmoothedObjects, wanted: FloatArray, settings: SmoothingSettings
) -> tuple[Labels, ...]:
    """The labels at the times `wanted` (M,), s."""
    labelled = label_states(evidence, objects, wanted, settings)
    return tuple(labelled.at(int(np.searchsorted(evidence.times, time)), time) for time in wanted.tolist())


def label_states(
    evidence: Evidence, objects: SmoothedObjects, wanted: FloatArray, settings: SmoothingSettings
) -> LabelledStates:
    """Labels of all states of a recording; the times `wanted` (M,), s, are those that count as observed or not."""
    lifespans, states = objects.lifespans, objects.states
    owner = lifespans.rows_of(states.id)
    rows = np.flatnonzero(objects.object_of >= 0)
    holder = lifespans.rows_of(objects.object_of[rows])
    at = states.rows_of(evidence.moment[rows], objects.object_of[rows])
    boxes, p = evidence.boxes, evidence.probability[rows]
    size = constant_sizes(holder, len(lifespans), boxes.size[rows], p, evidence.distance[rows])
    duration = states.elapsed(evidence.times)
    heights = scalar_readings(at, boxes.position[rows, 2], evidence.z_noise[rows] ** 2)
    z, _ = smooth_walks(states, HEIGHT_DRIFT**2 * duration, heights)
    label = lifespans.label[owner]
    yaw_drift, lasting = class_values(settings.classes, OfflineClass, label, "yaw_drift", "position_bias")
    turning = yaw_drift**2 * duration
    turning = np.where(_is_stationary(objects), 1e-6, turning)
    (moving,) = class_values(settings.classes, OfflineClass, lifespans.label, "min_heading_speed")
    headings = smooth_headings(states, lifespans, evidence, rows, at, turning, moving)
    P = states.covariance[:, :2, :2] + lasting[:, None, None] ** 2 * np.eye(2)
    gap = _time_to_detection(states, evidence.times, objects.object_of[rows], evidence.times[evidence.moment[rows]])
    score = objects.score[owner]
    columns = LabelColumns(
        states.id,
        label,
        np.concatenate([states.mean[:, :2] + evidence.origin, z[:, None]], axis=1),
        size[owner],
        headings.yaw,
        headings.variance,
        states.mean[:, 2:],
        P,
        states.covariance[:, 2:, 2:],
        gap,
        score,
        _sources(evidence, objects, wanted),
        quality_of(score, P),
    )
    return LabelledStates(states, headings, columns)


def count_labels(
    evidence: Evidence, objects: SmoothedObjects, labels: tuple[Labels, ...], wanted: FloatArray
) -> LabelCounts:
    """The summary of a recording."""
    return LabelCounts(
        **source_counts(np.concatenate([np.empty(0, dtype="<U1"), *(moment.source for moment in labels)])),
        dropped=dropped_boxes(evidence, objects, wanted),
        objects=len(objects.lifespans),
        dropped_objects=len(objects.dropped),
        joined=objects.joined,
    )


def source_counts(source: StrArray) -> dict[str, int]:
    """Numbers of boxes that were observed, filled and extended."""
    return {kind: int((source == kind).sum()) for kind in ("observed", "filled", "extended")}


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
    nearest to a detection, filled elsewhere."""
    states, times = objects.states, evidence.times
    rows = np.flatnonzero(objects.object_of >= 0)
    at = np.searchsorted(times, wanted)
    middle = (wanted[1:] + wanted[:-1]) / 2
    nearest = at[np.searchsorted(middle, times[evidence.moment[rows]])]
    observed = np.zeros(len(states), dtype=np.bool_)
    hit = states.rows_of(nearest, objects.object_of[rows])
    observed[hit[hit >= 0]] = True
    online: Lifespans = lifespans_of(
        np.where(objects.track_of >= 0, objects.object_of, -1), evidence.boxes.label, evidence.moment
    )
    row = online.rows_of(states.id)
    beyond = (states.moment < online.first[row]) | (states.moment > online.last[row])
    return np.where(beyond, "extended", np.where(observed, "observed", "filled"))
