"""Landmarks observed in a scan: walls and the ground as planes, masts and trunks as poles, curbs as road lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.lidar import (
    CurbSettings,
    GroundSettings,
    LineSettings,
    PlaneSettings,
    PoleSettings,
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
from saga_fg.settings import setting, settings_group
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
    segmentation: GroundSettings = settings_group(GroundSettings, "ground segmentation")
    plane: PlaneSettings = settings_group(PlaneSettings, "walls and ground plane")
    pole: PoleSettings = settings_group(PoleSettings, "poles")
    curb: CurbSettings = settings_group(CurbSettings, "points on curbs")
    line: LineSettings = settings_group(LineSettings, "straight lines through points on curbs")


def observe_landmarks(
    points: FloatArray, settings: ScanLandmarkSettings | None = None, detectors: Sequence[LandmarkDetector] = ()
) -> list[Observation]:
    """Observe landmarks in points (N, 3) of a scan without skew, m, in the sensor's frame.

    detectors: of further kinds of landmarks
    """
    s = settings or ScanLandmarkSettings()
    ground = segment_ground(points, s.segmentation)
    found: list[Observation] = []
    if s.ground:
        plane = fit_ground(points[ground.is_ground], s.plane)
        if plane is not None:
            found.append(Observation(GROUND, plane.coefficients, plane.covariance, plane.extent))
    walls = extract_walls(points[~ground.is_ground], s.plane)
    for wall in walls[: s.walls]:
        found.append(Observation(WALL, wall.coefficients, wall.covariance, wall.extent))
    poles = extract_poles(points, ground.height, walls, s.pole)
    for pole in sorted(poles, key=lambda pole: float(np.hypot(*pole.foot[:2])))[: s.poles]:
        extent = np.stack([pole.foot, [*pole.foot[:2], pole.top]])
        found.append(Observation(POLE, pole.foot, pole.covariance, extent))
    curbs = extract_curbs(points, ground.height, s.curb) if s.lines else np.empty((0, 3))
    for line in straight_lines(curbs, s.lines, s.line):
        found.append(Observation(LINE, line.ends.ravel(), line.covariance, line.ends))
    return found + [other for detector in detectors for other in detector.observations(points)]
