"""Several drives in one map: loops between drives by place, and one graph of all their keyframes.

Each drive comes with the results of its own run (`pipelines.slam.results`). One after the other is joined to the map of
those before it:

1. Places. Each submap is looked for in that map without a guess (`KnownMap.recognised`). One finding alone says
   nothing, as streets look alike. The largest number of submaps that put the drive in the same place places it; there
   must be two at least.
2. Graph. The pose graphs of both, and a loop for each of these submaps to the nearest keyframe of the map. False loops
   are left out (`saga_fg.slam.pose_graph.consensus`), and all keyframes are solved together.

The world is that of the first drive. Scans and submaps move with their keyframes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.pose_graphs import read_g2o
from data_tools.trajectories import Trajectory, read_tum_poses
from pipelines.slam.drive import SlamMap, covariance_columns, read_map, rows_below
from pipelines.slam.localisation import KnownMap
from pipelines.slam.loop_closures import DISTORTION, deviation
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray, carried_covariance, inverse_transform
from saga_fg.slam.pose_graph import PoseGraph, consensus
from saga_fg.slam.submaps import LoopClosure

_SAME = np.array([2.0, 0.05])  # m and rad that two findings of a drive's place differ by
_DRIFT = np.array([0.05, 1e-3])  # and more for each m between them
_FEWEST = 2  # findings that agree


@dataclass(frozen=True, eq=False)
class Session:
    """A drive that has been estimated: its map, the pose graph of its M keyframes, their times (M,), s, and the path of
    all scans, all in one world."""

    name: str
    slam_map: SlamMap
    graph: PoseGraph
    times: FloatArray
    path: Trajectory

    @property
    def carriers(self) -> IntArray:
        """(S,) the keyframe that each submap moves with: the one where its frame is."""
        apart = self.slam_map.map_T_submap[:, None, :3, 3] - self.graph.world_T_pose[None, :, :3, 3]
        return np.asarray(np.linalg.norm(apart, axis=2).argmin(axis=1))

    def at(self, world_T_keyframe: FloatArray) -> "Session":
        """The drive with its keyframes at other poses (M, 4, 4)."""
        moved = world_T_keyframe @ inverse_transform(self.graph.world_T_pose)
        of = np.maximum(np.searchsorted(self.times, self.path.timestamps, side="right") - 1, 0)
        path = Trajectory(self.path.timestamps, moved[of] @ self.path.world_T_ego)
        slam_map = replace(self.slam_map, map_T_submap=moved[self.carriers] @ self.slam_map.map_T_submap)
        return Session(self.name, slam_map, self.graph.at(world_T_keyframe), self.times, path)


@dataclass(frozen=True, eq=False)
class MergedDrives:
    """Drives in the world of the first: `graph` of all keyframes, those of one drive after those of the one before.

    loops, false_loops  between drives, of rows of the graph: those that agree, and those that are left out
    """

    sessions: Sequence[Session]
    graph: PoseGraph
    loops: Sequence[LoopClosure] = ()
    false_loops: Sequence[LoopClosure] = ()

    @property
    def slam_map(self) -> SlamMap:
        """The submaps of all drives."""
        maps = [one.slam_map for one in self.sessions]
        points = [cloud for one in maps for cloud in one.points]
        return SlamMap(points, np.concatenate([one.map_T_submap for one in maps]), maps[0].origin)


def read_session(folder: str | Path) -> Session:
    """Read the output folder of `saga-fg slam scans`. Raises `InputError` naming the file of what is missing or broken,
    and for a drive of one keyframe."""
    folder = Path(folder)
    for name in ("graph.g2o", "covariances.csv", "trajectory.tum"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: expected {name}, as `saga-fg slam scans` writes it")
    slam_map, graph = read_map(folder), read_g2o(folder / "graph.g2o")
    table = rows_below(folder / "covariances.csv", ("timestamp", *covariance_columns(6)))
    times = table.numbers([0], ("timestamp",))[:, 0]
    if (np.diff(times) <= 0).any():
        raise InputError(f"{folder / 'covariances.csv'}: timestamp: expected increasing times")
    if len(times) != len(graph):
        raise InputError(f"{folder}: expected as many rows of covariances.csv as poses of graph.g2o, got {len(times)}")
    return Session(folder.resolve().name, slam_map, graph, times, read_tum_poses(folder / "trajectory.tum"))


def merge_sessions(sessions: Sequence[Session], progress: Progress | None = None) -> MergedDrives:
    """Put drives into one map. Raises `InputError` for one that has no places in common with those before it."""
    merged = MergedDrives(sessions[:1], sessions[0].graph)
    for number, session in enumerate(sessions[1:], 1):
        merged = _joined(merged, session)
        if progress is not None:
            progress("drives", number, len(sessions) - 1)
    return merged


def _joined(merged: MergedDrives, session: Session) -> MergedDrives:
    offset = len(merged.graph)
    map_T_session, found = _loops(merged, session)
    a, b = merged.graph, session.graph
    between = [replace(one, second=one.second + offset) for one in found]  # those before are among a's measurements
    loops = [*merged.loops, *between]
    graph = PoseGraph(
        np.arange(offset + len(b)),
        np.concatenate([a.world_T_pose, map_T_session @ b.world_T_pose]),
        np.concatenate([a.first, b.first + offset, [one.first for one in between]]),
        np.concatenate([a.second, b.second + offset, [one.second for one in between]]),
        np.concatenate([a.first_T_second, b.first_T_second, [one.first_T_second for one in between]]),
        np.concatenate([a.information, b.information, [np.linalg.inv(one.covariance) for one in between]]),
        priors=a.priors,
    )
    agreed = consensus(graph)
    kept = {(int(i), int(j)) for i, j in zip(agreed.graph.first, agreed.graph.second, strict=True)}
    true = [one for one in loops if (one.first, one.second) in kept]
    poses, begin, placed = agreed.graph.world_T_pose, 0, list[Session]()
    for one in (*merged.sessions, session):
        placed.append(one.at(poses[begin : begin + len(one.graph)]))
        begin += len(one.graph)
    false = [*merged.false_loops, *(one for one in loops if one not in true)]
    return MergedDrives(placed, agreed.graph, true, false)


def _loops(merged: MergedDrives, session: Session) -> tuple[FloatArray, list[LoopClosure]]:
    """The place of a drive in the map (4, 4), and loops from keyframes of the map to its own."""
    known, frames = KnownMap(merged.slam_map), session.slam_map.map_T_submap
    findings = [known.recognised(points.astype(np.float64)) for points in session.slam_map.points]
    found = [(number, one) for number, one in enumerate(findings) if one is not None]
    places = [one.map_T_scan @ inverse_transform(frames[number]) for number, one in found]
    at = [frames[number] for number, _ in found]
    groups = [[k for k in range(len(at)) if _agree(places[k], places[n], at[k], at[n])] for n in range(len(at))]
    largest = max(groups, key=len, default=[])
    if len(largest) < _FEWEST:
        others = ", ".join(one.name for one in merged.sessions)
        raise InputError(
            f"{session.name}: expected places in common with {others}: {len(largest)} of {len(frames)} submaps agree "
            f"on where the drive is, at least {_FEWEST} must"
        )
    carriers, own, loops = session.carriers, session.graph.world_T_pose, list[LoopClosure]()
    there = merged.graph.world_T_pose[:-1]  # a loop from the last to the first of this drive would pass for odometry
    for number, one in (found[k] for k in largest):
        first = int(np.linalg.norm(there[:, :3, 3] - one.map_T_scan[:3, 3], axis=1).argmin())
        keyframe_T_submap = inverse_transform(own[carriers[number]]) @ frames[number]
        measured = inverse_transform(there[first]) @ one.map_T_scan @ inverse_transform(keyframe_T_submap)
        covariance = carried_covariance(keyframe_T_submap, one.covariance + np.diag(DISTORTION))
        loops.append(LoopClosure(first, int(carriers[number]), measured, (covariance + covariance.T) / 2))
    return places[largest[0]], loops


def _agree(one: FloatArray, other: FloatArray, at: FloatArray, other_at: FloatArray) -> bool:
    """True if two places (4, 4) of a drive, found by submaps whose frames (4, 4) are `at` and `other_at`, are alike."""
    off = deviation(inverse_transform(other @ at) @ one @ at)
    return bool((off < _SAME + _DRIFT * np.linalg.norm(at[:3, 3] - other_at[:3, 3])).all())
