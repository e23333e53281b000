"""What a scan shows beside surfaces: landmarks, and moving objects that are left out.

Moving objects in scans: their points are left out before odometry, landmarks and map see the scan.

Objects are tracked along the path so far, at the pose where the next scan is expected. One is faster than 1 m/s with
the probability Phi((|v| - 1 m/s) / sigma), sigma the deviation of its speed, and leaves the scan where that is at least
0.9: by 1.3 deviations. So new objects, whose velocity nobody knows, stay.

Detections in another frame, or of other scans, have boxes where the scan shows nothing. Where most of the first ones
near the sensor are empty, a warning says so.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from data_tools.lidar import (
    Scan,
    extract_curbs,
    extract_poles,
    extract_walls,
    segment_ground,
    straight_lines,
)
from data_tools.lidar.scan import inside_boxes
from saga_fg.errors import InputError
from saga_fg.model.landmarks import LandmarkDetector, LineLandmark, PlaneLandmark, PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import setting
from saga_fg.slam.joint.record import in_ego
from saga_fg.tracking import Tracker
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.landmark import Observation

WALL = PlaneLandmark(name="wall")
POLE = PoleLandmark()
LINE = LineLandmark()


@dataclass(frozen=True)
class ScanLandmarkSettings:
    """Settings of the detection of landmarks in a scan."""

    walls: int = setting(6, "largest number of walls of a scan; the largest ones are kept")
    poles: int = setting(12, "largest number of poles of a scan; the nearest ones are kept")
    lines: int = setting(2, "largest number of curb lines of a scan; those with the most points are kept")


def observe_landmarks(
    points: FloatArray, settings: ScanLandmarkSettings | None = None, detectors: Sequence[LandmarkDetector] = ()
) -> list[Observation]:
    """Observe landmarks in points (N, 3) of a scan without skew, m, in the sensor's frame.

    detectors: of further kinds of landmarks
    """
    s = settings or ScanLandmarkSettings()
    ground = segment_ground(points)
    found: list[Observation] = []
    walls = extract_walls(points[~ground.is_ground])
    for wall in walls[: s.walls]:
        found.append(Observation(WALL, wall.coefficients, wall.covariance, wall.extent))
    poles = extract_poles(points, ground.height, walls)
    for pole in sorted(poles, key=lambda pole: float(np.hypot(*pole.foot[:2])))[: s.poles]:
        extent = np.stack([pole.foot, [*pole.foot[:2], pole.top]])
        found.append(Observation(POLE, pole.foot, pole.covariance, extent))
    curbs = extract_curbs(points, ground.height) if s.lines else np.empty((0, 3))
    for line in straight_lines(curbs, s.lines):
        found.append(Observation(LINE, line.ends.ravel(), line.covariance, line.ends))
    return found + [other for detector in detectors for other in detector.observations(points)]


SAME_TIME = 0.01  # s
_SPEED = 1.0  # m/s, from which an object moves
_LIKELY = 0.9  # probability of that, from which its points are left out
_LEAST_DEVIATION = 0.1  # m/s
_NEAR, _JUDGED, _FILLED = (4.0, 30.0), 30, 0.6  # m; boxes that are looked at, and the share that is not empty
_GROUND = np.array([0.0, 0.0, 0.25])  # m, around the lower face of a box, which the ground fills
_LOG = logging.getLogger(__name__)


class MovingObjects:
    """Tells which objects move; tracker: a new one, at the scanner."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._filled: list[bool] = []  # of the first boxes near the sensor

    def check(self, scan: Scan, detections: Detections) -> None:
        """Warn, once, of detections that do not belong to their scans."""
        if len(self._filled) >= _JUDGED or not len(scan):
            return
        distance = np.linalg.norm(detections.boxes.position[:, :2], axis=1)
        near = detections.boxes.select((distance > _NEAR[0]) & (distance < _NEAR[1]))
        raised = replace(near, position=near.position + _GROUND / 2, size=near.size - 2 * np.abs(_GROUND))
        for row in range(len(near)):
            self._filled.append(bool(inside_boxes(scan.points, raised.select([row]), 0.0).any()))
        if len(self._filled) >= _JUDGED and np.mean(self._filled) < _FILLED:
            _LOG.warning(
                "detections: expected boxes in the frame of the vehicle, at the times of the scans; of the first %d "
                "within %.0f m only %d hold points",
                len(self._filled),
                _NEAR[1],
                sum(self._filled),
            )

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
