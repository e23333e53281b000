"""Metrics of the tracks of a scene: errors, identity switches, and errors at hidden objects.

One-to-one correspondences between true objects and tracks over a scene, as the CLEAR MOT metrics define them.

In every frame, in this order:

1. an object keeps the track it was matched to last while that track is within the gate, so that objects which come
   close to each other cause no identity switches;
2. the others are assigned by the Hungarian method: as many pairs within the gate as possible, and among those the
   assignment with the least sum of distances.

Distances are between centres in the horizontal plane; only equal classes can match.

Source: Bernardin and Stiefelhagen, Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics, EURASIP
Journal on Image and Video Processing, 2008, section 2.1.

Over this matching (CLEAR):

    MOTA   = 1 - (misses + false positives + identity switches) / objects      objects: visible true boxes
    MOTP   = mean distance of the matched pairs of visible objects, m
    recall = matched visible objects / visible objects

An object that no sensor can see (`Annotations.visible` is False) may be matched, and identity switches count there too,
but an unmatched hidden object is not a miss.

The *carried error* evaluates hidden objects. For every object that was matched while visible and is hidden now, it is
the distance to the track that was matched to it when it was last visible:

    carried error = min(distance to that track, cap)        cap, if that track no longer exists

A tracker therefore does not improve the figure by deleting difficult tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from data_tools.metrics.label_errors import ErrorSample, nees
from data_tools.metrics.scene_boxes import Candidates, SceneBoxes, best_pairs
from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, IntArray, wrap_angle
from saga_fg.types import Annotations, Tracks

Found = Tracks | SceneBoxes  # of one frame: a tracker's output, or rows of a result file
CAP = 5.0  # largest carried error, also that of a hidden object whose track is lost, m


@dataclass(frozen=True, eq=False)
class FrameMatch:
    """The M pairs of one frame.

    object_row  (M,) rows of the annotations
    track_row   (M,) rows of the tracks
    distance    (M,) m, horizontal
    switched    (M,) identity switches: the object was last matched to another track
    """

    object_row: IntArray
    track_row: IntArray
    distance: FloatArray
    switched: BoolArray


def match_scene(ground_truth: Sequence[Annotations], tracks: Sequence[Found], gate: float = 2.0) -> list[FrameMatch]:
    """The matching at each of the K frames of a scene; pairs further apart than `gate` (m) never match.

    Raises `InputError` when the two sequences differ in length.
    """
    if len(ground_truth) != len(tracks):
        raise InputError(
            f"tracks: expected one entry per frame of the ground truth ({len(ground_truth)}), got {len(tracks)}"
        )
    numbers = {
        name: n for n, name in enumerate(np.unique([name for truth in ground_truth for name in truth.id.tolist()]))
    }
    ids = {found.id.dtype for found in tracks} or {np.dtype(np.int64)}
    last_track = np.zeros(len(numbers), dtype=np.result_type(*ids))
    seen = np.zeros(len(numbers), dtype=np.bool_)
    result = []
    for truth, found in zip(ground_truth, tracks, strict=True):
        objects = np.array([numbers[name] for name in truth.id.tolist()], dtype=np.int64)
        offset = truth.boxes.position[:, None, :2] - found.boxes.position[None, :, :2]
        distance = np.hypot(offset[..., 0], offset[..., 1])
        distance[(distance > gate) | (truth.boxes.label[:, None] != found.boxes.label[None, :])] = np.inf
        rows, columns = _assign(distance, seen[objects, None] & (last_track[objects, None] == found.id[None, :]))
        matched = objects[rows]
        switched = seen[matched] & (last_track[matched] != found.id[columns])
        last_track[matched], seen[matched] = found.id[columns], True
        result.append(FrameMatch(rows, columns, distance[rows, columns], switched))
    return result


def _assign(distance: FloatArray, previous: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the pairs: previous pairs within the gate (finite) first, then the optimal assignment.

    Two objects may have been matched last to the same track; the nearer one keeps it.
    """
    kept = np.where(previous, distance, np.inf)
    kept[kept > kept.min(axis=0, initial=np.inf)] = np.inf
    kept_rows, kept_columns = np.nonzero(np.isfinite(kept))
    kept_columns, first = np.unique(kept_columns, return_index=True)
    kept_rows = kept_rows[first]
    free = np.isfinite(distance)
    free[kept_rows], free[:, kept_columns] = False, False
    rows, columns = np.nonzero(free)
    chosen = best_pairs(Candidates(rows, columns, distance[rows, columns], np.zeros(len(rows), dtype=np.int64)))
    rows, columns = np.append(kept_rows, rows[chosen]), np.append(kept_columns, columns[chosen])
    order = np.argsort(rows)
    return rows[order], columns[order]


