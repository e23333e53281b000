"""One-to-one correspondences between true objects and tracks over a scene, as the CLEAR MOT metrics define them.

At every moment, in this order:

1. an object keeps the track it was matched to last, as long as that track is within the gate (so that a tracker is
   not charged with identity switches where two objects merely come close);
2. the rest is assigned by the Hungarian method: as many pairs within the gate as possible, and among those the
   assignment with the least sum of distances.

Distances are between centres in the horizontal plane; with `same_label` only equal classes can match.

Source: Bernardin and Stiefelhagen, Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics, EURASIP
Journal on Image and Video Processing, 2008, section 2.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations


class FoundBoxes(Protocol):
    """N boxes with identities at one moment: a tracker's `Tracks`, or the rows of a `TrackTable`."""

    @property
    def id(self) -> IntArray | StrArray: ...
    @property
    def boxes(self) -> Boxes: ...
    @property
    def position_covariance(self) -> FloatArray: ...
    def __len__(self) -> int: ...
    def select(self, rows: Any) -> Self: ...


@dataclass(frozen=True, eq=False)
class Matching:
    """The M pairs of one moment.

    object_row  (M,) rows of the annotations
    track_row   (M,) rows of the tracks
    distance    (M,) m, horizontal
    switched    (M,) whether the object was last matched to another track: an identity switch
    """

    object_row: IntArray
    track_row: IntArray
    distance: FloatArray
    switched: BoolArray


def match_scene(
    ground_truth: Sequence[Annotations], tracks: Sequence[FoundBoxes], gate: float = 2.0, same_label: bool = True
) -> list[Matching]:
    """The matching at each of the K moments of a scene; pairs further apart than `gate` (m) never match.

    Raises `InputError` when the two sequences differ in length.
    """
    if len(ground_truth) != len(tracks):
        raise InputError(
            f"tracks: expected one entry per moment of the ground truth ({len(ground_truth)}), got {len(tracks)}"
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
        distance = _distances(truth, found, same_label)
        distance[distance > gate] = np.inf
        rows, columns = _assign(distance, seen[objects, None] & (last_track[objects, None] == found.id[None, :]))
        matched = objects[rows]
        switched = seen[matched] & (last_track[matched] != found.id[columns])
        last_track[matched], seen[matched] = found.id[columns], True
        result.append(Matching(rows, columns, distance[rows, columns], switched))
    return result


def _distances(truth: Annotations, found: FoundBoxes, same_label: bool) -> FloatArray:
    """(N, M) horizontal distances, infinite between different classes where these must not match."""
    offset = truth.boxes.position[:, None, :2] - found.boxes.position[None, :, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    if same_label:
        distance[truth.boxes.label[:, None] != found.boxes.label[None, :]] = np.inf
    return np.asarray(distance)


def _assign(distance: FloatArray, previous: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the pairs: previous ones within the gate (finite) first, then the Hungarian method.

    Track ids are unique, but two objects may remember the same track (one lost it to the other): the nearer keeps it.
    """
    kept = np.where(previous, distance, np.inf)
    kept[kept > kept.min(axis=0, initial=np.inf)] = np.inf
    kept_rows, kept_columns = np.nonzero(np.isfinite(kept))
    kept_columns, first = np.unique(kept_columns, return_index=True)
    kept_rows = kept_rows[first]
    rows = np.setdiff1d(np.arange(distance.shape[0]), kept_rows)
    columns = np.setdiff1d(np.arange(distance.shape[1]), kept_columns)
    rest = distance[np.ix_(rows, columns)]
    within = np.isfinite(rest)
    # One pair more is worth more than any saving in distance, so the pairs outside cost more than all within together.
    outside = 1.0 + 2.0 * rest[within].sum()
    chosen = np.stack(linear_sum_assignment(np.where(within, rest, outside)))
    chosen = chosen[:, within[chosen[0], chosen[1]]]
    all_rows = np.concatenate([kept_rows, rows[chosen[0]]])
    all_columns = np.concatenate([kept_columns, columns[chosen[1]]])
    order = np.argsort(all_rows)
    return all_rows[order], all_columns[order]
