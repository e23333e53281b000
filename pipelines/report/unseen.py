"""Time since each track's last detection, computed for results that do not hold it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_tools.metrics import SceneBoxes
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.boxes import Boxes

REACH = 2.0  # m between the centres of a track and a detection of its class


def unseen_for(table: SceneBoxes, times: FloatArray, detections: Sequence[Boxes]) -> FloatArray:
    """Return (N,) s since a detection of the class was near a track; 0 at its first box.

    times (K,), s, and detections of the K moments
    """
    last: dict[str, float] = {}
    unseen = [np.empty(0)]
    for time, found, boxes in zip(times.tolist(), table.by_frame(len(times)), detections, strict=True):
        gap = np.linalg.norm(found.boxes.position[:, None, :2] - boxes.position[:, :2], axis=2)
        near = ((gap < REACH) & (found.boxes.label[:, None] == boxes.label)).any(axis=1)
        ids = found.id.tolist()
        last |= {id_: time for id_, seen in zip(ids, near.tolist(), strict=True) if seen or id_ not in last}
        unseen.append(np.array([time - last[id_] for id_ in ids]))
    return np.concatenate(unseen)
