"""The recall sweep of the nuScenes tracking metrics, for one class: boxes, matches, coverage, figures.

The scored boxes: filtered as in the official evaluation, with gaps within tracks interpolated.

Filter (`nuscenes/eval/common/loaders.py`, `filter_eval_boxes`): true boxes and tracks alike are kept within their
class's distance from the vehicle, in the horizontal plane; bicycles and motorcycles whose centre lies in a box of
category `static_object.bicycle_rack` are dropped. True boxes without a LiDAR or radar point are dropped.

Score: each box gets the mean score of its track over the kept boxes.

Gaps (`nuscenes/eval/tracking/loaders.py`, `interpolate_tracks`): where a track skips frames, boxes are interpolated,

    x(t) = (1 - r) x_left + r x_right        r = (t_right - t) / (t_right - t_left)

The weights are reversed (r is near 1 next to the left box) like those of the official evaluation, so that metrics are
comparable.

CLEAR matching at many score thresholds at once.

In each frame and threshold, tracks below the threshold are absent, and (as in py-motmetrics, whose accumulator the
official evaluation uses)

1. an object, in order of the table, keeps the track it was matched to last, if that is within the gate;
2. the rest is assigned by the Hungarian method, as many pairs as possible first, then the least sum of distances;
   a pair whose object was last matched to another track is an identity switch.

Everything but time is vectorised: all scenes, classes and thresholds advance by one frame together.

Coverage of each object over time, at all thresholds at once: tracked share, fragments, delays and gaps.

    ratio   frames with a track / frames of the object       mostly tracked: >= 0.8, mostly lost: < 0.2
    FRAG    changes from tracked to missed between the first and the last tracked frame
    TID     time from the first frame to the first tracked one
    LGD     longest run of missed frames, before the first and after the last tracked one included

TID and LGD are means over the objects that are tracked at all, NaN if there is none; a frame counts as one sample
period. Source: nuScenes tracking task, https://www.nuscenes.org/tracking.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from data_tools.metrics.scene_boxes import Candidates, SceneBoxes, optimal_pairs, track_means
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray
from saga_fg.types import Boxes

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
    score = track_means(table.score[rows], identity)
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


@dataclass(frozen=True, eq=False)
class Rows:
    """`ScoredBoxes` of all scenes, in order of frame, then scene; identities are unique over all scenes."""

    scene: IntArray
    boxes: ScoredBoxes
    identities: int

    @classmethod
    def from_scenes(cls, scenes: Sequence[ScoredBoxes]) -> Rows:
        counts = [int(s.identity.max(initial=-1)) + 1 for s in scenes]
        offset = np.cumsum([0, *counts])
        joined = ScoredBoxes.concatenate(
            [replace(s, identity=s.identity + first) for s, first in zip(scenes, offset, strict=False)]
        )
        scene = np.repeat(np.arange(len(scenes)), [len(s.frame) for s in scenes])
        order = np.lexsort((scene, joined.frame))
        return cls(scene[order], joined.select(order), int(offset[-1]))


@dataclass(frozen=True, eq=False)
class RowPairs:
    """P pairs of a true row and a found row of the same scene, frame and class, in order of found, then true row."""

    true: IntArray
    found: IntArray
    distance: FloatArray


@dataclass(frozen=True, eq=False)
class Sweep:
    """The matching of N true rows at T thresholds.

    partner   (N, T) found row, -1 where missed
    switched  (N, T) identity switches
    distance  (classes, T) sum of the distances of all pairs, m
    """

    partner: IntArray
    switched: BoolArray
    distance: FloatArray


def candidate_pairs(true: Rows, found: Rows, gate: float) -> RowPairs:
    """All pairs of one class nearer than `gate` (m).

    Distances come from |a|^2 - 2 a.b + |b|^2, as in the official evaluation: far from the origin this leaves a few
    1e-5 m in a distance near zero, in the official figures as in these (there it also depends on the processor).
    """
    scenes = int(max(true.scene.max(initial=0), found.scene.max(initial=0))) + 1
    true_frame = true.boxes.frame * scenes + true.scene
    found_frame = found.boxes.frame * scenes + found.scene
    frames = np.intersect1d(true_frame, found_frame)
    t0, t1 = np.searchsorted(true_frame, frames), np.searchsorted(true_frame, frames, side="right")
    f0, f1 = np.searchsorted(found_frame, frames), np.searchsorted(found_frame, frames, side="right")
    parts = [(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))]
    for a0, a1, b0, b1 in zip(t0.tolist(), t1.tolist(), f0.tolist(), f1.tolist(), strict=True):
        a, b = true.boxes.xy[a0:a1], found.boxes.xy[b0:b1]
        square = -2.0 * (a[:, None, 0] * b[None, :, 0] + a[:, None, 1] * b[None, :, 1])
        square += (a[:, 0] ** 2 + a[:, 1] ** 2)[:, None]
        square += (b[:, 0] ** 2 + b[:, 1] ** 2)[None, :]
        distance = np.sqrt(np.maximum(square, 0.0))
        near = (distance < gate) & (true.boxes.label[a0:a1, None] == found.boxes.label[None, b0:b1])
        column, row = np.nonzero(near.T)
        parts.append((row + a0, column + b0, distance[row, column]))
    return RowPairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def sweep(true: Rows, found: Rows, pairs: RowPairs, thresholds: FloatArray) -> Sweep:
    """Match at `thresholds` (classes, T) of the track score, NaN where a class has no further threshold."""
    classes, T = thresholds.shape
    partner = np.full((len(true.scene), T), -1, dtype=np.int64)
    switched = np.zeros((len(true.scene), T), dtype=np.bool_)
    total = np.zeros(classes * T)
    last = np.full((true.identities, T), -1, dtype=np.int64)
    label, identity = true.boxes.label, true.boxes.identity
    track, score = found.boxes.identity, found.boxes.score
    bounds = np.searchsorted(true.boxes.frame[pairs.true], np.arange(true.boxes.frame.max(initial=-1) + 2))
    for start, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        if start == stop:
            continue
        here = RowPairs(pairs.true[start:stop], pairs.found[start:stop], pairs.distance[start:stop])
        present = score[here.found][:, None] >= thresholds[label[here.true]]
        remembered = last[identity[here.true]]
        kept = _first_of_each(present & (remembered == track[here.found][:, None]), here.found)
        free = present & ~_used(kept, here.true) & ~_used(kept, here.found)
        group = true.scene[here.true] * classes + label[here.true]
        pair, at = np.nonzero(optimal_pairs(Candidates(here.true, here.found, here.distance, group), free))
        rows = here.true[pair]
        switched[rows, at] = remembered[pair, at] >= 0
        old_pair, old_at = np.nonzero(kept)
        pair, at = np.concatenate([pair, old_pair]), np.concatenate([at, old_at])
        rows = here.true[pair]
        partner[rows, at] = here.found[pair]
        last[identity[rows], at] = track[here.found[pair]]
        total += np.bincount(label[rows] * T + at, weights=here.distance[pair], minlength=classes * T)
    return Sweep(partner, switched, total.reshape(classes, T))


def _first_of_each(previous: BoolArray, found: IntArray) -> BoolArray:
    """The first previous pair (P, T) of each found row (P,); the rows are sorted."""
    start = np.flatnonzero(np.diff(found, prepend=-1))
    count = np.cumsum(previous, axis=0, dtype=np.int32)
    before = (count[start] - previous[start])[np.repeat(np.arange(len(start)), np.diff(start, append=len(found)))]
    return np.asarray(previous & (count - before == 1))


def _used(kept: BoolArray, row: IntArray) -> BoolArray:
    """(P, T): True if the pair's row is part of a kept pair."""
    first = int(row.min())
    used = np.zeros((int(row.max()) - first + 1, kept.shape[1]), dtype=np.bool_)
    pair, at = np.nonzero(kept)
    used[row[pair] - first, at] = True
    return np.asarray(used[row - first])


