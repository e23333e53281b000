"""The score from which on a page shows tracks: that of the best MOTA where there is ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain

import numpy as np

from data_tools.metrics import SceneBoxes
from pipelines.report.scenes import ReportScene
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.dataset import Annotations

PLAIN = 0.3
"""Where there is no ground truth."""

REACH = 2.0  # m between the centres of a track and its object
Found = tuple[FloatArray, BoolArray]
"""Scores (N,) of boxes, and whether each is of an object that is there."""


def start_thresholds(scenes: Sequence[ReportScene]) -> dict[str, float]:
    """Return the least score to show first, by the tracker's name.

    It maximises true less false boxes over all scenes, which is MOTA but for the switches of identity.
    """
    names = dict.fromkeys(chain.from_iterable(scene.tracks for scene in scenes))
    return {name: _best(_matches(scenes, name)) for name in names}


def _matches(scenes: Iterable[ReportScene], name: str) -> Iterator[Found]:
    for each in scenes:
        if each.scene.ground_truth is not None and name in each.tracks:
            tables = each.tracks[name].by_frame(len(each.scene))
            yield from (_matched(*pair) for pair in zip(each.scene.ground_truth, tables, strict=True))


def _matched(truth: Annotations, found: SceneBoxes) -> Found:
    """Match boxes and objects of a class, the highest score first; boxes at hidden objects don't count."""
    same = found.boxes.label[:, None] == truth.boxes.label
    gap = np.linalg.norm(found.boxes.position[:, None, :2] - truth.boxes.position[:, :2], axis=2)
    gap[~same | (gap > REACH)] = np.inf
    hit, counts = np.zeros(len(found), dtype=np.bool_), np.ones(len(found), dtype=np.bool_)
    for row in np.argsort(-found.score, kind="stable").tolist() if len(truth) else ():
        nearest = int(np.argmin(gap[row]))
        if gap[row, nearest] < np.inf:
            hit[row], counts[row] = True, truth.visible[nearest]
            gap[:, nearest] = np.inf
    return found.score[counts], hit[counts]


def _best(matches: Iterable[Found]) -> float:
    pairs = list(matches)
    score = np.concatenate([np.empty(0), *(pair[0] for pair in pairs)])
    hit = np.concatenate([np.empty(0, dtype=np.bool_), *(pair[1] for pair in pairs)])
    order = np.argsort(-score, kind="stable")
    gain = np.cumsum(np.where(hit[order], 1, -1))
    if not len(gain) or gain.max() <= 0:
        return PLAIN
    last = int(np.flatnonzero(gain == gain.max())[-1])
    return float(np.floor(100 * score[order[last]]) / 100)
