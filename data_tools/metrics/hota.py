"""HOTA, CLEAR and Identity metrics of box tracks, computed by `trackeval` (extra `[eval]`) over our own similarities.

    HOTA(a) = sqrt(DetA(a) AssA(a))   a: similarity from which a pair counts; HOTA: mean over a = 0.05, 0.10, ..., 0.95
    DetA    = TP / (TP + FN + FP)
    AssA    = mean over the pairs of TPA / (TPA + FNA + FPA), the agreement over time of the two tracks of a pair
    LocA    = mean similarity of the pairs
    IDF1    = 2 IDTP / (2 IDTP + IDFN + IDFP), pairs under the best one-to-one mapping of whole tracks

Similarities, all in [0, 1]: "centre", max(0, 1 - d / reach) of the horizontal distance d of the centres; "bev_iou" and
"iou_3d", the overlap of footprints and of volumes.

Sources: Luiten et al., HOTA: A Higher Order Metric for Evaluating Multi-object Tracking, IJCV 2021; Ristani et al.,
Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking, ECCV Workshops 2016 (Identity).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.errors import InputError, require_extra
from saga_fg.numerics import FloatArray, IntArray, StrArray
from saga_fg.types import Boxes, bev_iou, iou_3d

Similarity = Literal["centre", "bev_iou", "iou_3d"]


@dataclass(frozen=True, eq=False)
class HotaMetrics:
    """Figures of one class over all scenes, shares in [0, 1] (MOTA may be negative), and counts.

    hota, deta, assa, loca are means over `alpha` (19,), the values at each of which are in `hota_at`. CLEAR (mota,
    motp: mean similarity, fp, fn, ids, frag) and Identity (idf1, idp, idr) count pairs from the threshold on.
    """

    hota: float
    deta: float
    assa: float
    loca: float
    mota: float
    motp: float
    fp: int
    fn: int
    ids: int
    frag: int
    idf1: float
    idp: float
    idr: float
    alpha: FloatArray
    hota_at: FloatArray


@dataclass(frozen=True, eq=False)
class SceneSimilarities:
    """Input of the metrics for one scene: names of true and found objects in each frame, and (n, m) similarities."""

    true: Sequence[IntArray | StrArray]
    found: Sequence[IntArray | StrArray]
    similarities: Sequence[FloatArray]

    def sequence(self) -> dict[str, Any]:
        """The input of `trackeval`, with names as numbers from 0."""
        true, found = _numbered(self.true), _numbered(self.found)
        return {
            "num_timesteps": len(true),
            "num_gt_ids": 1 + max((int(ids.max(initial=-1)) for ids in true), default=-1),
            "num_tracker_ids": 1 + max((int(ids.max(initial=-1)) for ids in found), default=-1),
            "num_gt_dets": sum(map(len, true)),
            "num_tracker_dets": sum(map(len, found)),
            "gt_ids": true,
            "tracker_ids": found,
            "similarity_scores": list(self.similarities),
        }


def hota_metrics(
    scenes: Sequence[tuple[SceneBoxes, SceneBoxes]],
    label: str,
    similarity: Similarity = "centre",
    reach: float = 4.0,
    threshold: float = 0.5,
) -> HotaMetrics:
    """Compare the tracks of class `label` with the truth: (truth, found) of each scene.

    reach      distance of centres at which their similarity is 0, m
    threshold  similarity from which CLEAR and Identity count a pair; with a reach of 4 m, 0.5 stands for 2 m

    Raises `MissingExtraError` without trackeval, `InputError` for an unknown similarity or no scene.
    """
    if similarity not in get_args(Similarity):
        raise InputError(f"similarity: expected one of {', '.join(get_args(Similarity))}, got {similarity!r}")
    if not scenes:
        raise InputError("scenes: expected at least one scene")
    return similarity_metrics([_similarities(*scene, label, similarity, reach) for scene in scenes], threshold)


def similarity_metrics(scenes: Sequence[SceneSimilarities], threshold: float = 0.5) -> HotaMetrics:
    """The figures of scenes whose similarities are known. Raises `MissingExtraError` without trackeval."""
    require_extra("eval", "HOTA", "trackeval")
    from trackeval import metrics

    options = {"THRESHOLD": threshold, "PRINT_CONFIG": False}
    hota, clear, identity = metrics.HOTA(), metrics.CLEAR(options), metrics.Identity(options)
    sequences = [scene.sequence() for scene in scenes]
    h, c, i = (
        metric.combine_sequences({str(n): metric.eval_sequence(data) for n, data in enumerate(sequences)})
        for metric in (hota, clear, identity)
    )
    return HotaMetrics(
        hota=float(np.mean(h["HOTA"])),
        deta=float(np.mean(h["DetA"])),
        assa=float(np.mean(h["AssA"])),
        loca=float(np.mean(h["LocA"])),
        mota=float(c["MOTA"]),
        motp=float(c["MOTP"]),
        fp=int(c["CLR_FP"]),
        fn=int(c["CLR_FN"]),
        ids=int(c["IDSW"]),
        frag=int(c["Frag"]),
        idf1=float(i["IDF1"]),
        idp=float(i["IDP"]),
        idr=float(i["IDR"]),
        alpha=hota.array_labels,
        hota_at=h["HOTA"],
    )


def _numbered(names: Sequence[IntArray | StrArray]) -> list[IntArray]:
    """The names in each frame as numbers from 0 without gaps."""
    if not names:
        return []
    numbers = np.unique(np.concatenate(list(names)), return_inverse=True)[1].reshape(-1)
    return np.split(numbers.astype(np.int64), np.cumsum([len(each) for each in names])[:-1])


def image_overlaps(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, m) intersection over union of image boxes (n, 4) and (m, 4): left, top, right, bottom."""
    low, high = np.maximum(a[:, None, :2], b[:, :2]), np.minimum(a[:, None, 2:], b[:, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=2)
    both = (a[:, 2:] - a[:, :2]).prod(axis=1)[:, None] + (b[:, 2:] - b[:, :2]).prod(axis=1) - shared
    return np.asarray(np.where(both > 0, shared / np.where(both > 0, both, 1.0), 0.0))


def _similarities(
    truth: SceneBoxes, found: SceneBoxes, label: str, similarity: Similarity, reach: float
) -> SceneSimilarities:
    """Names and similarities of the objects of a class in one scene."""
    frames = 1 + int(max(truth.frame.max(initial=-1), found.frame.max(initial=-1)))
    true_rows, found_rows = (_rows_of_class(table, label, frames) for table in (truth, found))
    return SceneSimilarities(
        [truth.id[rows] for rows in true_rows],
        [found.id[rows] for rows in found_rows],
        [
            box_similarities(truth.boxes.select(a), found.boxes.select(b), similarity, reach)
            for a, b in zip(true_rows, found_rows, strict=True)
        ],
    )


def _rows_of_class(table: SceneBoxes, label: str, frames: int) -> list[IntArray]:
    """Rows of a class in each frame."""
    rows = np.flatnonzero(table.boxes.label == label)
    return np.split(rows, np.searchsorted(table.frame[rows], np.arange(1, frames)))[:frames]


def box_similarities(truth: Boxes, found: Boxes, similarity: Similarity, reach: float = 4.0) -> FloatArray:
    """(n, m) of all pairs; see the module."""
    if similarity == "bev_iou":
        return bev_iou(truth, found)
    if similarity == "iou_3d":
        return iou_3d(truth, found)
    offset = truth.position[:, None, :2] - found.position[None, :, :2]
    return np.asarray(np.maximum(0.0, 1.0 - np.hypot(offset[..., 0], offset[..., 1]) / reach))