def track_coverage(tracked: BoolArray, identity: IntArray, period: float) -> dict[str, FloatArray]:
    """Coverage of the objects of one class at T thresholds, each (T,), see `NuScenesClassMetrics`.

    tracked (N, T), N > 0, its rows sorted by `identity` (N,), then time; period in s
    """
    start = np.flatnonzero(np.diff(identity, prepend=identity[0] - 1))
    length = np.diff(start, append=len(identity))
    owner = np.repeat(np.arange(len(start)), length)
    row = np.arange(len(identity))[:, None]
    ratio = np.add.reduceat(tracked, start, axis=0, dtype=np.int64) / length[:, None]
    ever = ratio > 0
    first = np.minimum.reduceat(np.where(tracked, row, len(identity)), start, axis=0)
    last = np.maximum.reduceat(np.where(tracked, row, -1), start, axis=0)
    dropped = np.zeros_like(tracked)
    dropped[1:] = tracked[:-1] & ~tracked[1:] & (owner[1:] == owner[:-1])[:, None] & (row[1:] < last[owner[1:]])
    begins = np.zeros((len(identity), 1), dtype=np.bool_)
    begins[start] = True
    # The run of misses that ends at a row reaches back to the last tracked row, or to before the object's first.
    anchor = np.maximum.accumulate(np.where(tracked, row, np.where(begins, row - 1, -1)), axis=0)
    longest = np.maximum.reduceat(row - anchor, start, axis=0)
    objects = ever.sum(axis=0)
    with np.errstate(invalid="ignore"):
        initialisation = period * np.where(ever, first - start[:, None], 0).sum(axis=0) / objects
        longest_gap = period * np.where(ever, longest, 0).sum(axis=0) / objects
    return {
        "mt": (ratio >= 0.8).sum(axis=0),
        "ml": (ratio < 0.2).sum(axis=0),
        "frag": dropped.sum(axis=0),
        "tid": initialisation,
        "lgd": longest_gap,
    }


