"""SLAM with a planar laser and wheel odometry.

1. Each scan that has moved is registered with a map of the last keyframes, point to line; odometry is its prior.
2. A keyframe comes every half metre or 30 degrees, and is measured from the one before: a graph that runs (iSAM2).
3. Loops: each second keyframe is searched for in older submaps (`pipelines.slam.laser_odometry`).
4. At the end false loops are found by consensus, and all keyframes are registered anew with every other pass of the
   same place, twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from data_tools.laser.carmen import LaserLog
from data_tools.laser.mapping import SMEAR, LineMap, ScoreGrid, thinned
from pipelines.slam.laser_odometry import (
    Keyframe,
    LoopSearch,
    WheelScale,
    check_wheels,
    covariance_of,
    joined,
    measured_by,
    warn_of_times,
    without_jumps,
)
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, checked
from saga_fg.numerics.geometry import heading, moved, transform, transforms, vector, vectors
from saga_fg.settings import Positive, Range, Settings, setting
from saga_fg.slam.pose_graph import PoseGraph
from saga_fg.slam.pose_graph.consensus import Measured, RunningPoseGraph, path_lengths


def between_keyframes(matched: FloatArray, poses: FloatArray, rows: IntArray) -> FloatArray:
    """Poses (n, 3, 3) of all scans: the correction of the keyframes before and after, by the way between them.

    matched: (n, 3, 3) by scan matching alone; poses: (k, 3, 3) of the keyframes, the scans `rows` (k,).
    """
    step = np.linalg.inv(matched[:-1]) @ matched[1:]
    way = np.concatenate([[0.0], np.cumsum(path_lengths(step))])
    key = np.clip(np.searchsorted(rows, np.arange(len(matched)), side="right") - 1, 0, len(rows) - 1)
    after = np.minimum(key + 1, len(rows) - 1)
    length = way[rows[after]] - way[rows[key]]
    share = np.where(length > 0, (way - way[rows[key]]) / np.where(length > 0, length, 1), 0.0)
    share = np.clip(share, 0, 1)  # scans before the first keyframe
    from_before = poses[key] @ np.linalg.inv(matched[rows[key]]) @ matched
    from_after = poses[after] @ np.linalg.inv(matched[rows[after]]) @ matched
    one, other = vectors(from_before), vectors(from_after)
    off = other - one
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    return transforms(one + share[:, None] * off)


_NEARBY = 3.0  # m between keyframes that see the same walls
_GAP = 5.0  # m of way without a keyframe nearby, from which on it is another pass
_SHARED = 3  # keyframes in a row that share a map
_MOST_PASSES = 4  # that a keyframe is registered with
_PRIOR = np.diag([100.0, 100.0, 1000.0])  # information of the graph about where the other pass is


def registered_passes(
    frames: list[Keyframe], poses: FloatArray, reach: float, local_map: float, least_share: float
) -> list[Measured]:
    """Registrations of each keyframe with the map of every other pass nearby, of points within `reach`, m.

    poses (n, 3, 3) of the keyframes; local_map: m of way; least_share: of the points that must lie on the map.
    """
    found: list[Measured] = []
    maps: dict[int, LineMap] = {}
    places = poses[:, :2, 2]
    way = np.array([frame.way for frame in frames])
    for row in range(len(poses)):
        apart = np.linalg.norm(places[:row] - places[row], axis=1)
        others = np.flatnonzero((apart < _NEARBY) & (way[:row] < way[row] - 2 * local_map))
        if not len(others):
            continue
        runs = np.split(others, np.flatnonzero(np.diff(way[others]) > _GAP) + 1)
        nearest = sorted((int(run[np.argmin(apart[run])]) for run in runs), key=lambda k: apart[k])
        for other in dict.fromkeys(near // _SHARED * _SHARED for near in nearest[:_MOST_PASSES]):
            if other not in maps:
                around = [frame for frame in frames if abs(frame.way - way[other]) < local_map / 3]
                maps[other] = LineMap.of(joined(around, frames[other]))
            guess = np.linalg.inv(poses[other]) @ poses[row]
            fit = maps[other].fit(frames[row].points, vector(guess), _PRIOR, reach)
            if fit.share > least_share:
                found.append(measured_by(other, row, fit))
    return found


_SCAN_STEP = 0.1  # m: scans that moved less, and turned less than 3 degrees, are not registered
_LEAST_POINTS = 20  # of a scan that is registered
_WIDEST = 3.0  # m, half width of the search where wheels slipped: its time and memory grow with the square
_POOR = 0.8  # share of a scan that lies on the local map, below which the pose is searched
_REACHES = (0.6, 0.3)  # m, of registrations with other passes, in turn
_DOUBT = 0.2  # share of a difference between wheels and registration that counts as standard deviation: one errs
_TURNING = 0.01  # error of the heading that registration in a turn makes, rad per rad
KEYFRAME_STEP = 0.5  # distance between keyframes, m
KEYFRAME_TURN = 0.5  # turn between keyframes, rad
LOCAL_MAP = 10.0  # m of way whose keyframes scans are registered with
SUBMAP = 10.0  # m of way in a submap in which loops are searched
ODOMETRY_DRIFT = 0.15  # error of the wheels, share of the way: standard deviation
ODOMETRY_TURN = 0.1  # error of the wheels' heading, rad for each rad turned and for each 2 m driven: standard deviation


@dataclass(frozen=True)
class LaserSettings(Settings):
    """Settings of SLAM with a planar laser."""

    largest_range: Positive = setting(30.0, "m: readings beyond are left out; raise for halls and yards")
    largest_speed: Positive = setting(
        3.0, "m/s: steps of the wheels that are faster, and 1 m longer, count as standing still; raise for vehicles"
    )
    loop_score: Annotated[float, Range(0, 1)] = setting(0.6, "least mean score of a loop; raised: fewer, surer loops")
    loop_drift: Positive = setting(0.04, "half width of the search, share of the way since; raised: slower, finds more")


@dataclass(frozen=True, eq=False)
class LaserPath:
    """poses (n, 3, 3) of the robot at each scan, matched: by scan matching alone; loops taken, rejected as false;
    keyframes: their rows; graph: of these, with the measurements kept; wheel_scale: ways driven by those of the
    wheels; jumps: steps of the wheels too fast to believe.
    """

    poses: FloatArray
    matched: FloatArray
    loops: int
    rejected: int
    keyframes: IntArray
    graph: PoseGraph
    wheel_scale: float
    jumps: int = 0


@dataclass(eq=False)
class LaserSlam:
    """Scans in, poses out: `step` for each scan, `finish` at the end.

    robot_T_laser (3, 3); scale: of the wheels, estimated on the way; loops: False for scan matching alone
    """

    settings: LaserSettings = field(default_factory=LaserSettings)
    robot_T_laser: FloatArray = field(default_factory=lambda: np.eye(3))
    scale: WheelScale = field(default_factory=WheelScale)
    loops: bool = True
    _keyframes: list[Keyframe] = field(default_factory=list)
    _matched: list[FloatArray] = field(default_factory=list)
    _graph: RunningPoseGraph | None = None
    _map: LineMap | None = None
    _grid: ScoreGrid | None = None
    _at: FloatArray = field(default_factory=lambda: np.eye(3))
    _odometry: FloatArray | None = None
    _wheels: FloatArray = field(default_factory=lambda: np.eye(3))
    _information: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    _seen: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    _search: LoopSearch | None = None

    def step(self, points: FloatArray, odometry: FloatArray) -> FloatArray:
        """Take a scan, points (n, 2) in the laser's frame, and the wheels' pose (3,); returns the pose (3, 3) now.

        Raises `InputError` for other shapes, and for numbers that are not finite.
        """
        points, odometry = checked("points", points, (None, 2)), checked("odometry", odometry, (3,))
        points = points @ self.robot_T_laser[:2, :2].T + self.robot_T_laser[:2, 2]
        wheels = transform(odometry)
        step = np.eye(3) if self._odometry is None else self.scale.corrected(np.linalg.inv(self._odometry) @ wheels)
        if self._graph is None:  # by the wheels until a scan tells where it is
            self._at, self._odometry = self._at @ step, wheels
            self._matched.append(self._at)
            if len(points) >= _LEAST_POINTS:
                self._add_keyframe(points, self._at, np.eye(3))
            return self._at
        way, turn = np.hypot(step[0, 2], step[1, 2]), abs(heading(step))
        predicted = self._at @ step
        if (way < _SCAN_STEP and turn < np.deg2rad(3)) or len(points) < _LEAST_POINTS:
            self._matched.append(predicted)
            return self._now(predicted)
        before, self._at = self._at, self._registered(points, predicted, way, turn)
        self._odometry = wheels
        self.scale.update(step, np.linalg.inv(before) @ self._at, covariance_of(self._seen, self._at))
        self._matched.append(self._at)
        since = np.linalg.inv(self._keyframes[-1].matched) @ self._at
        if np.hypot(since[0, 2], since[1, 2]) > KEYFRAME_STEP or abs(heading(since)) > KEYFRAME_TURN:
            self._add_keyframe(points, self._at, since)
        return self._now(self._at)

    def finish(self, progress: Progress | None = None) -> LaserPath:
        """All poses, after false loops are left out and passes of one place are registered with each other.

        Raises `InputError` where no scan had enough points.
        """
        if self._graph is None:
            seen = f"{_LEAST_POINTS} readings within largest_range, {self.settings.largest_range:g} m"
            raise InputError(f"expected a scan with {seen}, there is none among {len(self._matched)}")
        agreed = self._graph.settled()
        loops = int((np.abs(agreed.graph.second - agreed.graph.first) > 1).sum())
        rejected = int((~agreed.kept).sum())
        graph = agreed.graph
        for turn, reach in enumerate(_REACHES):
            again = registered_passes(self._keyframes, graph.world_T_pose, reach, LOCAL_MAP, self.settings.loop_score)
            if progress is not None:
                progress("registering passes", turn + 1, len(_REACHES))
            if again:
                graph = self._graph.settled(again).graph
        rows = np.array([frame.row for frame in self._keyframes])
        poses = between_keyframes(np.stack(self._matched), graph.world_T_pose, rows)
        return LaserPath(poses, np.stack(self._matched), loops, rejected, rows, graph, self.scale.value)

    def _now(self, matched: FloatArray) -> FloatArray:
        assert self._graph is not None
        last = len(self._keyframes) - 1
        return np.asarray(self._graph.pose(last) @ np.linalg.inv(self._keyframes[last].matched) @ matched)

    def _registered(self, points: FloatArray, predicted: FloatArray, way: float, turn: float) -> FloatArray:
        """The pose in the local map, where odometry and the scan agree on it."""
        assert self._map is not None
        sigma = np.array([0.02 + ODOMETRY_DRIFT * way] * 2 + [0.01 + ODOMETRY_TURN * (turn + way / 2)])
        prior = np.diag(sigma**-2.0)
        scan = thinned(points, 0.05)
        fit = self._map.fit(scan, vector(predicted), prior, reach=min(1.0, 0.3 + way))
        if fit.share < _POOR:  # a fast turn, wheels that slipped, or much of what is seen is new
            local = scan if len(scan) <= 200 else scan[:: len(scan) // 200 + 1]
            self._grid = self._grid or ScoreGrid.of(self._map.points)
            found = self._grid.search(local, vector(predicted), min(0.2 + way / 2, _WIDEST), 0.1 + turn / 2, 0.4)
            if found is not None:
                other = self._map.fit(scan, found.pose, 0.01 * prior, reach=0.3)
                fit = max(fit, other, key=lambda each: each.share)
        self._seen = fit.information / SMEAR
        self._information = self._seen + prior
        return transform(fit.pose)

    def _add_keyframe(self, points: FloatArray, matched: FloatArray, since: FloatArray) -> None:
        frames, s, turn = self._keyframes, self.settings, abs(heading(since))
        assert self._odometry is not None
        way = frames[-1].way + float(path_lengths(since[None])[0]) if frames else 0.0
        frames.append(Keyframe(thinned(points, 0.03), matched, len(self._matched) - 1, way))
        if self._graph is None:
            self._graph = RunningPoseGraph(matched)
        else:
            wheels = self.scale.corrected(np.linalg.inv(self._wheels) @ self._odometry)
            off = vector(np.linalg.inv(since) @ wheels)
            doubt = _DOUBT * np.array([np.hypot(off[0], off[1])] * 2 + [abs(off[2])]) + [0.0, 0.0, _TURNING * turn]
            self._graph.append(since, covariance_of(self._information, matched) + np.diag(doubt**2))
        self._wheels = self._odometry
        recent = [frame for frame in frames if frame.way > way - LOCAL_MAP]
        self._map = LineMap.of(np.concatenate([moved(frame.points, frame.matched) for frame in recent]))
        self._grid = None
        if not self.loops:
            return
        self._search = self._search or LoopSearch(frames, self._graph, SUBMAP, s.loop_drift, s.loop_score)
        self._search.extend()
        if len(frames) % 2 == 0:
            loops = self._search.loops(len(frames) - 1)
            if loops or len(frames) % 20 == 0:
                self._graph.close(loops)


def laser_slam(log: LaserLog, settings: LaserSettings | None = None, progress: Progress | None = None) -> LaserPath:
    """The path of a log. Raises `InputError` for one without odometry, and where no scan has enough points."""
    settings = settings or LaserSettings()
    warn_of_times(log.time)
    check_wheels(log)
    odometry, jumps = without_jumps(log, settings.largest_speed)
    slam = LaserSlam(settings, transform(log.robot_T_laser), _wheel_scale(log, odometry, settings))
    for row in range(len(log)):
        slam.step(log.points(row, slam.settings.largest_range), odometry[row])
        if progress is not None:
            progress("scans", row + 1, len(log))
    return replace(slam.finish(progress), jumps=jumps)


def _wheel_scale(log: LaserLog, odometry: FloatArray, settings: LaserSettings) -> WheelScale:
    """The scale of the wheels from the log: what is driven before it is known shall count alike."""
    slam = LaserSlam(settings, transform(log.robot_T_laser), loops=False)
    for row in range(len(log)):
        slam.step(log.points(row, settings.largest_range), odometry[row])
        if slam.scale.known:
            break
    return slam.scale
