"""CenterPoint's greedy tracker of November 2026 in bare NumPy: the unit in which benchmarks give times.

Nothing of it may change, or ratios measured at different times could not be compared. It has the algorithm of
`saga_fg.tracking.greedy`, for detections in world coordinates whose velocity is not known, without the checks and the
value types of the package.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray

LIMITS = {"pedestrian": 1.0, "bicycle": 3.0, "motorcycle": 13.0}  # m
LIMIT, BASELINE, COASTING = 4.0, 0.2, 1.2  # m, s, s


class FrozenGreedy:
    """n tracks by columns, each as it was at its latest detection."""

    def __init__(self) -> None:
        self.id = np.empty(0, dtype=np.int64)
        self.label: StrArray = np.empty(0, dtype="<U1")
        self.position, self.velocity, self.anchor = np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2))
        self.last_seen, self.anchor_time = np.empty(0), np.empty(0)
        self.next_id = 1

    def step(self, now: float, label: StrArray, position: FloatArray, score: FloatArray) -> IntArray:
        """Take in the detections of a frame: label (m,), position (m, 3), m, score (m,). Returns their ids (m,)."""
        match = self._match(now, label, position, score)
        seen, m = match >= 0, len(label)
        rows = match[seen]
        elapsed = now - self.anchor_time[rows]
        young = elapsed < BASELINE - 1e-6
        moved = (position[seen, :2] - self.anchor[rows]) / np.maximum(elapsed, 1e-6)[:, None]
        velocity, anchor, anchor_time = np.zeros((m, 2)), position[:, :2].copy(), np.full(m, now)
        velocity[seen] = np.where(young[:, None], self.velocity[rows], moved)
        anchor[seen] = np.where(young[:, None], self.anchor[rows], anchor[seen])
        anchor_time[seen] = np.where(young, self.anchor_time[rows], anchor_time[seen])
        ids, new = np.empty(m, dtype=np.int64), int((~seen).sum())
        ids[seen] = self.id[rows]
        ids[~seen] = np.arange(self.next_id, self.next_id + new)
        self.next_id += new
        unseen = np.ones(len(self.id), dtype=bool)
        unseen[rows] = False
        kept = np.flatnonzero(unseen & (now - self.last_seen <= COASTING))
        self.id = np.concatenate([ids, self.id[kept]])
        self.label = np.concatenate([label, self.label[kept]])
        self.position = np.concatenate([position, self.position[kept]])
        self.velocity = np.concatenate([velocity, self.velocity[kept]])
        self.last_seen = np.concatenate([np.full(m, now), self.last_seen[kept]])
        self.anchor = np.concatenate([anchor, self.anchor[kept]])
        self.anchor_time = np.concatenate([anchor_time, self.anchor_time[kept]])
        return ids

    def _match(self, now: float, label: StrArray, position: FloatArray, score: FloatArray) -> IntArray:
        """(m,) row of the track that each detection takes, or -1."""
        match = np.full(len(label), -1, dtype=np.int64)
        if len(self.id) == 0 or len(label) == 0:
            return match
        projected = self.position[:, :2] + self.velocity * (now - self.last_seen)[:, None]
        distance = np.hypot(*np.moveaxis(position[:, None, :2] - projected[None], -1, 0))
        limit = np.array([LIMITS.get(name, LIMIT) for name in label.tolist()])
        possible = (label[:, None] == self.label[None]) & (distance <= limit[:, None])
        distance = np.where(possible, distance, np.inf)
        for d in np.argsort(-score, kind="stable"):
            t = int(distance[d].argmin())
            if np.isfinite(distance[d, t]):
                match[d] = t
                distance[:, t] = np.inf
        return match
