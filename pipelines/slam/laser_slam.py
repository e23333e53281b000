"""SLAM with a planar laser and wheel odometry: a front end of `pipelines.slam.driver` in the plane.

Each scan that has moved is registered with a map of the last keyframes, point to line; the wheels, without implausible
steps, are its prior. A keyframe comes every half metre or 30 degrees.

Loops: keyframes of a closed submap are searched for in older submaps, by branch and bound. The window is what the graph
leaves open: it grows with the way along measurements between the two, so that what has been closed before is searched
closely and what has drifted widely. A place that has a rival is no loop; one found in a wide window waits for another
that agrees with it. Along a bare corridor a scan tells no place.

At the end false loops are found, and all keyframes are registered anew with every other pass of the same place, twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from data_tools.laser import (
    SMEAR,
    Fit,
    LaserLog,
    LineMap,
    ScoreGrid,
    check_wheels,
    thinned,
    warn_of_times,
    without_jumps,
)
from data_tools.lidar import Scan, Submap
from pipelines.slam.drive import motion
from pipelines.slam.driver import FrontEnd, Slam
from pipelines.slam.loop_closures import Agreement, LoopSearch
from pipelines.slam.odometry import OdometryStep
from pipelines.slam.vehicle_sensors import WheelScale
from pipelines.tracking import Progress
from saga_fg import InputError
from saga_fg.numerics import (
    FloatArray,
    IntArray,
    carried_covariance,
    checked,
    heading,
    in_plane,
    in_space,
    inverse_transform,
    moved,
    transform,
    vector,
)
from saga_fg.settings import Positive, Range, Settings, setting
from saga_fg.slam.pose_graph import PoseGraph, chosen_edges, consensus, trusted
from saga_fg.slam.submaps import LoopClosure, Motion, SubmapSettings

_FLOOR = np.array([0.01, 0.01, 0.002]) ** 2  # variance of a registration of any number of points, m^2 and rad^2
_DETERMINED = 0.05  # ratio of information along and across below which a place is a bare corridor


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Points (n, 2) of a scan, its pose (3, 3) by scan matching alone, and the way until there, m.

    covariance: (3, 3) of the motion since the keyframe before, in its own frame
    """

    points: FloatArray
    matched: FloatArray
    travelled: float
    covariance: FloatArray


def joined(frames: Sequence[Keyframe], centre: Keyframe) -> FloatArray:
    """Points (n, 2) of keyframes in the frame of `centre`."""
    back = np.linalg.inv(centre.matched)
    return np.concatenate([moved(frame.points, back @ frame.matched) for frame in frames])


def measured_by(fit: Fit) -> tuple[FloatArray, FloatArray]:
    """The pose (3, 3) that a registration measured, and its covariance (3, 3)."""
    measured = transform(fit.pose)
    return measured, covariance_of(_firm(fit.information) / SMEAR, measured)


def determined(information: FloatArray) -> bool:
    """True if a registration determines the place in all directions: not along a bare corridor."""
    values = np.linalg.eigvalsh(information[:2, :2])
    return bool(values[0] > _DETERMINED * values[1])


def _firm(information: FloatArray) -> FloatArray:
    """Information without what scatter seems to say along a bare corridor."""
    values, vectors = np.linalg.eigh(information[:2, :2])
    ratio = values[0] / max(values[1], 1e-9)
    if ratio >= _DETERMINED:
        return information
    S = np.eye(3)
    S[:2, :2] -= (1 - max(ratio, 0.0) / _DETERMINED) * np.outer(vectors[:, 0], vectors[:, 0])
    return np.asarray(S @ information @ S)


def covariance_of(information: FloatArray, pose: FloatArray) -> FloatArray:
    """Covariance in the pose's own frame of what is known in the axes of the map."""
    R = np.eye(3)
    R[:2, :2] = pose[:2, :2]
    own = R.T @ np.linalg.inv(information + np.diag([1e-3, 1e-3, 1e-3])) @ R
    return np.asarray((own + own.T) / 2 + np.diag(_FLOOR))


TANGENT = np.array([3, 4, 2])  # x, y and heading in the tangent of a pose in space
_LEVEL = 1e-6  # rad^2 and m^2: variance out of the plane


