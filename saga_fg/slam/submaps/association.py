"""Association of observations with the landmarks of the running submap.

Pose and landmarks of the submap are one Gaussian in the frame of its anchor (`LocalMap`), so that a submap far from the
start is associated as the first one. Walls and lines are finite: two pieces farther apart along the wall than `_GAP`
are not of one, though in one plane, as the fronts of houses in a row are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LocalMap, associate
from saga_fg.types.landmark import Observation

_GAP = 3.0  # m
_ANCHOR = 1e-12 * np.eye(6)  # covariance of the anchor in its own frame


class SubmapLandmarks:
    """The landmarks of one submap, seen from its anchor on."""

    def __init__(self) -> None:
        self._local = LocalMap(np.eye(4), _ANCHOR)
        self._ends: dict[int, FloatArray] = {}  # (2, 2) of walls and lines, from above

    def copy(self) -> SubmapLandmarks:
        """A copy that further observations can be associated with."""
        twin = SubmapLandmarks()
        twin._local, twin._ends = self._local.copy(), dict(self._ends)
        return twin

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on to the next pose: covariance (6, 6) of the motion's tangent."""
        self._local.predict(a_T_b, covariance)

    def observe(self, observations: Sequence[Observation], first: int) -> list[int]:
        """Return the number of the landmark of each observation; new ones are numbered from `first` > 0 on."""
        ends = [self._from_above(one) for one in observations]

        def near(row: int, landmark: int) -> bool:
            return _gap(self._ends.get(landmark), ends[row]) <= _GAP

        pairs = associate(self._local, observations, near)
        if pairs:
            self._local.update(list(pairs.values()))
        taken = []
        for row, observation in enumerate(observations):
            if row in pairs:
                taken.append(pairs[row].landmark)
            else:
                self._local.augment(first, observation)
                taken.append(first)
                first += 1
            if (seen := ends[row]) is not None:
                self._ends[taken[-1]] = _together(self._ends.get(taken[-1]), seen)
        return taken

    def _from_above(self, observation: Observation) -> FloatArray | None:
        """Ends (2, 2) of what was observed, from above."""
        T = self._local.pose.matrix()
        return None if observation.extent is None else (observation.extent @ T[:3, :3].T + T[:3, 3])[:, :2]


def _gap(known: FloatArray | None, seen: FloatArray | None) -> float:
    """Gap between two pieces along the first one, m."""
    if known is None or seen is None:
        return 0.0
    along = _direction(known)
    (low, high), (first, second) = np.sort(known @ along), np.sort(seen @ along)
    return float(max(first - high, low - second, 0.0))


def _together(known: FloatArray | None, seen: FloatArray) -> FloatArray:
    """The ends of both pieces together, along the first one."""
    if known is None:
        return seen
    every = np.concatenate([known, seen])
    u = every @ _direction(known)
    return every[[int(u.argmin()), int(u.argmax())]]


def _direction(ends: FloatArray) -> FloatArray:
    off = ends[1] - ends[0]
    length = float(np.linalg.norm(off))
    return off / length if length > 0 else np.array([1.0, 0.0])