SUMMED = frozenset({"gt", "tp", "fp", "fn", "ids", "frag", "mt", "ml"})


@dataclass(frozen=True)
class NuScenesClassMetrics:
    """Metrics of one class, at the threshold with the highest MOTA (amota and amotp: over all); NaN where undefined.

    amota   mean over the sweep of MOTAR = max(0, 1 - (ids + fp + fn - (1 - r) gt) / (r gt)), r = tp / gt
    amotp   mean over the sweep of MOTP, m
    mota    max(0, 1 - (ids + fp + fn) / gt);  motp  mean distance of the pairs, m;  recall  (tp + ids) / gt
    gt      true boxes, including those interpolated in gaps
    tp      matches that are no switches;  fp, fn  false and missed boxes;  ids  identity switches;  frag  fragments
    mt, ml  objects mostly tracked, mostly lost;  faf  false alarms per 100 frames
    tid, lgd  mean time to the first match, mean longest gap, s
    """

    amota: float
    amotp: float
    recall: float
    motar: float
    gt: float
    mota: float
    motp: float
    mt: float
    ml: float
    faf: float
    tp: float
    fp: float
    fn: float
    ids: float
    frag: float
    tid: float
    lgd: float

    @classmethod
    def undefined(cls) -> Self:
        """A class without any true box."""
        return cls(**{field.name: float("nan") for field in fields(cls)})

    @classmethod
    def over_classes(cls, classes: Iterable[NuScenesClassMetrics]) -> Self:
        """Sums of the counts, means of the rest over the classes where they are defined (official, but for gt: summed,
        where the official evaluation prints the mean)."""
        parts = list(classes)
        result = {}
        for field in fields(cls):
            values = np.array([getattr(part, field.name) for part in parts])
            known = values[~np.isnan(values)]
            if field.name in SUMMED:
                result[field.name] = float(known.sum())
            else:
                result[field.name] = float(known.mean()) if len(known) else float("nan")
        return cls(**result)


@dataclass(frozen=True, eq=False)
class RecallCurves:
    """One class over the sweep, each (T,), from the highest hypothetical recall to the lowest; NaN where not reached.

    score is the threshold that the recall asks for; the others are as in `NuScenesClassMetrics`.
    """

    hypothetical_recall: FloatArray
    score: FloatArray
    recall: FloatArray
    motar: FloatArray
    mota: FloatArray
    motp: FloatArray
    fp: FloatArray
    fn: FloatArray
    ids: FloatArray
