"""The graph of LiDAR SLAM as files, and back, and as a pose graph for other tools (g2o).

The whole graph of LiDAR SLAM as files, and back: keyframes, odometry, loops, poles, walls, curbs.

graph.g2o          poses, the first one's prior, odometry and loops, poles
observations.csv   keyframe, landmark, kind, value, covariance: all observations of landmarks of the map, the value as
                   the kind has it (a wall nx ny nz d, a pole x y z), the covariance as its upper triangle

    saved = read_graph("slam")
    solved = saved.solved()
    solved.world_T_pose, solved.landmarks

The keyframes of LiDAR SLAM as a pose graph for other tools (g2o), and its landmarks as a table.

The pose graph holds the first pose as a prior, odometry and loops as they were in the solution, the poses as estimated,
and poles as points whose height is open. Walls, the ground and curbs, which its format has no records for, are in a
table of all observations beside it. The vehicle's sensors are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.files.readers import read_lines
from data_tools.pose_graphs import read_g2o, write_g2o
from pipelines.slam.lidar_slam import START, LidarSlamResult
from pipelines.slam.scan_content import GROUND, LINE, POLE, WALL
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import carried_covariance, inverse_transform, transform_points
from saga_fg.slam.mapping import AssociatedObservation, LandmarkObservations
from saga_fg.slam.pose_graph import LandmarkObservations as PoseGraphObservations
from saga_fg.slam.pose_graph import PointLandmarks, PoseGraph, PosePriors
from saga_fg.slam.submaps import (
    LoopClosure,
    Loops,
    LoopSelection,
    SolvedDrive,
    SubmapSettings,
    measurement_graph,
    solve_drive,
)
from saga_fg.types.landmark import Landmark, LandmarkType, Observation

_HEIGHT = 100.0  # m, standard deviation of the height of an observed pole


def pose_graph_of(result: LidarSlamResult) -> PoseGraph:
    """Keyframes 0 .. M - 1 with the odometry between them and the loops, and poles from M on; M > 1."""
    odometry = result.motions(result.drive.keyframes)
    pairs = [*pairwise(range(len(result.keyframes))), *((loop.first, loop.second) for loop in result.loops)]
    measured = [*(T for T, _ in odometry), *(loop.first_T_second for loop in result.loops)]
    covariances = np.array([*(P for _, P in odometry), *(loop.covariance for loop in result.loops)])
    information = np.linalg.inv(covariances)
    first, second = np.array(pairs, dtype=np.int64).T
    return PoseGraph(
        np.arange(len(result.keyframes), dtype=np.int64),
        result.world_T_lidar,
        first,
        second,
        np.array(measured),
        (information + information.swapaxes(1, 2)) / 2,
        _pole_landmarks(result),
        PosePriors(np.zeros(1, dtype=np.int64), result.drive.poses[:1], np.linalg.inv(START)[None]),
    )


def _pole_landmarks(result: LidarSlamResult) -> PointLandmarks | None:
    marks = {mark.number: mark for mark in result.landmarks if mark.kind == POLE}
    seen = [one for one in result.observations if one.landmark in marks]
    if not seen:
        return None
    numbers = np.array(sorted(marks), dtype=np.int64)
    pose, landmark = (np.array([getattr(one, end) for one in seen], dtype=np.int64) for end in ("pose", "landmark"))
    z, information = np.array([one.observation.value for one in seen]), np.zeros((len(seen), 3, 3))
    information[:, :2, :2] = np.linalg.inv([one.observation.covariance for one in seen])
    information[:, 2, 2] = _HEIGHT**-2
    row = np.searchsorted(numbers, landmark)
    height = np.zeros(len(numbers))
    heights = [transform_points(result.world_T_lidar[k], point[None])[0, 2] for k, point in zip(pose, z, strict=True)]
    np.add.at(height, row, heights)
    height /= np.bincount(row, minlength=len(numbers))
    places = np.column_stack([np.array([marks[number].state for number in numbers.tolist()]), height])
    observed = PoseGraphObservations("point", pose, row, z, information)
    return PointLandmarks(len(result.keyframes) + numbers, (observed,), places)


def write_landmark_table(path: Path, landmarks: Iterable[Landmark], pieces: Mapping[int, FloatArray]) -> None:
    """Write number, kind, observations, standard deviations of the state, and the geometry as WKT, in x and y, m.

    pieces: (n, 2, 2) ends of what was seen of walls and lines, by the number of the landmark; others are points
    """
    rows = ["number,kind,observations,deviations,geometry"]
    for mark in landmarks:
        deviations = " ".join(f"{x:.4g}" for x in np.sqrt(np.diag(mark.covariance)))
        if mark.number in pieces:
            lines = ", ".join(f"({', '.join(f'{x:.3f} {y:.3f}' for x, y in ends)})" for ends in pieces[mark.number])
            shape = f"MULTILINESTRING ({lines})" if lines else "MULTILINESTRING EMPTY"
        else:
            place = mark.kind.coordinates(mark.state)
            shape = f"POINT ({place['x']:.3f} {place['y']:.3f})" if "x" in place else "POINT EMPTY"
        rows.append(f'{mark.number},{mark.kind.name},{mark.observations},{deviations},"{shape}"')
    write_text(path, "\n".join(rows) + "\n")


Motion = tuple[FloatArray, FloatArray]

_COLUMNS = ("keyframe", "landmark", "kind", "value", "covariance")


@dataclass(frozen=True, eq=False)
class SavedGraph:
    """poses: with odometry and loops; observations: of landmarks, from these poses by row."""

    poses: PoseGraph
    observations: Sequence[AssociatedObservation]

    def solved(self, settings: SubmapSettings | None = None) -> SolvedDrive:
        """Solve the whole graph; settings: of the run, for the losses of landmarks.

        Objects, other sensors and providers of the run are in no file, and are not in it.
        """
        s, loops = settings or SubmapSettings(), list[LoopClosure]()
        motions: list[Motion | None] = [self._prior(), *[None] * (len(self.poses) - 1)]
        covariances = np.linalg.inv(self.poses.information)
        for row, (a, b) in enumerate(zip(self.poses.first.tolist(), self.poses.second.tolist(), strict=True)):
            edge = LoopClosure(a, b, self.poses.first_T_second[row], covariances[row])
            if abs(b - a) == 1 and motions[max(a, b)] is None:
                motions[max(a, b)] = _motion(edge)
            else:
                loops.append(edge)
        known = [motion for motion in motions if motion is not None]
        if len(known) < len(motions):
            k = motions.index(None)
            raise InputError(f"graph: expected odometry from keyframe {k - 1} to keyframe {k}")
        seen: dict[int, list[tuple[int, Observation]]] = {}
        start: dict[int, Any] = {}
        for one in self.observations:
            seen.setdefault(one.pose, []).append((one.landmark, one.observation))
            if one.landmark not in start:
                pose = self.poses.world_T_pose[one.pose]
                start[one.landmark] = one.observation.kind.initialise(pose, one.observation.value)
        numbers, landmarks = range(len(known)), LandmarkObservations(seen, start, s.robust)
        graph = measurement_graph(numbers, known, self.poses.world_T_pose, landmarks, Loops(loops, numbers))
        all_kept = LoopSelection(np.ones(len(loops), dtype=bool), np.ones(2))
        return solve_drive(graph, landmarks, s.confirm_after, all_kept)

    def _prior(self) -> Motion:
        """Of the first keyframe: that of the file, or where it stands."""
        priors = self.poses.priors
        if priors is None:
            return self.poses.world_T_pose[0], START
        if priors.pose.tolist() != [0]:
            raise InputError("graph: expected a prior of the first keyframe alone")
        return priors.world_T_pose[0], np.linalg.inv(priors.information[0])


def _motion(edge: LoopClosure) -> Motion:
    """Odometry to the later keyframe, as an edge has it forwards or backwards."""
    if edge.first < edge.second:
        return edge.first_T_second, edge.covariance
    back = carried_covariance(edge.first_T_second, edge.covariance)
    return inverse_transform(edge.first_T_second), (back + back.T) / 2


def write_graph(folder: Path, result: LidarSlamResult) -> None:
    """Write both files to a folder that exists; a graph of one keyframe is none."""
    if len(result.keyframes) < 2:
        return
    write_g2o(folder / "graph.g2o", pose_graph_of(result))
    marks = {mark.number for mark in result.landmarks}
    rows = [",".join(_COLUMNS)]
    for one in result.observations:
        if one.landmark in marks:
            z, P = one.observation.value, one.observation.covariance
            fields = (z, P[np.triu_indices(len(P))])
            value, covariance = (" ".join(f"{x:.17g}" for x in field) for field in fields)
            rows.append(f"{one.pose},{one.landmark},{one.observation.kind.name},{value},{covariance}")
    write_text(folder / "observations.csv", "\n".join(rows) + "\n")


def read_graph(folder: str | Path, kinds: Sequence[LandmarkType] = (WALL, POLE, LINE, GROUND)) -> SavedGraph:
    """Read a graph; kinds: of landmarks, your own among them. Raises `InputError` naming file and line."""
    graph, path = read_g2o(Path(folder) / "graph.g2o"), Path(folder) / "observations.csv"
    if graph.dim != 3:
        raise InputError(f"{Path(folder) / 'graph.g2o'}: expected poses in space, got poses in the plane")
    lines = [(number, line.split(",")) for number, line in enumerate(read_lines(path), start=1) if line.strip()]
    if not lines or tuple(lines[0][1]) != _COLUMNS:
        raise InputError(f"{path}: line 1: expected the columns {','.join(_COLUMNS)}")
    known, found = {kind.name: kind for kind in kinds}, list[AssociatedObservation]()
    for number, row in lines[1:]:
        where = f"{path}: line {number}"
        if len(row) != len(_COLUMNS):
            raise InputError(f"{where}: expected {len(_COLUMNS)} columns, got {len(row)}")
        keyframe, landmark, name, value, covariance = row
        if name not in known:
            raise InputError(f"{where}: kind: expected one of {', '.join(known)}, got {name[:40]!r}")
        if not (keyframe.isdecimal() and landmark.isdecimal() and len(keyframe) < 10 and int(keyframe) < len(graph)):
            raise InputError(f"{where}: expected numbers of a keyframe of graph.g2o and of a landmark")
        P, upper = np.zeros((known[name].variable.dim,) * 2), np.triu_indices(known[name].variable.dim)
        try:
            P[upper] = P.T[upper] = [float(word) for word in covariance.split()]
            seen = Observation(known[name], np.array([float(word) for word in value.split()]), P)
        except ValueError as error:
            raise InputError(f"{where}: expected the numbers of an observation of a {name}: {error}") from error
        found.append(AssociatedObservation(int(keyframe), seen, int(landmark)))
    return SavedGraph(graph, found)
