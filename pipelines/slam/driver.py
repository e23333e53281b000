"""SLAM scan by scan, for any front end: odometry, keyframes, submaps and landmarks, loops, in one graph.

    prior         the first pose
    odometry      || log( (T_k^-1 T_(k+1))^-1  D_k ) ||_{P_k}      between successive keyframes
    sensors       GPS, inertial samples and wheels of the vehicle, where there are any
    landmarks     observed at keyframes, associated within the running submap
    loops         || log( (T_i^-1 T_j)^-1  L_ij ) ||, robust       places that the vehicle came back to

A front end says what is particular to a sensor: how a scan is registered with a local map, what a submap keeps, how
places are recognised, and which landmarks a scan shows. Those of a planar laser move in the plane z = 0.

`saga_fg.slam.submaps` keeps the graph small. The points of keyframes are thinned to one cloud a submap and dropped when
it is closed; then loops are searched for. At the end everything is solved together, and covariances are read off.
Where the scan leaves a motion open, as along a tunnel, its covariance is wide and the sensors decide.
Scans between keyframes go along with the keyframe before them, by their odometry.

Moving objects: their points are left out before odometry, landmarks and map see the scan. Objects are tracked along the
path so far, at the pose where the next scan is expected. One is faster than 1 m/s with the probability
Phi((|v| - 1 m/s) / sigma), sigma the deviation of its speed, and leaves the scan where that is at least 0.9: by 1.3
deviations. So new objects, whose velocity nobody knows, stay. Detections in another frame, or of other scans, have
boxes where the scan shows nothing. Where most of the first ones near the sensor are empty, a warning says so.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.special import ndtr

from data_tools.lidar import Scan, Submap, inside_boxes, without_objects
from data_tools.trajectories import Trajectory
from pipelines.slam.drive import Drive, moved_pose
from pipelines.slam.loop_closures import LoopSearch, Submaps
from pipelines.slam.odometry import Odometry, OdometryStep
from pipelines.slam.vehicle_sensors import Vehicle, VehicleSensors
from saga_fg import InputError, Tracker
from saga_fg.graph import FactorProvider
from saga_fg.numerics import FloatArray, IntArray, checked_transform
from saga_fg.slam.joint import JointEstimate
from saga_fg.slam.pose_graph import PoseGraph, PosePriors
from saga_fg.slam.submaps import LoopClosure, LoopSelection, SubmapGraph, SubmapSettings, drive_graph
from saga_fg.types import (
    Boxes,
    Detections,
    EgoMeasurements,
    Frame,
    GpsFix,
    ImuSamples,
    Landmark,
    Observation,
    WheelSpeed,
)

START = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2  # of the first pose, which is where the world begins


@dataclass(frozen=True, eq=False)
class SlamStep:
    """One scan placed.

    world_T_lidar  (4, 4) the sensor's pose now, in the map
    covariance     (6, 6) of that, (rotation, translation) in the sensor's frame, rad^2, m^2
    odometry       what the odometry said of the scan
    keyframe       number of the keyframe that the scan became, None for none
    submap         the one that it closed, None for none
    loops          those found in it, between keyframes
    """

    world_T_lidar: FloatArray
    covariance: FloatArray
    odometry: OdometryStep
    keyframe: int | None
    submap: Submap | None
    loops: tuple[LoopClosure, ...]


@dataclass(frozen=True, eq=False)
class SlamResult:
    """Result for K scans, M of them keyframes, in S submaps, in the world of the first pose.

    drive          the odometry; its keyframes (M,) are rows among the scans
    odometry       (K) poses of the vehicle by odometry alone; trajectory (K): by the graph; online (K): as estimated
                   when the scan came
    covariances    (M, 6, 6) of the keyframes' poses, (rotation, translation) in the sensor's frame, rad^2, m^2
    landmarks      of the map, those seen more than once
    observations   (M) of each keyframe, with the number of the landmark
    loops          that were closed and agree with each other, between keyframes
    false_loops    those that do not, and are left out of the solution
    selection      how loops were chosen, and deviations of odometry to those stated, as they demand
    degenerate     (K) motions that each scan left open, in words
    moving         (K) boxes of moving objects that were left out of each scan, in its frame
    misfits        what does not fit of the vehicle's sensors, in words, by their names
    unjudged       sensors that have measured too little to tell, likewise
    submaps        S, and world_T_submap (S, 4, 4) their places
    world_T_lidar  (M, 4, 4) poses of the keyframes
    objects        poses of the sensor, errors of the odometry and objects in the world, where these are in the graph
    alone          (K) poses of the vehicle by the graph without the objects
    """

    drive: Drive
    odometry: Trajectory
    trajectory: Trajectory
    online: Trajectory
    covariances: FloatArray
    landmarks: Sequence[Landmark]
    observations: Sequence[Sequence[tuple[int, Observation]]]
    loops: Sequence[LoopClosure]
    false_loops: Sequence[LoopClosure]
    selection: LoopSelection
    degenerate: Sequence[tuple[str, ...]]
    moving: Sequence[Boxes]
    misfits: Mapping[str, str]
    unjudged: Mapping[str, str]
    submaps: Sequence[Submap]
    world_T_submap: FloatArray
    world_T_lidar: FloatArray
    objects: JointEstimate | None = None
    alone: Trajectory | None = None

    def motions(self, rows: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
        """Motions (4, 4) from each of these scans to the next by odometry, and their covariances (6, 6) at the end, as
        in the solution."""
        moved = (self.drive.moved(a, b) for a, b in pairwise(rows))
        return [(T, self.selection.inflated(P)) for T, P in moved]

    @property
    def keyframes(self) -> IntArray:
        """(M,) rows of the keyframes among the scans."""
        return np.array(self.drive.keyframes, dtype=np.int64)

    def pose_graph(self) -> PoseGraph:
        """Keyframes 0 .. M - 1 with the odometry between them and the loops."""
        first = PosePriors(np.zeros(1, dtype=np.int64), self.drive.poses[0][None], np.linalg.inv(START)[None])
        return drive_graph(self.motions(self.drive.keyframes), self.loops, first).at(self.world_T_lidar)


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
        self._filled += [bool(inside_boxes(scan.points, raised.select([row]), 0.0).any()) for row in range(len(near))]
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


@dataclass(frozen=True, eq=False)
class FrontEnd:
    """The parts of SLAM that are particular to a sensor.

    odometry  registers each scan with a local map
    submaps   settings of the graph; spacing: of the points that submaps keep, m
    loops     search for loops between submaps, None for none
    observe   gives the landmarks in points (N, 3) of a keyframe
    """

    odometry: Odometry
    submaps: SubmapSettings
    spacing: float
    loops: LoopSearch | None
    observe: Callable[[FloatArray], Sequence[Observation]]


class Slam:
    """SLAM of a drive: `step` takes scan by scan, `finish` gives the map.

    front_end   of the sensor
    start       (4, 4) the sensor's first pose in the world, z up, or that and its covariance (6, 6), in its frame
    providers   of other factors, asked at every keyframe
    moving      leaves points on moving objects out of the scans, by the detections that `step` gets
    vehicle     whose path the result has, where the sensor is on it, and the sensors whose measurements `step` gets

    A scan that `step` refuses is left out, and the next can follow. If a provider or detector raises, the scan is
    placed by odometry and becomes no keyframe.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        start: FloatArray | tuple[FloatArray, FloatArray] | None = None,
        providers: Sequence[FactorProvider] = (),
        moving: MovingObjects | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        self._front_end, self._odometry = front_end, front_end.odometry
        pose, first = start if isinstance(start, tuple) else (start, START)
        self._first: FloatArray = first
        self._start = np.eye(4) if pose is None else checked_transform("start", pose)
        self._sensors, self._moving = VehicleSensors(vehicle or Vehicle(), bool(providers)), moving
        self._others = bool(providers)
        both = [*self._sensors.new_providers(), *providers]
        self._new_graph = partial(SubmapGraph, settings=front_end.submaps, providers=both)
        self._graph = self._new_graph(self._start, self._first)
        self._submaps = Submaps(front_end.spacing, front_end.loops)
        self._path, self._online = Drive(), list[FloatArray]()
        self._degenerate, self._boxes = list[tuple[str, ...]](), list[Boxes]()  # of all scans
        self._covariance = self._first  # of the last keyframe's pose

    def step(
        self,
        scan: Scan,
        time: float,
        imu: ImuSamples | None = None,
        gps: GpsFix | None = None,
        detections: Detections | None = None,
        wheels: WheelSpeed | None = None,
    ) -> SlamStep:
        """Place the next scan, taken at `time`, s.

        imu: samples since the scan before; gps: a fix at this scan; detections: of objects, in the sensor's frame;
        wheels: speed since the scan before, which also predicts the motion. The providers read them from `view.frame`.
        A keyframe has the newest fix since the one before, with its age; detections of other scans are left out.
        Raises `InputError` for a scan that is not later than the one before, for a first scan without points, for a
        measurement or detections that nothing reads, and after `finish`. A later scan without points lies where it was
        predicted, with the deviation that the settings say, until one is registered again.
        """
        self._path.check(scan, time)
        measured = EgoMeasurements(gps=gps, imu=imu, wheels=wheels)
        self._sensors.check(measured)
        if detections is not None and self._moving is None and not self._others:
            raise InputError("detections: expected with `moving`, or with providers that read them")
        moving = Boxes.empty()
        if self._moving is not None and detections is not None:
            self._moving.check(scan, detections)
            moving = self._moving.boxes(time, detections, self._path.expected(time) if len(self._path) else self._start)
            scan = without_objects(scan, moving)
        placed = self._sensors.placed(self._odometry, scan, time, measured)
        if not self._path.keyframes:
            placed = replace(placed, keyframe=True)
        self._degenerate.append(placed.degenerate)
        self._boxes.append(moving)
        self._path.add(time, self._start @ placed.map_T_lidar, placed)
        self._online.append(self._path.poses[-1])
        row, submap, known = len(self._path) - 1, None, len(self._submaps.loops)
        if placed.keyframe:
            submap = self._add_keyframe(row, placed, detections)
        since = self._path.moved(self._path.keyframes[-1])
        self._online[-1], now = moved_pose(self._graph.pose(len(self._graph) - 1), self._covariance, since)
        number = len(self._path.keyframes) - 1 if placed.keyframe else None
        return SlamStep(self._online[-1], now, placed, number, submap, tuple(self._submaps.loops[known:]))

    @property
    def submaps(self) -> Sequence[Submap]:
        """The submaps that are closed."""
        return self._submaps.closed

    def keyframe(self, number: int) -> FloatArray:
        """The pose (4, 4) of a keyframe, as estimated now."""
        return self._graph.pose(number)

    def finish(self) -> SlamResult:
        """Close the last submap, and solve everything together."""
        if not self._path.keyframes:
            raise InputError("expected at least one scan before the end, and a keyframe")
        self._path.close()
        self._submaps.close(self._graph, self._graph.poses())
        solved = self._graph.finish()
        fit = self._sensors.consistency
        fit.observe(solved.graph)
        fit.warn()
        drive = self._path
        submaps, (true_loops, false_loops) = self._submaps.closed, self._submaps.judged(solved.loops)
        times, lidar_T_ego = np.array(self._path.times), self._sensors.lidar_T_ego
        return SlamResult(
            drive,
            Trajectory(times, np.array(drive.poses) @ lidar_T_ego),
            Trajectory(times, drive.carried(solved.world_T_pose) @ lidar_T_ego),
            Trajectory(times, np.array(self._online) @ lidar_T_ego),
            solved.covariances,
            solved.landmarks,
            self._graph.seen,
            true_loops,
            false_loops,
            solved.loops,
            self._degenerate,
            self._boxes,
            fit.misfits,
            fit.unjudged,
            submaps,
            np.array([submap.frame(solved.world_T_pose) for submap in submaps]),
            solved.world_T_pose,
        )

    def _add_keyframe(self, row: int, placed: OdometryStep, detections: Detections | None) -> Submap | None:
        points = placed.scan.points
        seen = self._front_end.observe(points)
        moved = None
        if self._path.keyframes:
            moved = self._path.moved(self._path.keyframes[-1])
        elif row:  # a detector or provider raised at the scans before
            self._graph = self._new_graph(self._path.poses[row], self._first + self._path.moved(0)[1])
        frame = self._sensors.frame(self._path.times[row], detections)
        closes = self._graph.append(self._path.times[row], moved, seen, frame)
        self._sensors.taken()
        self._sensors.begin(self._graph.smoother)
        self._path.keyframes.append(row)
        submap = self._submaps.close(self._graph, self._graph.poses()[:-1]) if closes else None
        pose = self._graph.pose(len(self._graph) - 1)
        driven = 0.0 if moved is None else float(np.linalg.norm(moved[0][:3, 3]))
        self._submaps.add(points, pose, driven)
        self._covariance = self._graph.covariance()
        return submap
