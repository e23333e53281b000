"""One-to-one correspondences: CLEAR MOT over a scene, and at many thresholds.

One-to-one correspondences between true objects and tracks over a scene, as the CLEAR MOT metrics define them.

In every frame, in this order:

1. an object keeps the track it was matched to last while that track is within the gate, so that objects which come
   close to each other cause no identity switches;
2. the others are assigned by the Hungarian method: as many pairs within the gate as possible, and among those the
   assignment with the least sum of distances.

Distances are between centres in the horizontal plane; only equal classes can match.

Source: Bernardin and Stiefelhagen, Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics, EURASIP
Journal on Image and Video Processing, 2008, section 2.1.

Optimal one-to-one assignment at many score thresholds at once.

At each threshold ("level") some of the candidate pairs are present. Within each group of candidates (a frame and class)
the assignment has as many pairs as possible, and among those assignments the least sum of costs. Most pairs have no
competing pair and are chosen at once; the Hungarian method solves the rest, equal problems of several levels once.
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


@dataclass(frozen=True, eq=False)
class Candidates:
    """P candidate pairs: `row` and `column` (P,), `cost` (P,) >= 0, `group` (P,).

    Pairs of different groups share neither row nor column.
    """

    row: IntArray
    column: IntArray
    cost: FloatArray
    group: IntArray

    def __len__(self) -> int:
        return len(self.row)


def optimal_pairs(candidates: Candidates, present: BoolArray) -> BoolArray:
    """(P, T): the candidates chosen at each of T levels, out of those `present` (P, T) there."""
    chosen = np.zeros_like(present)
    if not present.any():
        return chosen
    levels = present.shape[1]
    pair, level = np.nonzero(present)
    alone = _unique(candidates.row[pair], level, levels) & _unique(candidates.column[pair], level, levels)
    chosen[pair[alone], level[alone]] = True
    pair, level = pair[~alone], level[~alone]
    if len(pair) == 0:
        return chosen
    key = candidates.group[pair] * levels + level
    order = np.argsort(key, kind="stable")
    solved: dict[bytes, IntArray] = {}
    for members in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        contested = pair[members]
        name = contested.tobytes()
        if name not in solved:
            solved[name] = contested[
                _hungarian(candidates.row[contested], candidates.column[contested], candidates.cost[contested])
            ]
        chosen[solved[name], level[members[0]]] = True
    return chosen


def best_pairs(candidates: Candidates) -> BoolArray:
    """(P,): the candidates that the assignment of all of them chooses."""
    return optimal_pairs(candidates, np.ones((len(candidates), 1), dtype=np.bool_))[:, 0]


def _unique(row: IntArray, level: IntArray, levels: int) -> BoolArray:
    """(Q,) True for entries whose row occurs once at their level."""
    key = (row - row.min()) * levels + level
    return np.asarray(np.bincount(key)[key] == 1)


def _hungarian(row: IntArray, column: IntArray, cost: FloatArray) -> BoolArray:
    """Mask of the pairs (row, column) that the assignment chooses."""
    rows, r = np.unique(row, return_inverse=True)
    columns, c = np.unique(column, return_inverse=True)
    outside = 2.0 * min(len(rows), len(columns)) * (cost.max() + 1.0) + 1.0  # more than all pairs together
    matrix = np.full((len(rows), len(columns)), outside)
    matrix[r, c] = cost
    selected = np.zeros(matrix.shape, dtype=np.bool_)
    selected[linear_sum_assignment(matrix)] = True
    return np.asarray(selected[r, c])


class FoundBoxes(Protocol):
    """N boxes with identities in one frame: a tracker's `Tracks`, or rows of a result file."""

    @property
    def id(self) -> IntArray | StrArray: ...
    @property
    def boxes(self) -> Boxes: ...
    @property
    def position_covariance(self) -> FloatArray: ...
    def __len__(self) -> int: ...
    def select(self, rows: Any) -> Self: ...


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


def match_scene(
    ground_truth: Sequence[Annotations], tracks: Sequence[FoundBoxes], gate: float = 2.0
) -> list[FrameMatch]:
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
        distance = _distances(truth, found)
        distance[distance > gate] = np.inf
        rows, columns = _assign(distance, seen[objects, None] & (last_track[objects, None] == found.id[None, :]))
        matched = objects[rows]
        switched = seen[matched] & (last_track[matched] != found.id[columns])
        last_track[matched], seen[matched] = found.id[columns], True
        result.append(FrameMatch(rows, columns, distance[rows, columns], switched))
    return result


def _distances(truth: Annotations, found: FoundBoxes) -> FloatArray:
    """(N, M) horizontal distances, infinite between different classes."""
    offset = truth.boxes.position[:, None, :2] - found.boxes.position[None, :, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    distance[truth.boxes.label[:, None] != found.boxes.label[None, :]] = np.inf
    return np.asarray(distance)


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
