"""Which landmarks can be seen from near a pose, so that neither association nor merging looks at the whole map.

What is observed stands somewhere in the frame of its pose: at the coordinates that its type gives there to the initial
state (of a wall or a line, the foot of the perpendicular). Where that was in the world, over all observations of a
landmark, is its region, a box along the axes. From a place it can be seen if its region is nearer than

    reach + travel + k sigma,        sigma = min( sigma_pose + sigma_landmark, sqrt(tr Q_t + s^2 tr Q_R) )

reach: the farthest that anything was seen; travel: the way on which the answer holds; sigma: of its place relative to
the pose, at most what both have in the world, and at most what odometry has added on the s metres since it was seen
last, Q_t of translation and Q_R of rotation. So neither a large map nor a long way without loops makes the answer long.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.slam.mapping.jacobians import initial_state
from saga_fg.types.landmark import Observation

_TRAVEL = 2.0  # of the reach
_SIGMAS = 4.0  # standard deviations, of a sum of variances over all axes


class NearbyLandmarks:
    """Regions of landmarks by number, counted from 1, and the way of the vehicle.

    by_odometry: whether `move` says how uncertain its way is; otherwise sigma is what both have in the world
    """

    def __init__(self, by_odometry: bool = True) -> None:
        self.reach = 0.0  # m
        self._by_odometry = by_odometry
        self._way = np.zeros(3)  # variance of translation, m^2, and of rotation, rad^2, and metres, since the start
        self._box = np.empty((64, 2, 2))  # smallest and largest x and y
        self._then = np.empty((64, 3))  # `_way` when each was seen last
        self._sigma = np.full(64, -1.0)  # of its place in the world, m; below 0 where there is no such landmark

    @property
    def travel(self) -> float:
        """Metres on which the landmarks near a place are all that can be seen."""
        return _TRAVEL * self.reach

    def move(self, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Go on by odometry: a_T_b (d + 1, d + 1), covariance of its tangent."""
        self._way += np.array([*_variances(covariance), float(np.linalg.norm(a_T_b[:-1, -1]))])

    def see(self, landmark: int, place: FloatArray, world_T_pose: FloatArray, covariance: FloatArray) -> None:
        """Note where a landmark was seen from a pose: place (2,) in its frame, covariance of the pose's tangent."""
        while landmark >= len(self._sigma):
            self._box, self._then = (np.concatenate([a, np.empty_like(a)]) for a in (self._box, self._then))
            self._sigma = np.concatenate([self._sigma, np.full_like(self._sigma, -1.0)])
        distance = float(np.linalg.norm(place))
        self.reach = max(self.reach, distance)
        there = world_T_pose[:2, :2] @ place + world_T_pose[:2, -1]
        sigma, box = _sigma(_variances(covariance), distance), np.stack([there, there])
        if self._sigma[landmark] >= 0:
            sigma = min(sigma, self._sigma[landmark])
            box = np.stack([np.minimum(box[0], self._box[landmark, 0]), np.maximum(box[1], self._box[landmark, 1])])
        self._box[landmark], self._then[landmark], self._sigma[landmark] = box, self._way, sigma

    def merge(self, merged: int, kept: int) -> None:
        """Let one landmark be another."""
        low, high = (extreme(self._box[[merged, kept], side], axis=0) for side, extreme in enumerate((np.min, np.max)))
        self._box[kept] = low, high
        self._then[kept] = np.maximum(self._then[merged], self._then[kept])
        self._sigma[kept] = min(self._sigma[merged], self._sigma[kept])
        self.forget([merged])

    def forget(self, landmarks: Iterable[int]) -> None:
        """Let landmarks leave."""
        self._sigma[list(landmarks)] = -1.0

    def centre(self, landmark: int) -> FloatArray:
        """The middle (2,) of a region."""
        return np.asarray(self._box[landmark].mean(axis=0))

    def near(self, place: FloatArray, covariance: FloatArray) -> IntArray:
        """Numbers of the landmarks that can be seen from within `travel` of a place (2,); covariance: of the pose."""
        numbers = np.flatnonzero(self._sigma >= 0)
        box, since = self._box[numbers], self._way - self._then[numbers]
        distance = np.linalg.norm(np.maximum(box[:, 0] - place, place - box[:, 1]).clip(0), axis=1)
        sigma = _sigma(_variances(covariance), self.reach) + self._sigma[numbers]
        if self._by_odometry:
            since_seen = (since[:, 0] + since[:, 1] * since[:, 2] ** 2, since[:, 1])
            sigma = np.minimum(sigma, _sigma(since_seen, self.reach))
        return np.asarray(numbers[distance <= self.reach + self.travel + _SIGMAS * sigma])


def place_of(observation: Observation) -> FloatArray:
    """Where an observation stands in the frame of its pose (2,), m. Raises `InputError` naming its type."""
    kind = observation.kind
    where = kind.coordinates(initial_state(observation, np.eye(4 if kind.pose.dim == 6 else 3)))
    return np.array([where["x"], where["y"]], dtype=np.float64)


def _variances(covariance: FloatArray) -> tuple[float, float]:
    """Variances of translation and rotation, each summed, of a tangent: (x, y, heading), or (rotation, translation)."""
    first, second = (2, 1) if len(covariance) == 3 else (3, 3)
    a, b = float(np.trace(covariance[:first, :first])), float(np.trace(covariance[-second:, -second:]))
    return (a, b) if first == 2 else (b, a)


def _sigma(variances: tuple[FloatArray | float, FloatArray | float], distance: float) -> FloatArray:
    """Standard deviation of a place so far from a pose, m."""
    return np.asarray(np.sqrt(variances[0]) + distance * np.sqrt(variances[1]))
