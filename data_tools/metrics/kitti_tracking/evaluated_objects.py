"""The objects that HOTA evaluates on KITTI, by the rules of the benchmark.

Frame by frame, found boxes of the class are matched to true ones of the class and its neighbour (car: van; pedestrian:
sitting person) by the overlap of their image boxes, at least 0.5, with the largest sum. Found boxes are removed

* that match a true one which is of the neighbour class, truncated, or occluded beyond "largely";
* that match nothing and are at most 25 px high in the image, or lie by more than half in a DontCare area.

Then such true boxes are removed. The others are compared by any similarity: "image", the overlap of the image boxes,
is that of the benchmark. Source: preprocessing of the benchmark's evaluation, `trackeval.datasets.Kitti2DBox`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_tools.kitti_objects import KittiObjects, camera_boxes_to_world, has_box
from data_tools.metrics.hota import HotaMetrics, SceneSimilarities, box_similarities, similarity_metrics
from data_tools.metrics.kitti_tracking.class_boxes import (
    UPRIGHT_T_CAMERA,
    KittiTrackingSequence,
    in_ignored_area,
    is_hidden,
    is_small,
    of_class,
)
from saga_fg.numerics.arrays import BoolArray, FloatArray

KittiSimilarity = Literal["image", "bev_iou", "iou_3d"]

_MATCHED = 0.5 - np.finfo(np.float64).eps  # overlap of image boxes


def kitti_hota_metrics(
    sequences: Sequence[KittiTrackingSequence],
    label: str,
    similarity: KittiSimilarity = "image",
    threshold: float = 0.5,
) -> HotaMetrics:
    """Metrics of class `label` (in lower case) over all sequences; CLEAR and Identity count pairs from `threshold` on.

    Objects without a 3D box overlap with nothing in space. Raises `MissingExtraError` without trackeval.
    """
    return similarity_metrics(
        [_scene_similarities(*_evaluated(each, label), similarity) for each in sequences], threshold
    )


def image_overlaps(a: KittiObjects, b: KittiObjects) -> FloatArray:
    """(n, m) intersection over union of the boxes in the image."""
    low = np.maximum(a.bbox[:, None, :2], b.bbox[None, :, :2])
    high = np.minimum(a.bbox[:, None, 2:], b.bbox[None, :, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=2)
    both = _areas(a)[:, None] + _areas(b)[None, :] - shared
    return np.asarray(np.where(both > 0, shared / np.where(both > 0, both, 1.0), 0.0))


def _areas(objects: KittiObjects) -> FloatArray:
    return np.asarray((objects.bbox[:, 2:] - objects.bbox[:, :2]).prod(axis=1))


def _evaluated(sequence: KittiTrackingSequence, label: str) -> tuple[KittiObjects, KittiObjects]:
    """The true and the found objects that are evaluated."""
    truth = of_class(sequence.truth, label, persons=True)
    found = sequence.found.select((np.char.lower(sequence.found.type) == label) & (sequence.found.track_id >= 0))
    exempt = is_hidden(truth) | (np.char.lower(truth.type) != label)
    matched, out = _matches(truth, found, exempt)
    out |= ~matched & (is_small(found) | in_ignored_area(found, sequence.truth))
    return truth.select(~exempt), found.select(~out)


def _matches(truth: KittiObjects, found: KittiObjects, exempt: BoolArray) -> tuple[BoolArray, BoolArray]:
    """(M,) found boxes that match a true one, and those that match an exempt one; exempt (N,)."""
    matched, of_exempt = np.zeros(len(found), dtype=np.bool_), np.zeros(len(found), dtype=np.bool_)
    for frame in np.intersect1d(truth.frame, found.frame).tolist():
        i, j = np.flatnonzero(truth.frame == frame), np.flatnonzero(found.frame == frame)
        overlap = image_overlaps(truth.select(i), found.select(j))
        overlap[overlap < _MATCHED] = 0.0
        rows, columns = linear_sum_assignment(-overlap)
        pairs = overlap[rows, columns] > 0
        matched[j[columns[pairs]]] = True
        of_exempt[j[columns[pairs]]] = exempt[i[rows[pairs]]]
    return matched, of_exempt


def _scene_similarities(truth: KittiObjects, found: KittiObjects, similarity: KittiSimilarity) -> SceneSimilarities:
    """Names and similarities, frame by frame."""
    frames = range(1 + max(int(truth.frame.max(initial=-1)), int(found.frame.max(initial=-1))))
    pairs = [(truth.select(truth.frame == k), found.select(found.frame == k)) for k in frames]
    return SceneSimilarities(
        [true.track_id for true, _ in pairs],
        [here.track_id for _, here in pairs],
        [_similarities(true, here, similarity) for true, here in pairs],
    )


def _similarities(truth: KittiObjects, found: KittiObjects, similarity: KittiSimilarity) -> FloatArray:
    if similarity == "image":
        return image_overlaps(truth, found)
    result = np.zeros((len(truth), len(found)))
    i, j = np.flatnonzero(has_box(truth)), np.flatnonzero(has_box(found))
    a, b = (
        camera_boxes_to_world(each.boxes, np.char.lower(each.type), UPRIGHT_T_CAMERA)
        for each in (truth.select(i), found.select(j))
    )
    result[np.ix_(i, j)] = box_similarities(a, b, similarity)
    return result
