"""Unresolved tracks: new ones over a live track of their class, of whose object they may be a second detection.

Detectors report one object as two or three boxes, above all in crowds and rows of parked ones. Two objects of a class
hardly ever overlap: of labelled cars on nuScenes 0.1 % have a bird's-eye IoU above 0.02 with another one, of
pedestrians 5 % one above 0.05 and 0.1 % one above 0.2. A new track that overlaps a surer one by more than `OVERLAP` is
therefore unresolved, that is tentative. A number of frames is left until it counts as an object of its own: `FRAMES` at
its start, at most `MAX_FRAMES`, and resolved at 0. Each frame changes it:

    the track                                                         surer tracks that it overlaps   frames left
    detected, overlap with every surer track at most `OVERLAP`        any                             - 1
    detected, largest overlap between `OVERLAP` and `MAX_OVERLAP`    one of them is detected         - 1
    detected, otherwise                                               any                             unchanged
    missed                                                            one of them is detected         + `ALONE`
    missed                                                            none is detected                unchanged

Until it is resolved its detections don't raise its existence, and while it overlaps a confirmed track it is matched to
what the other tracks leave, so that it can't take their detections.

A surer track is one of at least its existence that is not unresolved itself. Boxes of unknown size or heading overlap
nothing, and where the positions of a sensor are uncertain by most of the box's width, overlap tells nothing.
"""

import numpy as np

from saga_fg.numerics import BoolArray, FloatArray, IntArray, Matching
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types import Boxes, paired_bev_iou, touching_pairs

OVERLAP = 0.05  # bird's-eye IoU above which a new track is unresolved
MAX_OVERLAP = 0.2  # largest one of two objects
PRECISE = 0.75  # standard deviation of a position, in widths of its box, up to which overlap tells anything
FRAMES = 2.0  # frames at the start: a box clear of the other three times in all is hardly a second one by chance
ALONE = 2.0  # frames for a miss: an object is missed less often than a second box, so a miss tells more
MAX_FRAMES = 6.0  # frames at most: who walked off counts after so many, whatever was before


def unresolved_frames(
    state: TrackerState, matching: Matching, boxes: Boxes, probability: FloatArray, R: FloatArray
) -> FloatArray:
    """(k,) frames that it takes to resolve new tracks, 0 for resolved ones.

    boxes (k), world, of their detections, which have a probability (k,) and positions of covariance R (k, 2, 2), m^2.
    Only surer tracks that were detected in the frame count: a box over a coasting track may be that track's object. Of
    new tracks over each other the more probable one is surer.
    """
    rank = np.empty(len(boxes))
    rank[np.argsort(-probability, kind="stable")] = np.arange(len(boxes))
    detected, now = matching.track, state.kinematics()
    live = state.boxes(now.position, now.velocity).select(detected)
    others = Boxes.concatenate([boxes, live])
    row, column = touching_pairs(boxes, others)
    other = (column != row).nonzero()[0]  # of new ones, all touch themselves
    row, column = row[other], column[other]
    is_new = column < len(boxes)
    surer = np.empty(len(row), dtype=bool)
    surer[is_new] = rank[column[is_new]] < rank[row[is_new]]
    track = detected[column[~is_new] - len(boxes)]
    surer[~is_new] = (state.table.unresolved[track] == 0) & (state.table.existence[track] >= probability[row[~is_new]])
    row, column = row[surer], column[surer]
    covered = _largest(_overlaps(state, boxes, others, row, column), row, len(boxes)) > OVERLAP
    precise = np.sqrt(np.linalg.eigvalsh(R)[:, -1]) < PRECISE * boxes.size[:, :2].min(axis=1)
    return np.where(covered & precise, FRAMES, 0.0)


def resolve_tracks(state: TrackerState, matching: Matching) -> None:
    """Count the evidence of a frame that unresolved tracks are objects of their own."""
    table = state.table
    detected = np.zeros(len(table), dtype=bool)
    detected[matching.track] = True
    rows = (table.unresolved > 0).nonzero()[0]
    if len(rows) == 0:
        return
    now = state.kinematics()
    boxes = state.boxes(now.position, now.velocity)
    sure = ((table.unresolved == 0) & (table.existence >= table.existence[rows].min())).nonzero()[0]
    mine, theirs = boxes.select(rows), boxes.select(sure)
    row, column = touching_pairs(mine, theirs)
    surer = table.existence[sure[column]] >= table.existence[rows[row]]
    row, column = row[surer], column[surer]
    overlap = _overlaps(state, mine, theirs, row, column)
    most, seen, other = _largest(overlap, row, len(rows)), detected[rows], np.zeros(len(rows), dtype=bool)
    other[row[(overlap > OVERLAP) & detected[sure[column]]]] = True
    apart = (most <= OVERLAP) | (other & (most <= MAX_OVERLAP))
    step = np.where(seen, -1.0 * apart, ALONE * other)
    table.unresolved[rows] = np.clip(table.unresolved[rows] + step, 0.0, MAX_FRAMES)


def over_confirmed(state: TrackerState, predicted: Boxes) -> BoolArray:
    """(n,) unresolved tracks whose predicted box overlaps that of a confirmed track; predicted (n), world."""
    table = state.table
    rows = (table.unresolved > 0).nonzero()[0]
    result = np.zeros(len(table), dtype=bool)
    if len(rows):
        sure = (table.confirmed & (table.unresolved == 0)).nonzero()[0]
        mine, theirs = predicted.select(rows), predicted.select(sure)
        row, column = touching_pairs(mine, theirs)
        result[rows] = _largest(_overlaps(state, mine, theirs, row, column), row, len(rows)) > OVERLAP
    return result


def _overlaps(state: TrackerState, boxes: Boxes, others: Boxes, row: IntArray, column: IntArray) -> FloatArray:
    """(K,) bird's-eye IoU of boxes[row] with others[column] of their class or group, 0 with those of other classes."""
    overlap = np.zeros(len(row))
    alike = state.confused.alike(boxes.label[row], others.label[column]).nonzero()[0]
    found = paired_bev_iou(boxes.select(row[alike]), others.select(column[alike]))
    overlap[alike] = np.where(np.isnan(found), 0.0, found)
    return overlap


def _largest(overlap: FloatArray, row: IntArray, count: int) -> FloatArray:
    """(count,) largest of the overlaps (K,) of each row, 0 where there is none."""
    largest = np.zeros(count)
    np.maximum.at(largest, row, overlap)
    return largest
