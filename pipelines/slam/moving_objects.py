"""Moving objects in scans: their points are left out before odometry, landmarks and map see the scan.

Objects are tracked along the path so far, at the pose where the next scan is expected. One is faster than 1 m/s with
the probability Phi((|v| - 1 m/s) / sigma), sigma the deviation of its speed, and leaves the scan where that is at least
0.9: by 1.3 deviations. So new objects, whose velocity nobody knows, stay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.record import in_ego
from saga_fg.tracking import Tracker
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

SAME_TIME = 0.01  # s
_SPEED = 1.0  # m/s, from which an object moves
_LIKELY = 0.9  # probability of that, from which its points are left out
_LEAST_DEVIATION = 0.1  # m/s


class MovingObjects:
    """Tells which objects move; tracker: a new one, at the scanner."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker

    def boxes(self, time: float, detections: Detections, world_T_lidar: FloatArray) -> Boxes:
        """The detections of moving objects; detections in the scanner's frame, world_T_lidar (4, 4) about."""
        tracks = self._tracker.step(Frame(time, "lidar", detections, world_T_lidar, "ego"))
        assignment = self._tracker.assignment
        _, rows, at = np.intersect1d(assignment.id, tracks.id, return_indices=True)
        velocity, P = tracks.boxes.velocity[at], tracks.velocity_covariance[at]
        speed = np.linalg.norm(velocity, axis=1)
        along = velocity / np.maximum(speed, 1e-9)[:, None]
        deviation = np.sqrt(np.einsum("ni,nij,nj->n", along, P, along) + _LEAST_DEVIATION**2)
        moving = ndtr((speed - _SPEED) / deviation) >= _LIKELY
        return detections.boxes.select(assignment.detection[rows][moving])


def frames_at(
    frames: Sequence[Frame], timestamps: FloatArray, lidar_T_ego: FloatArray, tracker: Tracker
) -> list[Frame]:
    """The frame at each time, its detections in the frame of the scanner. Raises `InputError` where there is none."""
    times = np.array([frame.timestamp for frame in frames])
    found = []
    for time in timestamps.tolist():
        nearest = int(np.argmin(np.abs(times - time))) if len(times) else -1
        if nearest < 0 or abs(times[nearest] - time) > SAME_TIME:
            raise InputError(f"frames: expected one of detections at {time:.3f} s, the time of a scan; there is none")
        frame = frames[nearest]
        detections = in_ego(frame, tracker.sensor(frame.sensor)).transformed(lidar_T_ego)
        found.append(Frame(time, frame.sensor, detections, np.eye(4), "ego"))
    return found
