"""The whole graph of LiDAR SLAM as files, and back: keyframes, odometry, loops, poles, walls, curbs.

graph.g2o          poses, the first one's prior, odometry and loops, poles (`pipelines.slam.graph_export`)
observations.csv   keyframe, landmark, kind, value, covariance: all observations of landmarks of the map, the value as
                   the kind has it (a wall nx ny nz d, a pole x y z), the covariance as its upper triangle

    saved = read_graph("slam")
    solved = saved.solved()
    solved.world_T_pose, solved.landmarks
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.files.text_tables import read_lines
from data_tools.pose_graphs import read_g2o, write_g2o
from pipelines.slam.graph_export import pose_graph_of
from pipelines.slam.lidar_slam_types import START, LidarSlamResult
from pipelines.slam.scan_landmarks import GROUND, LINE, POLE, WALL
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import carried_covariance, inverse_transform
from saga_fg.slam.mapping import AssociatedObservation, LandmarkObservations
from saga_fg.slam.pose_graph import PoseGraph
from saga_fg.slam.submaps import (
    LoopClosure,
    Loops,
    LoopSelection,
    SolvedDrive,
    SubmapSettings,
    measurement_graph,
    solve_drive,
)
from saga_fg.types.landmark import LandmarkType, Observation

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
