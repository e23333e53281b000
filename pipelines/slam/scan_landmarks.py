"""Landmarks observed in a scan: walls and the ground as planes, masts and trunks as poles, curbs as road lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.lidar import (
    extract_curbs,
    extract_poles,
    extract_walls,
    fit_ground,
    segment_ground,
    straight_lines,
)
from saga_fg.model.landmarks.detector import LandmarkDetector
from saga_fg.model.landmarks.line import LineLandmark
from saga_fg.model.landmarks.plane import PlaneLandmark
from saga_fg.model.landmarks.pole import PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import setting
from saga_fg.types.landmark import Observation

GROUND = PlaneLandmark(name="ground")
WALL = PlaneLandmark(name="wall")
POLE = PoleLandmark()
LINE = LineLandmark()


@dataclass(frozen=True)
class ScanLandmarkSettings:
    """Settings of the detection of landmarks in a scan."""

    ground: bool = setting(False, "detect the ground as one plane, for level areas only")
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
    if s.ground:
        plane = fit_ground(points[ground.is_ground])
        if plane is not None:
            found.append(Observation(GROUND, plane.coefficients, plane.covariance, plane.extent))
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
