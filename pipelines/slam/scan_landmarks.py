"""Landmarks observed in a scan: walls and the ground as planes, masts and trunks as poles, curbs as road lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.lidar import (
    CurbSettings,
    EdgeSettings,
    GroundSettings,
    PlaneSettings,
    PoleSettings,
    extract_curbs,
    extract_poles,
    extract_walls,
    fit_ground,
    segment_ground,
    straight_edges,
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

    ground: bool = setting(False, "the ground as one plane: for level places only")
    walls: int = setting(6, "walls of a scan at most, the largest ones")
    poles: int = setting(12, "poles of a scan at most, the nearest ones")
    edges: int = setting(2, "straight pieces of the road's edge at most, those with the most points")
    segmentation: GroundSettings = settings_group(GroundSettings, "of the ground")
    plane: PlaneSettings = settings_group(PlaneSettings, "of walls and ground")
    pole: PoleSettings = settings_group(PoleSettings, "of poles")
    curb: CurbSettings = settings_group(CurbSettings, "of points on the road's edge")
    edge: EdgeSettings = settings_group(EdgeSettings, "of straight pieces of it")


@dataclass(frozen=True, eq=False)
class ObservedLandmark:
    """An observation, and the ends (2, 3) of the observed piece of a wall or line, m, in the sensor's frame."""

    observation: Observation
    extent: FloatArray


def observe_landmarks(
    points: FloatArray, settings: ScanLandmarkSettings | None = None, detectors: Sequence[LandmarkDetector] = ()
) -> list[ObservedLandmark]:
    """Observe landmarks in points (N, 3) of a scan without skew, m, in the sensor's frame.

    detectors: of further kinds of landmarks
    """
    s = settings or ScanLandmarkSettings()
    ground = segment_ground(points, s.segmentation)
    found = []
    if s.ground:
        plane = fit_ground(points[ground.is_ground], s.plane)
        if plane is not None:
            found.append(ObservedLandmark(Observation(GROUND, plane.coefficients, plane.covariance), plane.extent))
    walls = extract_walls(points[~ground.is_ground], s.plane)
    for wall in walls[: s.walls]:
        found.append(ObservedLandmark(Observation(WALL, wall.coefficients, wall.covariance), wall.extent))
    poles = extract_poles(points, ground.height, walls, s.pole)
    for pole in sorted(poles, key=lambda pole: float(np.hypot(*pole.foot[:2])))[: s.poles]:
        extent = np.stack([pole.foot, [*pole.foot[:2], pole.top]])
        found.append(ObservedLandmark(Observation(POLE, pole.foot, pole.covariance), extent))
    curbs = extract_curbs(points, ground.height, s.curb) if s.edges else np.empty((0, 3))
    for edge in straight_edges(curbs, s.edges, s.edge):
        found.append(ObservedLandmark(Observation(LINE, edge.ends.ravel(), edge.covariance), edge.ends))
    others = [other for detector in detectors for other in detector.observations(points)]
    found += [ObservedLandmark(other, np.zeros((2, 3))) for other in others]
    return found