@dataclass(frozen=True, eq=False)
class SceneMetrics:
    """Counts and errors of one scene, or of several (`pool`). Errors are those of matched pairs unless stated.

    objects, hidden_objects      true boxes that were visible, and that were not
    matches, hidden_matches      those of them with a track
    false_positives              track boxes that match nothing
    switches                     identity switches
    position, velocity           m and m/s, horizontal, visible objects (velocity: where both are known)
    hidden_position, hidden_velocity   position and velocity errors of hidden objects
    heading                      rad, in [0, pi], visible objects
    carried                      m, hidden objects, lost ones at the cap (see the module)
    nees                         of the position of visible objects, 2 degrees of freedom
    """

    objects: int
    hidden_objects: int
    matches: int
    hidden_matches: int
    false_positives: int
    switches: int
    position: ErrorSample
    velocity: ErrorSample
    hidden_position: ErrorSample
    hidden_velocity: ErrorSample
    heading: ErrorSample
    carried: ErrorSample
    nees: ErrorSample

    @classmethod
    def pool(cls, scenes: Iterable[SceneMetrics]) -> Self:
        """Counts added, errors put together."""
        parts = list(scenes)
        pooled: dict[str, Any] = {}
        for field in fields(cls):
            column = [getattr(part, field.name) for part in parts]
            pooled[field.name] = sum(column) if field.type == "int" else ErrorSample.pool(column)
        return cls(**pooled)

    @property
    def misses(self) -> int:
        """Visible objects without a track (FN)."""
        return self.objects - self.matches

    @property
    def mota(self) -> float:
        faults = self.misses + self.false_positives + self.switches
        return 1.0 - faults / self.objects if self.objects else float("nan")

    @property
    def motp(self) -> float:
        """Mean position error, m."""
        return self.position.mean

    @property
    def recall(self) -> float:
        return self.matches / self.objects if self.objects else float("nan")

    @property
    def hidden_recall(self) -> float:
        return self.hidden_matches / self.hidden_objects if self.hidden_objects else float("nan")


def scene_metrics(ground_truth: Sequence[Annotations], tracks: Sequence[Found]) -> SceneMetrics:
    """The metrics of one scene: K annotations and the K `Tracks` of the same frames, both in world coordinates.

    Raises `InputError` when their numbers differ.
    """
    matchings = match_scene(ground_truth, tracks)
    frames = list(zip(ground_truth, tracks, matchings, strict=True))
    pairs = [_pair_errors(*frame) for frame in frames]
    visible = np.concatenate([np.empty(0, dtype=np.bool_), *(truth.visible[m.object_row] for truth, _, m in frames)])
    position, velocity, heading, consistency = np.concatenate([np.empty((4, 0)), *pairs], axis=1)
    objects = sum(int(truth.visible.sum()) for truth in ground_truth)
    return SceneMetrics(
        objects=objects,
        hidden_objects=sum(map(len, ground_truth)) - objects,
        matches=int(visible.sum()),
        hidden_matches=int((~visible).sum()),
        false_positives=sum(map(len, tracks)) - len(visible),
        switches=sum(int(m.switched.sum()) for m in matchings),
        position=ErrorSample(position[visible]),
        velocity=ErrorSample.known(velocity[visible]),
        hidden_position=ErrorSample(position[~visible]),
        hidden_velocity=ErrorSample.known(velocity[~visible]),
        heading=ErrorSample.known(heading[visible]),
        carried=ErrorSample(_carried_errors(frames)),
        nees=ErrorSample.known(consistency[visible]),
    )


def scene_metrics_by_label(ground_truth: Sequence[Annotations], tracks: Sequence[Found]) -> dict[str, SceneMetrics]:
    """`scene_metrics` of each class, by name; pooling them gives the metrics of the whole scene."""
    boxes = [truth.boxes for truth in ground_truth] + [found.boxes for found in tracks]
    labels = {label for table in boxes for label in table.label.tolist()}
    return {
        label: scene_metrics(
            [_annotations(truth, truth.boxes.label == label) for truth in ground_truth],
            [found.select(found.boxes.label == label) for found in tracks],
        )
        for label in sorted(labels)
    }


def _pair_errors(truth: Annotations, found: Found, matching: FrameMatch) -> FloatArray:
    """(4, M): position, velocity, heading errors and NEES of the pairs of one frame; NaN where unknown."""
    a, b = truth.boxes.select(matching.object_row), found.boxes.select(matching.track_row)
    velocity = b.velocity - a.velocity
    consistency = nees((b.position - a.position)[:, :2], found.position_covariance[matching.track_row])
    heading = np.abs(wrap_angle(b.yaw - a.yaw))
    return np.stack([matching.distance, np.hypot(velocity[:, 0], velocity[:, 1]), heading, consistency])


def _carried_errors(frames: Sequence[tuple[Annotations, Found, FrameMatch]]) -> FloatArray:
    """Carried errors of all hidden objects, see the module."""
    carrier: dict[str, int | str] = {}
    errors: list[float] = []
    for truth, found, matching in frames:
        row_of = {track: row for row, track in enumerate(found.id.tolist())}
        for row in np.flatnonzero(~truth.visible):
            track = carrier.get(truth.id[row])
            if track is None:
                continue
            at = row_of.get(track)
            if at is None:
                errors.append(CAP)
            else:
                offset = found.boxes.position[at, :2] - truth.boxes.position[row, :2]
                errors.append(min(float(np.hypot(*offset)), CAP))
        visible = truth.visible[matching.object_row]
        names = truth.id[matching.object_row[visible]].tolist()
        carrier.update(zip(names, found.id[matching.track_row[visible]].tolist(), strict=True))
    return np.array(errors)


def _annotations(truth: Annotations, rows: BoolArray) -> Annotations:
    return Annotations(truth.id[rows], truth.boxes.select(rows), truth.visible[rows])
