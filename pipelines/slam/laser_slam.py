"""SLAM with a planar laser and wheel odometry: `pipelines.slam.driver` in the plane.

A keyframe comes every half metre or 30 degrees. At the end false loops are found, and all keyframes are registered anew
with every other pass of the same place, twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_tools.laser import LaserLog
from data_tools.laser.mapping import LineMap
from pipelines.slam.driver import FrontEnd, Slam
from pipelines.slam.laser_odometry import (
    LEAST_POINTS,
    LOCAL_MAP,
    SUBMAP,
    TANGENT,
    Keyframe,
    LaserLoops,
    LaserOdometry,
    LaserSettings,
    check_wheels,
    joined,
    level_scan,
    measured_by,
    warn_of_times,
    without_jumps,
)
from pipelines.slam.vehicle_sensors import WheelScale
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray, checked, in_plane, in_space, moved, transform, vector
from saga_fg.slam.pose_graph import PoseGraph, consensus, trusted
from saga_fg.slam.pose_graph.consensus import chosen_edges
from saga_fg.slam.submaps import SubmapSettings

_NEARBY = 3.0  # m between keyframes that see the same walls
_GAP = 5.0  # m of way without a keyframe nearby, from which on it is another pass
_SHARED = 3  # keyframes in a row that share a map
_MOST_PASSES = 4  # that a keyframe is registered with
_PRIOR = np.diag([100.0, 100.0, 1000.0])  # information of the graph about where the other pass is


def registered_passes(
    frames: Sequence[Keyframe], poses: FloatArray, reach: float, least_share: float
) -> list[tuple[int, int, FloatArray, FloatArray]]:
    """Registrations of each keyframe with the map of every other pass nearby, of points within `reach`, m.

    poses (n, 3, 3) of the keyframes; least_share: of the points that must lie on the map. Returns both keyframes of
    each, the second's pose (3, 3) in the first, and its covariance (3, 3).
    """
    found = list[tuple[int, int, FloatArray, FloatArray]]()
    maps: dict[int, LineMap] = {}
    places = poses[:, :2, 2]
    way = np.array([frame.way for frame in frames])
    for row in range(len(poses)):
        apart = np.linalg.norm(places[:row] - places[row], axis=1)
        others = np.flatnonzero((apart < _NEARBY) & (way[:row] < way[row] - 2 * LOCAL_MAP))
        if not len(others):
            continue
        runs = np.split(others, np.flatnonzero(np.diff(way[others]) > _GAP) + 1)
        nearest = sorted((int(run[np.argmin(apart[run])]) for run in runs), key=lambda k: apart[k])
        for other in dict.fromkeys(near // _SHARED * _SHARED for near in nearest[:_MOST_PASSES]):
            if other not in maps:
                around = [frame for frame in frames if abs(frame.way - way[other]) < LOCAL_MAP / 3]
                maps[other] = LineMap.of(joined(around, frames[other]))
            guess = np.linalg.inv(poses[other]) @ poses[row]
            fit = maps[other].fit(frames[row].points, vector(guess), _PRIOR, reach)
            if fit.share > least_share:
                found.append((other, row, *measured_by(fit)))
    return found


_REACHES = (0.6, 0.3)  # m, of registrations with other passes, in turn
_POINTS = 0.03  # m between points of submaps


def _planar(graph: PoseGraph) -> PoseGraph:
    """A graph of level poses in the plane, without its prior: the first pose is held."""
    poses, between = in_plane(graph.world_T_pose), in_plane(graph.first_T_second)
    information = graph.information[:, TANGENT[:, None], TANGENT]
    return PoseGraph(graph.ids, poses, graph.first, graph.second, between, information)


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


class LaserSlam:
    """Scans in, poses out: `step` for each scan, `finish` at the end.

    robot_T_laser (3, 3); scale: of the wheels, estimated on the way
    """

    def __init__(
        self,
        settings: LaserSettings | None = None,
        robot_T_laser: FloatArray | None = None,
        scale: WheelScale | None = None,
    ) -> None:
        self.settings, self.odometry = settings or LaserSettings(), LaserOdometry(scale)
        self._robot_T_laser = np.eye(3) if robot_T_laser is None else robot_T_laser
        loops = LaserLoops(self.odometry.keyframes, self.settings)
        front_end = FrontEnd(self.odometry, SubmapSettings(length=SUBMAP), _POINTS, loops, lambda points: [])
        self._slam, self._scans, self._points = Slam(front_end), 0, 0

    def step(self, points: FloatArray, odometry: FloatArray) -> FloatArray:
        """Take a scan, points (n, 2) in the laser's frame, and the wheels' pose (3,); returns the pose (3, 3) now.

        Raises `InputError` for other shapes, and for numbers that are not finite.
        """
        points, odometry = checked("points", points, (None, 2)), checked("odometry", odometry, (3,))
        self.odometry.wheels = transform(odometry)
        placed = self._slam.step(level_scan(moved(points, self._robot_T_laser)), float(self._scans))
        self._scans, self._points = self._scans + 1, max(self._points, len(points))
        return in_plane(placed.world_T_lidar)

    def finish(self, progress: Progress | None = None) -> LaserPath:
        """All poses, after false loops are left out and passes of one place are registered with each other.

        Raises `InputError` where no scan had enough points.
        """
        s, frames = self.settings, self.odometry.keyframes
        if self._points < LEAST_POINTS:
            seen = f"{LEAST_POINTS} readings within largest_range, {s.largest_range:g} m"
            raise InputError(f"expected a scan with {seen}, there is none among {self._scans}")
        result = self._slam.finish()
        graph, drive = _planar(result.pose_graph()), result.drive
        for turn, reach in enumerate(_REACHES):
            found = registered_passes(frames, graph.world_T_pose, reach, s.loop_score)
            if progress is not None:
                progress("registering passes", turn + 1, len(_REACHES))
            if found:
                graph = consensus(_with_loops(graph, found)).graph
        poses, matched = in_plane(drive.carried(in_space(graph.world_T_pose))), in_plane(np.array(drive.poses))
        counts, scale = (len(result.loops), len(result.false_loops)), self.odometry.scale.value
        return LaserPath(poses, matched, *counts, result.keyframes, graph, scale)


def _with_loops(graph: PoseGraph, found: Sequence[tuple[int, int, FloatArray, FloatArray]]) -> PoseGraph:
    """The odometry of a graph, with other loops."""
    odometry = chosen_edges(graph, trusted(graph))
    first, second, between, covariance = (np.array(column) for column in zip(*found, strict=True))
    information = np.linalg.inv(covariance)
    return replace(
        odometry,
        first=np.concatenate([odometry.first, first]),
        second=np.concatenate([odometry.second, second]),
        first_T_second=np.concatenate([odometry.first_T_second, between]),
        information=np.concatenate([odometry.information, (information + information.swapaxes(1, 2)) / 2]),
    )


def laser_slam(log: LaserLog, settings: LaserSettings | None = None, progress: Progress | None = None) -> LaserPath:
    """The path of a log. Raises `InputError` for one without odometry, and where no scan has enough points."""
    s, robot_T_laser = settings or LaserSettings(), transform(log.robot_T_laser)
    warn_of_times(log.time)
    check_wheels(log)
    wheels, jumps = without_jumps(log, s.largest_speed)
    odometry = LaserOdometry()  # tells the scale of the wheels: what is driven before it is known shall count alike
    for row in range(len(log)):
        odometry.wheels = transform(wheels[row])
        odometry.step(level_scan(moved(log.points(row, s.largest_range), robot_T_laser)), float(row))
        if odometry.scale.known:
            break
    slam = LaserSlam(s, robot_T_laser, odometry.scale)
    for row in range(len(log)):
        slam.step(log.points(row, s.largest_range), wheels[row])
        if progress is not None:
            progress("scans", row + 1, len(log))
    return replace(slam.finish(progress), jumps=jumps)
