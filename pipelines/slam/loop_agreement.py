"""Acceptance of loop closures by agreement of several, for the planar laser and the LiDAR.

A loop within the drift of odometry is accepted at once. Any other waits for a second one, found from another place on
the way, that agrees with it: both loops and the odometry between their ends compose to the identity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from saga_fg.numerics.arrays import FloatArray


class PoseLoop(Protocol):
    """A measurement between two poses: first_T_second (3, 3) in the plane or (4, 4) in space."""

    @property
    def first(self) -> int: ...
    @property
    def second(self) -> int: ...
    @property
    def first_T_second(self) -> FloatArray: ...


Loop = TypeVar("Loop", bound=PoseLoop)


def deviation(T: FloatArray) -> FloatArray:
    """Translation, m, and rotation, rad, (2,) of a transform (3, 3) or (4, 4)."""
    d = len(T) - 1
    turned = float(np.linalg.norm(T[:d, :d] - np.eye(d))) / (2 * np.sqrt(2))  # sin of half the angle
    return np.array([float(np.linalg.norm(T[:d, d])), 2 * np.arcsin(min(turned, 1.0))])


@dataclass(eq=False)
class Agreement(Generic[Loop]):
    """Loops that wait for another one that agrees with them.

    within    largest difference of two loops that agree (2,), m and rad; `drift` (2,) more for each m between them
    patience  m of way that a loop waits
    apart     least way between the places that the two are found from, m
    """

    within: FloatArray
    drift: FloatArray
    patience: float
    apart: float = 0.0
    _waiting: list[Loop] = field(default_factory=list)

    def confirmed(
        self, loop: Loop, between: Callable[[int, int], FloatArray], way: Callable[[int], float]
    ) -> Sequence[Loop]:
        """The loop with those of before that agree with it; it waits if there are none.

        between: pose of the second in the frame of the first, by odometry; way: driven until a pose, m
        """
        now = way(loop.second)
        agreed = []
        self._waiting = [k for k in self._waiting if way(k.second) > now - self.patience]
        for other in self._waiting:
            far = abs(way(loop.first) - way(other.first)) + abs(now - way(other.second))
            one = between(other.first, loop.first) @ loop.first_T_second
            off = deviation(np.linalg.inv(one) @ other.first_T_second @ between(other.second, loop.second))
            if now - way(other.second) >= self.apart and (off < self.within + self.drift * far).all():
                agreed.append(other)
        held = {id(other) for other in agreed}
        self._waiting = [k for k in self._waiting if id(k) not in held]
        if not agreed:
            self._waiting.append(loop)
            return []
        return [loop, *agreed]
