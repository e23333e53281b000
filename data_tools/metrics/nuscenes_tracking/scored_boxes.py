"""The scored boxes: filtered as in the official evaluation, with gaps within tracks interpolated.

Filter (`nuscenes/eval/common/loaders.py`, `filter_eval_boxes`): true boxes and tracks alike are kept within their
class's distance from the vehicle, in the horizontal plane; bicycles and motorcycles whose centre lies in a box of
category `static_object.bicycle_rack` are dropped. True boxes without a LiDAR or radar point are dropped.

Score: each box gets the mean score of its track over the kept boxes.

Gaps (`nuscenes/eval/tracking/loaders.py`, `interpolate_tracks`): where a track skips frames, boxes are interpolated,

    x(t) = (1 - r) x_left + r x_right        r = (t_right - t) / (t_right - t_left)

The weights are reversed (r is near 1 next to the left box) like those of the official evaluation, so that metrics are
comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.types.boxes import Boxes

RACKED = ("bicycle", "motorcycle")


@dataclass(frozen=True, eq=False)
class ScoredBoxes(Columns):
    """N scored boxes of one scene, in order of time.

    frame     (N,)   index of the frame, from 0
    identity  (N,)   number of the object or track, from 0 in order of first appearance
    label     (N,)   number of the class
    xy        (N, 2) horizontal centre, m
    score     (N,)   mean score of the track
    """

    frame: IntArray
    identity: IntArray
    label: IntArray
    xy: FloatArray
    score: FloatArray


def scored_boxes(
    table: SceneBoxes,
    ego_position: FloatArray,
    racks: Sequence[Boxes],
    timestamps: FloatArray,
    class_range: dict[str, float],
) -> ScoredBoxes:
    """Filter a table, average its scores over tracks and fill its gaps.

    ego_position  (K, 2) of the vehicle, m; timestamps (K,) s; racks: bicycle racks in each frame, empty for none.
    Labels are numbered in the order of `class_range` (label -> m); other classes are dropped.
    """
    position, frame = table.boxes.position, table.frame
    names = list(class_range)
    number = {name: n for n, name in enumerate(names)}
    kinds, which = np.unique(table.boxes.label, return_inverse=True)
    label = np.array([number.get(kind, -1) for kind in kinds.tolist()], dtype=np.int64)[which]
    limit = np.array([*class_range.values(), -np.inf])[label]
    offset = position[:, :2] - ego_position[frame]
    kept = np.sqrt(np.sum(offset**2, axis=1)) < limit
    racked = np.isin(label, [number[name] for name in RACKED if name in number])
    for k, boxes in enumerate(racks):
        if len(boxes):
            near = np.flatnonzero(kept & racked & (frame == k))
            kept[near] = ~_inside_any(position[near], boxes)
    rows = np.flatnonzero(kept)
    identity = _numbered(table.id[rows])
    score = _track_means(table.score[rows], identity)
    micros = np.rint(timestamps * 1e6).astype(np.int64)  # the unit of the tables, so that ratios round as they do
    return _filled(ScoredBoxes(frame[rows], identity, label[rows], position[rows, :2], score), micros)


def _inside_any(points: FloatArray, boxes: Boxes) -> BoolArray:
    """Mask of the points (N, 3) that lie in at least one of the boxes, faces included."""
    offset = points[:, None] - boxes.position[None]
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    local = np.stack(
        [c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0], offset[..., 2]], axis=-1
    )
    inside = np.all(np.abs(local) <= boxes.size[None] / 2, axis=2)
    return np.asarray(np.any(inside, axis=1))


def _numbered(names: np.ndarray[tuple[int], np.dtype[np.str_]]) -> IntArray:
    """Names (N,) to numbers in order of first appearance."""
    _, first, inverse = np.unique(names, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[inverse])


def _track_means(score: FloatArray, identity: IntArray) -> FloatArray:
    """Mean score of each row's track. Summed track by track: thresholds compare scores to the last bit."""
    order = np.argsort(identity, kind="stable")
    counts = np.bincount(identity)
    parts = np.split(score[order], np.cumsum(counts)[:-1]) if len(counts) else []
    return np.array([np.mean(part) for part in parts], dtype=np.float64)[identity]


def _filled(rows: ScoredBoxes, micros: IntArray) -> ScoredBoxes:
    """Rows with the gaps of each track filled; interpolated rows come last within their frame, by identity."""
    order = np.lexsort((rows.frame, rows.identity))
    by_track = rows.select(order)
    gap = np.where(np.diff(by_track.identity) == 0, np.diff(by_track.frame) - 1, 0)
    left = np.repeat(np.arange(len(gap)), gap)
    start = np.repeat(np.cumsum(gap) - gap, gap)
    frame = by_track.frame[left] + 1 + np.arange(len(left)) - start
    a, b = by_track.select(left), by_track.select(left + 1)
    ratio = (micros[b.frame] - micros[frame]) / (micros[b.frame] - micros[a.frame])
    xy = (1.0 - ratio[:, None]) * a.xy + ratio[:, None] * b.xy
    score = (1.0 - ratio) * a.score + ratio * b.score
    added = ScoredBoxes(frame, b.identity, b.label, xy, score)
    both = rows.append(added)
    return both.select(np.argsort(both.frame, kind="stable"))
