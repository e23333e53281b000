"""Boxes of a scene as one table, near pairs of them, and optimal assignments at many thresholds at once.

At each threshold ("level") some of the candidate pairs are present. Within each group of candidates (a frame and class)
the assignment has as many pairs as possible, and among those assignments the least sum of costs. Most pairs have no
competing pair and are chosen at once; the Hungarian method solves the rest, equal problems of several levels once.

Pairs of boxes of the same frame and class: all within a gate, and the best one-to-one pairs among them.

Pairs of a frame do not depend on other frames or on identities, so trackers are compared on the same labels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, checked, checked_labels, refuse
from saga_fg.types import Annotations, Boxes, Tracks


@dataclass(frozen=True, eq=False)
class Candidates(Columns):
    """P candidate pairs: `row` and `column` (P,), `cost` (P,) >= 0, `group` (P,).

    Pairs of different groups share neither row nor column.
    """

    row: IntArray
    column: IntArray
    cost: FloatArray
    group: IntArray


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


@dataclass(frozen=True, eq=False)
class SceneBoxes(Columns):
    """N boxes of one scene, in order of time.

    frame   (N,) index of the frame, from 0, never decreasing
    id      (N,) names of the objects or tracks; a name occurs once in a frame at most
    boxes   label, position, size, yaw, velocity, all frames in one coordinate frame
    score   (N,) confidence; 0 for ground truth
    position_covariance  (N, 2, 2) of the horizontal position, m^2, NaN where unknown; may be left out

    Raises `InputError` for frames out of order or an identity that occurs twice in one frame.
    """

    frame: IntArray
    id: StrArray
    boxes: Boxes
    score: FloatArray
    position_covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))

    def __post_init__(self) -> None:
        n = len(self.boxes)
        frame = np.array(self.frame, dtype=np.int64)
        if frame.shape != (n,) or (np.diff(frame) < 0).any() or (n and frame[0] < 0):
            raise InputError(f"frame: expected {n} indices from 0 that never decrease")
        names = checked_labels("id", self.id, n)
        _, numbers = np.unique(names, return_inverse=True)
        key = numbers * (frame[-1] + 1 if n else 1) + frame
        again = np.ones(n, dtype=np.bool_)
        again[np.unique(key, return_index=True)[1]] = False
        twice = "id[{}]: expected unique ids, {!r} occurs twice in frame {}"
        refuse(again, lambda row: InputError(twice.format(row, str(names[row]), frame[row])))
        for name, array in (("frame", frame), ("id", names), ("score", checked("score", self.score, (n,)))):
            object.__setattr__(self, name, array)
        given = self.position_covariance if len(self.position_covariance) else np.full((n, 2, 2), np.nan)
        covariance = checked("position_covariance", given, (n, 2, 2), "finite-or-nan")
        object.__setattr__(self, "position_covariance", covariance)

    @classmethod
    def of_annotations(cls, frames: Sequence[Annotations], hidden: bool = True) -> Self:
        """Ground truth as a table; without `hidden`, visible objects only."""
        kept = [np.ones(len(truth), dtype=np.bool_) if hidden else truth.visible for truth in frames]
        boxes = Boxes.concatenate([truth.boxes.select(rows) for truth, rows in zip(frames, kept, strict=True)])
        names = [truth.id[rows] for truth, rows in zip(frames, kept, strict=True)]
        frame = np.repeat(np.arange(len(frames)), [int(rows.sum()) for rows in kept])
        return cls(frame, np.concatenate([np.empty(0, dtype="<U1"), *names]), boxes, np.zeros(len(boxes)))

    @classmethod
    def of_tracks(cls, frames: Sequence[Tracks]) -> Self:
        """A tracker's output as a table."""
        boxes = Boxes.concatenate([found.boxes for found in frames])
        frame = np.repeat(np.arange(len(frames)), [len(found) for found in frames])
        numbers = np.concatenate([np.empty(0, dtype=np.int64), *(found.id for found in frames)])
        score = np.concatenate([np.empty(0), *(found.score for found in frames)])
        covariance = np.concatenate([np.empty((0, 2, 2)), *(found.position_covariance for found in frames)])
        return cls(frame, numbers.astype(np.str_), boxes, score, covariance)

    def by_frame(self, count: int) -> list[Self]:
        """The boxes of each of the scene's `count` frames."""
        bounds = np.searchsorted(self.frame, np.arange(count + 1)).tolist()
        return [self.select(slice(first, end)) for first, end in pairwise(bounds)]

    @property
    def track_score(self) -> FloatArray:
        """(N,) mean score of the track of each box, by which evaluations rank tracks."""
        return track_means(self.score, np.unique(self.id, return_inverse=True)[1])

    def annotations(self, count: int) -> list[Annotations]:
        """The boxes of each of `count` frames as objects that can be seen, to compare others with them."""
        return [Annotations(each.id, each.boxes) for each in self.by_frame(count)]


FrameBoxes = tuple[IntArray, Boxes]  # index of the frame (N,), and N boxes
Pairs = tuple[IntArray, IntArray, FloatArray]  # rows (P,) of the first and of the second table, distance (P,) in m


def near_pairs(first: FrameBoxes, second: FrameBoxes, gate: float) -> Pairs:
    """All pairs of the same frame and class within a horizontal distance of `gate` m, in order of their rows."""
    labels = np.unique(np.concatenate([first[1].label, second[1].label]))
    if not len(first[1]) or not len(second[1]):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
    origin = first[1].position[0, :2]
    # the third axis moves boxes of another frame or class out of reach
    a, b = (
        cKDTree(
            np.column_stack(
                [
                    boxes.position[:, :2] - origin,
                    3.0 * gate * (frame * len(labels) + np.searchsorted(labels, boxes.label)),
                ]
            )
        )
        for frame, boxes in (first, second)
    )
    near = a.sparse_distance_matrix(b, gate, output_type="ndarray")
    near = near[np.lexsort((near["j"], near["i"]))]
    return near["i"].astype(np.int64), near["j"].astype(np.int64), near["v"].copy()


def nearest_pairs(first: FrameBoxes, second: FrameBoxes, gate: float) -> Pairs:
    """One-to-one pairs of the same frame and class within `gate` m: as many as possible, then the nearest."""
    row, column, distance = near_pairs(first, second, gate)
    labels, label = np.unique(first[1].label, return_inverse=True)
    chosen = best_pairs(Candidates(row, column, distance, (first[0] * len(labels) + label)[row]))
    return row[chosen], column[chosen], distance[chosen]


def track_means(score: FloatArray, identity: IntArray) -> FloatArray:
    """Mean score (N,) of each row's track. Summed track by track: thresholds compare scores to the last bit."""
    order = np.argsort(identity, kind="stable")
    counts = np.bincount(identity)
    parts = np.split(score[order], np.cumsum(counts)[:-1]) if len(counts) else []
    return np.array([np.mean(part) for part in parts], dtype=np.float64)[identity]
