"""Objects as KITTI writes them, their boxes in the world, and those that the benchmark evaluates of a class.

KITTI gives a box by the centre of its *bottom* face in the rectified camera frame (x right, y down, z ahead), its
height, width and length, and `rotation_y`, the heading about the camera's y axis: 0 along x, growing from z to -x, so
that the heading points along (cos r, 0, -sin r). Upright in the camera frame, it leans in the world by the camera's
tilt; its world box stands on the same centre with the heading's horizontal direction:

    centre = world_T_camera (location - (0, h/2, 0)),    yaw = direction of M (cos r, sin r),

M being the horizontal part of the map of the heading. M is invertible, so the way back is exact.

A class is scored together with its neighbour (car: van; pedestrian: person sitting), so that confusing the two is not
an error. True boxes count unless they are of the neighbour class, truncated, or occluded beyond "largely"; those may be
matched but count neither as found nor as missed. Unmatched found boxes are not false positives if they are of the
neighbour class, at most 25 px high in the image, or lie by more than half in a DontCare area.

The labels of the benchmark call sitting persons `Person`. The evaluation of Weng et al. reads `Person_sitting` only: a
box found at a `Person` is a false positive. HOTA of the benchmark has them as neighbours of pedestrians.

Source: Geiger et al., Are we ready for autonomous driving?, CVPR 2012, and the benchmark's evaluation rules,
https://www.cvlibs.net/datasets/kitti/eval_tracking.php.

The objects that HOTA evaluates on KITTI, by the rules of the benchmark.

Frame by frame, found boxes of the class are matched to true ones of the class and its neighbour (car: van; pedestrian:
sitting person) by the overlap of their image boxes, at least 0.5, with the largest sum. Found boxes are removed

* that match a true one which is of the neighbour class, truncated, or occluded beyond "largely";
* that match nothing and are at most 25 px high in the image, or lie by more than half in a DontCare area.

Then such true boxes are removed. The others are compared by any similarity: "image", the overlap of the image boxes,
is that of the benchmark. Source: preprocessing of the benchmark's evaluation, `trackeval.datasets.Kitti2DBox`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_tools.metrics.hota import HotaMetrics, SceneSimilarities, box_similarities, image_overlaps, similarity_metrics
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, inverse_transform, wrap_angle
from saga_fg.types import Boxes

_NO_BOX = -999.0  # positions below: the object has no 3D box


@dataclass(frozen=True, eq=False)
class CameraBoxes(Columns):
    """N boxes in the rectified camera frame.

    size        (N, 3)  height, width, length, m (KITTI's order)
    location    (N, 3)  centre of the bottom face, m
    rotation_y  (N,)    rad
    """

    size: FloatArray
    location: FloatArray
    rotation_y: FloatArray

    def corners(self) -> FloatArray:
        """Corners (N, 8, 3) in the camera frame: the four of the bottom in turn, then the four above them."""
        height, width, length = self.size.T
        along = length[:, None] / 2 * np.array([1, 1, -1, -1, 1, 1, -1, -1])
        across = width[:, None] / 2 * np.array([1, -1, -1, 1, 1, -1, -1, 1])
        down = -height[:, None] * np.array([0, 0, 0, 0, 1, 1, 1, 1])
        c, s = np.cos(self.rotation_y)[:, None], np.sin(self.rotation_y)[:, None]
        return np.asarray(
            self.location[:, None, :] + np.stack([c * along + s * across, down, -s * along + c * across], axis=-1)
        )


@dataclass(frozen=True, eq=False)
class KittiObjects(Columns):
    """Objects of a sequence, N lines as columns, in the order of the file.

    frame (N,), track_id (N,), type (N,) as in the file, truncated (N,), occluded (N,), alpha (N,), bbox (N, 4) left,
    top, right, bottom, boxes (N), score (N,) NaN where there is none.
    """

    frame: IntArray
    track_id: IntArray
    type: StrArray
    truncated: FloatArray
    occluded: FloatArray
    alpha: FloatArray
    bbox: FloatArray
    boxes: CameraBoxes
    score: FloatArray


def has_box(objects: KittiObjects) -> BoolArray:
    """Mask (N,) of the objects with a 3D box; `DontCare` regions and results of image trackers have none."""
    return np.asarray((objects.type != "DontCare") & (objects.boxes.location > _NO_BOX).all(axis=1))


def camera_boxes_to_world(boxes: CameraBoxes, label: StrArray | Sequence[str], world_T_camera: FloatArray) -> Boxes:
    """The boxes in world coordinates; `world_T_camera` is (4, 4), or (N, 4, 4) with a pose for every box.

    Their velocities are unknown. Raises `InputError` for boxes that are not finite or have no positive size.
    """
    n = len(boxes)
    T = np.broadcast_to(world_T_camera, (n, 4, 4))
    height, width, length = boxes.size.T
    centre = boxes.location - np.stack([np.zeros(n), height / 2, np.zeros(n)], axis=-1)
    heading = _horizontal_map(T) @ np.stack([np.cos(boxes.rotation_y), np.sin(boxes.rotation_y)], axis=-1)[..., None]
    return Boxes.of(
        label,
        (T[:, :3, :3] @ centre[..., None])[..., 0] + T[:, :3, 3],
        np.stack([length, width, height], axis=-1),
        np.arctan2(heading[:, 1, 0], heading[:, 0, 0]),
    )


def world_boxes_to_camera(boxes: Boxes, world_T_camera: FloatArray) -> CameraBoxes:
    """The way back; `world_T_camera` is (4, 4), or (N, 4, 4) with a pose for every box."""
    n = len(boxes)
    T = np.broadcast_to(world_T_camera, (n, 4, 4))
    camera_T_world = inverse_transform(T)
    centre = (camera_T_world[:, :3, :3] @ boxes.position[..., None])[..., 0] + camera_T_world[:, :3, 3]
    length, width, height = boxes.size.T
    direction = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=-1)[..., None]
    turned = np.linalg.solve(_horizontal_map(T), direction)
    return CameraBoxes(
        size=np.stack([height, width, length], axis=-1),
        location=centre + np.stack([np.zeros(n), height / 2, np.zeros(n)], axis=-1),
        rotation_y=wrap_angle(np.arctan2(turned[:, 1, 0], turned[:, 0, 0])),
    )


def _horizontal_map(world_T_camera: FloatArray) -> FloatArray:
    """M (N, 2, 2): (cos r, sin r) to the horizontal part of the heading in the world."""
    return np.stack([world_T_camera[:, :2, 0], -world_T_camera[:, :2, 2]], axis=-1)


NEIGHBOURS = {"car": ("van",), "pedestrian": ("person_sitting",)}
PERSON = "person"
MIN_HEIGHT = 25.0  # px
MAX_OCCLUSION = 2
MAX_TRUNCATION = 0
NO_SCORE = -1.0  # of results that have none

# The camera's axes turned upright, x ahead, y left, z up: boxes keep their overlaps to the last digit.
UPRIGHT_T_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class KittiTrackingSequence:
    """One sequence to score: the labels, DontCare rows included, and the tracker's output."""

    truth: KittiObjects
    found: KittiObjects


@dataclass(frozen=True, eq=False)
class ClassBoxes(Columns):
    """N rows of one class (and its neighbour) over all sequences, in order of frame key.

    frame_key  (N,) number of sequence and frame, the same for true and found rows
    identity   (N,) number of the object or track, from 0, over all sequences
    exempt     (N,) true boxes that are no misses, found boxes that are no false positives
    boxes      in an upright frame
    score      (N,) of found boxes
    """

    frame_key: IntArray
    identity: IntArray
    exempt: BoolArray
    boxes: Boxes
    score: FloatArray


def true_boxes(sequences: Sequence[KittiTrackingSequence], label: str) -> ClassBoxes:
    """The true boxes of a class (name in lower case)."""
    kept = [of_class(sequence.truth, label) for sequence in sequences]
    exempt = [is_hidden(rows) | _neighbour(rows, label) for rows in kept]
    return _joined(kept, exempt, _frames(sequences))


def found_boxes(sequences: Sequence[KittiTrackingSequence], label: str) -> ClassBoxes:
    """The found boxes of a class (name in lower case)."""
    kept = [of_class(sequence.found, label) for sequence in sequences]
    exempt = [
        is_small(rows) | _neighbour(rows, label) | in_ignored_area(rows, sequence.truth)
        for rows, sequence in zip(kept, sequences, strict=True)
    ]
    return _joined(kept, exempt, _frames(sequences))


def joined_ranges(first: IntArray, last: IntArray) -> tuple[IntArray, IntArray]:
    """All (n, k) with first[n] <= k < last[n], as two arrays."""
    count = last - first
    n = np.repeat(np.arange(len(count)), count)
    return n, np.arange(len(n)) - np.repeat(np.cumsum(count) - count - first, count)


def of_class(objects: KittiObjects, label: str, persons: bool = False) -> KittiObjects:
    """The objects of a class and its neighbours. persons: whether `Person` is a neighbour of pedestrians."""
    asked = (label, *NEIGHBOURS.get(label, ()), *([PERSON] if persons and label == "pedestrian" else []))
    return objects.select(np.isin(np.char.lower(objects.type), asked) & (objects.track_id != -1))


def _neighbour(objects: KittiObjects, label: str) -> BoolArray:
    return np.asarray(np.char.lower(objects.type) != label)


def is_hidden(objects: KittiObjects) -> BoolArray:
    """(N,) True for objects that are truncated, or occluded beyond "largely"."""
    return np.asarray(
        (np.trunc(objects.truncated) > MAX_TRUNCATION) | (np.trunc(objects.occluded) > MAX_OCCLUSION), dtype=np.bool_
    )


def is_small(objects: KittiObjects) -> BoolArray:
    """(N,) True for objects too low in the image to be evaluated."""
    return np.asarray(np.abs(objects.bbox[:, 1] - objects.bbox[:, 3]) <= MIN_HEIGHT, dtype=np.bool_)


def _frames(sequences: Sequence[KittiTrackingSequence]) -> int:
    """Number of frames: one more than the highest frame number."""
    return 1 + max((int(o.frame.max(initial=0)) for s in sequences for o in (s.truth, s.found)), default=0)


def _joined(parts: Sequence[KittiObjects], exempt: Sequence[BoolArray], frames: int) -> ClassBoxes:
    sequence = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    empty = np.empty(0, dtype=np.int64)
    frame_key = sequence * frames + np.concatenate([empty, *(part.frame for part in parts)])
    owner = np.stack([sequence, np.concatenate([empty, *(part.track_id for part in parts)])], axis=1)
    _, identity = np.unique(owner, axis=0, return_inverse=True)
    score = np.concatenate([np.empty(0), *(part.score for part in parts)])
    boxes = Boxes.concatenate([camera_boxes_to_world(part.boxes, part.type, UPRIGHT_T_CAMERA) for part in parts])
    exempt_rows = np.concatenate([np.empty(0, dtype=np.bool_), *exempt])
    joined = ClassBoxes(frame_key, identity.reshape(-1), exempt_rows, boxes, np.nan_to_num(score, nan=NO_SCORE))
    return joined.select(np.argsort(frame_key, kind="stable"))


def in_ignored_area(rows: KittiObjects, truth: KittiObjects) -> BoolArray:
    """(N,) True for boxes with more than half of their image box in one DontCare area of their frame."""
    areas = truth.select(np.char.lower(truth.type) == "dontcare")
    order = np.argsort(areas.frame, kind="stable")
    frame = areas.frame[order]
    first, last = np.searchsorted(frame, rows.frame), np.searchsorted(frame, rows.frame, side="right")
    row, other = joined_ranges(first, last)
    a, b = rows.bbox[row], areas.bbox[order][other]
    width = np.minimum(a[:, 2], b[:, 2]) - np.maximum(a[:, 0], b[:, 0])
    height = np.minimum(a[:, 3], b[:, 3]) - np.maximum(a[:, 1], b[:, 1])
    own = (a[:, 2] - a[:, 0]) * (a[:, 3] - a[:, 1])
    covered = (width > 0) & (height > 0) & (width * height > 0.5 * own)
    result = np.zeros(len(rows), dtype=np.bool_)
    result[row[covered]] = True
    return result


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
        overlap = image_overlaps(truth.bbox[i], found.bbox[j])
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
        return image_overlaps(truth.bbox, found.bbox)
    result = np.zeros((len(truth), len(found)))
    i, j = np.flatnonzero(has_box(truth)), np.flatnonzero(has_box(found))
    a, b = (
        camera_boxes_to_world(each.boxes, np.char.lower(each.type), UPRIGHT_T_CAMERA)
        for each in (truth.select(i), found.select(j))
    )
    result[np.ix_(i, j)] = box_similarities(a, b, similarity)
    return result