def covariance_in_space(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a level pose in space, by that of x, y and heading (3, 3)."""
    whole = _LEVEL * np.eye(6)
    whole[TANGENT[:, None], TANGENT] = covariance
    return whole


def level_scan(points: FloatArray) -> Scan:
    """Points (n, 2) as a scan at z = 0."""
    return Scan.of(np.column_stack([points, np.zeros(len(points))]))


@dataclass(frozen=True)
class LaserSettings(Settings):
    """Settings of SLAM with a planar laser."""

    largest_range: Positive = setting(30.0, "m: readings beyond are left out; raise for halls and yards")
    largest_speed: Positive = setting(
        3.0, "m/s: steps of the wheels that are faster, and 1 m longer, count as standing still; raise for vehicles"
    )
    loop_score: Annotated[float, Range(0, 1)] = setting(0.6, "least mean score of a loop; raised: fewer, surer loops")
    loop_drift: Positive = setting(0.04, "half width of the search, share of the way since; raised: slower, finds more")


_SCAN_STEP = 0.1  # m: scans that moved less, and turned less than 3 degrees, are not registered
LEAST_POINTS = 20  # of a scan that is registered
_WIDEST = 3.0  # m, half width of the search where wheels slipped: its time and memory grow with the square
_POOR = 0.8  # share of a scan that lies on the local map, below which the pose is searched
_DOUBT = 0.2  # share of a difference between wheels and registration that counts as standard deviation: one errs
_TURNING = 0.01  # error of the heading that registration in a turn makes, rad per rad
KEYFRAME_STEP = 0.5  # distance between keyframes, m
KEYFRAME_TURN = 0.5  # turn between keyframes, rad
LOCAL_MAP = 10.0  # m travelled whose keyframes scans are registered with
ODOMETRY_DRIFT = 0.15  # error of the wheels, share of the way: standard deviation
ODOMETRY_TURN = 0.1  # error of the wheels' heading, rad for each rad turned and for each 2 m driven: standard deviation
_RADIAN = 1.0  # m travelled that a radian of turning counts as


class LaserOdometry:
    """Places level scans, points in the robot's frame, by the wheels and the last keyframes.

    wheels: their pose (3, 3) at the next scan, set before `step`; keyframes: so far; scale: of the wheels
    """

    def __init__(self, scale: WheelScale | None = None) -> None:
        self.scale, self.keyframes = scale or WheelScale(), list[Keyframe]()
        self.wheels: FloatArray = np.eye(3)
        self._at = self._last = np.eye(3)  # the scan registered last, and its wheels
        self._at_keyframe = np.eye(3)  # the wheels at the last keyframe
        self._map: LineMap | None = None
        self._grid: ScoreGrid | None = None
        self._since = 0  # scans since the last keyframe

    def step(self, scan: Scan, timestamp: float, velocity: FloatArray | None = None) -> OdometryStep:
        """Place the next scan."""
        points, first = scan.points[:, :2], not self.keyframes
        if first:
            self._last = self._at_keyframe = self.wheels
        rolled = self._rolled(self._last)
        at, travelled, turn = self._at @ rolled, float(np.hypot(rolled[0, 2], rolled[1, 2])), abs(heading(rolled))
        sigma = np.array([0.02 + ODOMETRY_DRIFT * travelled] * 2 + [0.01 + ODOMETRY_TURN * (turn + travelled / 2)])
        covariance, keyframe, lost = np.diag(sigma**2), first, 0
        still = travelled < _SCAN_STEP and turn < np.deg2rad(3)
        if len(points) >= LEAST_POINTS and (self._map is None or not still):
            if self._map is not None:
                fit = self._registered(self._map, points, at, np.diag(sigma**-2.0), travelled, turn)
                before, at = self._at, transform(fit.pose)
                driven, P = np.linalg.inv(before) @ at, covariance_of(fit.information / SMEAR, at)
                self.scale.update(float(rolled[0, 2]), float(driven[0, 2]), float(P[0, 0]))
                covariance = self._doubted(covariance_of(fit.information / SMEAR + np.diag(sigma**-2.0), at), at)
                lost = self._since
            since = np.linalg.inv(self.keyframes[-1].matched) @ at if self.keyframes else np.eye(3)
            keyframe = (
                self._map is None or np.hypot(*since[:2, 2]) > KEYFRAME_STEP or abs(heading(since)) > KEYFRAME_TURN
            )
            self._at, self._last = at, self.wheels
        if keyframe:
            self._add_keyframe(points, at, covariance)
        self._since = 0 if keyframe else self._since + 1
        P = np.zeros((6, 6)) if first else covariance_in_space(covariance)
        return OdometryStep(timestamp, in_space(at), P, scan, keyframe, None, lost=lost)

    def _rolled(self, since: FloatArray) -> FloatArray:
        """The motion (3, 3) by the wheels, in true metres, since they were at a pose (3, 3)."""
        step = np.linalg.inv(since) @ self.wheels
        step[:2, 2] *= self.scale.value
        return np.asarray(step)

    def _registered(
        self,
        local: LineMap,
        points: FloatArray,
        predicted: FloatArray,
        prior: FloatArray,
        travelled: float,
        turn: float,
    ) -> Fit:
        """The pose in the local map, where the wheels, of information `prior`, and the scan agree on it."""
        scan = thinned(points, 0.05)
        fit = local.fit(scan, vector(predicted), prior, reach=min(1.0, 0.3 + travelled))
        if fit.share >= _POOR:
            return fit
        few = scan if len(scan) <= 200 else scan[:: len(scan) // 200 + 1]
        self._grid = self._grid or ScoreGrid.of(local.points)  # a fast turn, wheels that slipped, or much is new
        found = self._grid.search(few, vector(predicted), min(0.2 + travelled / 2, _WIDEST), 0.1 + turn / 2, 0.4)
        if found is None:
            return fit
        return max(fit, local.fit(scan, found.pose, 0.01 * prior, reach=0.3), key=lambda each: each.share)

    def _doubted(self, covariance: FloatArray, at: FloatArray) -> FloatArray:
        """The covariance of the motion since the last keyframe, larger where the wheels say otherwise."""
        since = np.linalg.inv(self.keyframes[-1].matched) @ at
        off = vector(np.linalg.inv(since) @ self._rolled(self._at_keyframe))
        doubt = _DOUBT * np.array([np.hypot(off[0], off[1])] * 2 + [abs(off[2])])
        doubt[2] += _TURNING * abs(heading(since))
        return np.asarray(covariance + np.diag(doubt**2))

    def _add_keyframe(self, points: FloatArray, at: FloatArray, covariance: FloatArray) -> None:
        frames, travelled = self.keyframes, 0.0
        if frames:
            since = np.linalg.inv(frames[-1].matched) @ at
            travelled = frames[-1].travelled + float(np.hypot(*since[:2, 2])) + _RADIAN * abs(heading(since))
        frames.append(Keyframe(thinned(points, 0.03), at, travelled, covariance))
        self._at_keyframe = self.wheels
        recent = np.concatenate(
            [moved(one.points, one.matched) for one in frames if one.travelled > travelled - LOCAL_MAP]
        )
        self._map, self._grid = LineMap.of(recent) if len(recent) >= LEAST_POINTS else None, None


_KNOWN_SHARE = 0.8  # m, half width of a window up to which a corridor may be recognised: it then says nothing along it
_UNSURE = 1.5  # m, half width from which a loop waits for another that agrees with it
_ACROSS = 5.0  # m from the middle of a submap that it is searched from, besides the window
_UNIQUE = 0.92  # share of the best score that a rival may have
_LONGEST = 60.0  # m travelled from which the search of headings does not grow
_BENT = np.diag([0.0, 0.0, 0.003, 0.03, 0.03, 0.0]) ** 2  # rad^2 and m^2, of the submap that is searched
_EVERY = 2  # keyframes of which one is searched for
SUBMAP = 10.0  # m travelled in a submap in which loops are searched


class LaserLoops(LoopSearch):
    """Loops of a planar laser; keyframes: the growing list of those that submaps are made of."""

    def __init__(self, keyframes: Sequence[Keyframe], settings: LaserSettings) -> None:
        super().__init__(SUBMAP, Agreement(np.array([0.3, 0.06]), np.array([0.03, 0.003]), patience=15.0))
        self._keyframes, self._settings = keyframes, settings
        self._maps = dict[int, tuple[ScoreGrid, LineMap, FloatArray]]()  # of submaps, with their middles

    def found(
        self, submap: Submap, older: IntArray, travelled: FloatArray, frames: FloatArray
    ) -> list[tuple[LoopClosure, bool]]:
        first, end = submap.keyframes
        at, found = in_plane(frames), list[tuple[LoopClosure, bool]]()
        frames_of = self._keyframes[first:end]
        path = in_space(np.array([one.matched for one in frames_of]))
        noise = np.array([covariance_in_space(one.covariance) for one in frames_of])
        known = [number for number in older.tolist() if number in self._maps]
        for k in range(0, end - first, _EVERY):
            inner = motion(path[: k + 1], noise[1 : k + 1])
            found += self._loops(first + k, inner, at, np.array(known, dtype=np.int64), travelled)
        points = submap.points[:, :2].astype(np.float64)
        middle = (inverse_transform(path[0]) @ path[len(path) // 2])[[0, 1, 3], 3]
        if len(points) >= LEAST_POINTS:
            self._maps[len(frames) - 1] = ScoreGrid.of(points), LineMap.of(points), middle
        return found

    def driven(self, submap: Submap) -> float:
        return self._keyframes[submap.keyframes[1] - 1].travelled

    def _loops(
        self, row: int, inner: Motion, at: FloatArray, older: IntArray, travelled: FloatArray
    ) -> list[tuple[LoopClosure, bool]]:
        """Loops of a keyframe to the nearest older submaps whose windows reach it; inner: since the submap began."""
        recent = self._keyframes[max(0, row - 4) : row + 1]
        source, found = thinned(joined(recent, recent[-1]), 0.2), list[tuple[LoopClosure, bool]]()
        if not len(older) or len(source) < LEAST_POINTS:
            return found
        window, world = 0.5 + self._settings.loop_drift * travelled[older], at[-1] @ in_plane(inner[0])
        middles = np.array([(at[number] @ self._maps[number][2])[:2] for number in older.tolist()])
        apart = np.linalg.norm(middles - world[:2, 2], axis=1)
        near = np.flatnonzero(apart < _ACROSS + window)
        near = near[np.argsort(apart[near])]
        for k in near[: 3 + int(window[near].min(initial=0.0))].tolist():
            number = int(older[k])
            turn = np.deg2rad(5) + 0.01 * min(travelled[number], _LONGEST)
            measured = self._matched(number, row, source, np.linalg.inv(at[number]) @ world, window[k], float(turn))
            if measured is not None:
                T, P = in_space(measured[0]) @ inverse_transform(inner[0]), covariance_in_space(measured[1]) + inner[1]
                loop = LoopClosure(number, len(at) - 1, T, carried_covariance(inner[0], P + _BENT))
                found.append((loop, bool(window[k] >= _UNSURE)))
                if len(found) >= 2:
                    break
        return found

    def _matched(
        self, number: int, row: int, source: FloatArray, guess: FloatArray, window: float, turn: float
    ) -> tuple[FloatArray, FloatArray] | None:
        """Pose of a keyframe in a submap, and its covariance; None where it does not fit, or elsewhere as well."""
        s, (grid, lines, _) = self._settings, self._maps[number]
        found = grid.search(source, vector(guess), window, turn, s.loop_score)
        if found is None or found.rival > _UNIQUE * found.score:
            return None
        fit = lines.fit(self._keyframes[row].points, found.pose, np.diag([1.0, 1.0, 10.0]), reach=0.4)
        if fit.share < s.loop_score or (window > _KNOWN_SHARE and not determined(fit.information)):
            return None
        return measured_by(fit)


_NEARBY = 3.0  # m between keyframes that see the same walls
_GAP = 5.0  # m travelled without a keyframe nearby, from which on it is another pass
_SHARED = 3  # keyframes in a row that share a map
_MAX_PASSES = 4  # that a keyframe is registered with
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
    travelled = np.array([frame.travelled for frame in frames])
    for row in range(len(poses)):
        apart = np.linalg.norm(places[:row] - places[row], axis=1)
        others = np.flatnonzero((apart < _NEARBY) & (travelled[:row] < travelled[row] - 2 * LOCAL_MAP))
        if not len(others):
            continue
        runs = np.split(others, np.flatnonzero(np.diff(travelled[others]) > _GAP) + 1)
        nearest = sorted((int(run[np.argmin(apart[run])]) for run in runs), key=lambda k: apart[k])
        for other in dict.fromkeys(near // _SHARED * _SHARED for near in nearest[:_MAX_PASSES]):
            if other not in maps:
                around = [frame for frame in frames if abs(frame.travelled - travelled[other]) < LOCAL_MAP / 3]
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
    keyframes: their rows; graph: of these, with the measurements kept; wheel_scale: distances travelled by those of the
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
