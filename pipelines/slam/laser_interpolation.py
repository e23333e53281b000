"""The path between keyframes."""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.planar_poses import transforms, vectors
from saga_fg.slam.pose_graph.running import path_lengths


def between_keyframes(matched: FloatArray, poses: FloatArray, rows: IntArray) -> FloatArray:
    """Poses (n, 3, 3) of all scans: the correction of the keyframes before and after, by the way between them.

    matched: (n, 3, 3) by scan matching alone; poses: (k, 3, 3) of the keyframes, the scans `rows` (k,).
    """
    step = np.linalg.inv(matched[:-1]) @ matched[1:]
    way = np.concatenate([[0.0], np.cumsum(path_lengths(step))])
    key = np.clip(np.searchsorted(rows, np.arange(len(matched)), side="right") - 1, 0, len(rows) - 1)
    after = np.minimum(key + 1, len(rows) - 1)
    length = way[rows[after]] - way[rows[key]]
    share = np.where(length > 0, (way - way[rows[key]]) / np.where(length > 0, length, 1), 0.0)
    share = np.clip(share, 0, 1)  # scans before the first keyframe
    from_before = poses[key] @ np.linalg.inv(matched[rows[key]]) @ matched
    from_after = poses[after] @ np.linalg.inv(matched[rows[after]]) @ matched
    one, other = vectors(from_before), vectors(from_after)
    off = other - one
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    return transforms(one + share[:, None] * off)
