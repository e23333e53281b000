"""SLAM with a LiDAR, scan by scan: odometry, keyframes, submaps and landmarks, loops, in one graph.

    prior         the first pose
    odometry      || log( (T_k^-1 T_(k+1))^-1  D_k ) ||_{P_k}      between successive keyframes
    sensors       GPS, inertial samples and wheels of the vehicle, where there are any
    landmarks     walls, curbs and poles observed at keyframes, associated within the running submap
    loops         || log( (T_i^-1 T_j)^-1  L_ij ) ||, robust       places that the vehicle came back to

`saga_fg.slam.submaps` keeps the graph small. The points of keyframes are thinned to one cloud a submap and dropped when
it is closed; then loops are searched for. At the end everything is solved together, and covariances are read off.
Where the scan leaves a motion open, as along a tunnel, its covariance is wide and the sensors decide.
Scans between keyframes go along with the keyframe before them, by their odometry.

Odometry is that of the LiDAR, or the recording's own poses, for comparison and for objects alone.

LiDAR SLAM with objects: the vehicle, walls, poles, loops and the objects of a detector, in one graph.

The graph of `pipelines.slam.lidar_slam` (odometry, landmarks, loops) and that of `saga_fg.slam.joint` (detections,
interactions, stationary objects) are solved as one. Its moments are the keyframes, and scans in between where the
vehicle is slow, since objects move while it is stationary. Poses are those of the sensor; detections are brought into
its frame. The vehicle's sensors measure between moments, so their factors are made anew from their log.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from data_tools.lidar import Scan, Submap, voxel_downsample
from data_tools.lidar.recording import scan_context
from data_tools.lidar.scan import ScanSequence, without_objects
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory
from pipelines.config import TrackConfig
from pipelines.slam.loop_closures import ClosedSubmaps, LoopSettings, PlaceLoops, SubmapLoops
from pipelines.slam.odometry import (
    Drive,
    LidarOdometry,
    Odometry,
    OdometrySettings,
    OdometryStep,
    RecordedOdometry,
    checked_step,
    moved_pose,
)
from pipelines.slam.scan_content import MovingObjects, ScanLandmarkSettings, frames_at, observe_landmarks
from pipelines.slam.submaps import CloudFormat, SubmapBuilder, world_T_submap
from pipelines.slam.vehicle_sensors import Vehicle, VehicleSensors, start_by_fixes
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.model.landmarks import LandmarkDetector
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import checked_transform, inverse_transform
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.slam.joint import JointEstimate, JointSettings, OdometryIncrements, OdometryNoise, estimate_jointly
from saga_fg.slam.joint.record import KEYFRAME_PERIOD
from saga_fg.slam.mapping import AssociatedObservation, LandmarkObservations
from saga_fg.slam.sensors import sensor_providers
from saga_fg.slam.submaps import LoopClosure, Loops, LoopSelection, SubmapGraph, SubmapSettings
from saga_fg.tracking import Tracker
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, EgoMeasurements, Frame, GpsFix, ImuSamples, WheelSpeed
from saga_fg.types.landmark import Landmark, Observation

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
class LidarSlamResult:
    """Result for K scans, M of them keyframes, in S submaps, in the world of the first pose.

    drive          the odometry; its keyframes (M,) are rows among the scans
    odometry       (K) poses of the vehicle by odometry alone; trajectory (K): by the graph; online (K): as estimated
                   when the scan came
    covariances    (M, 6, 6) of the keyframes' poses, (rotation, translation) in the sensor's frame, rad^2, m^2
    landmarks      of the map, those seen more than once
    observations   of landmarks, with the landmark and the keyframe of each
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
    observations: Sequence[AssociatedObservation]
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
        """Motions (4, 4) between scans by odometry, as `Drive.motions`, with the covariances of the solution."""
        return [(T, self.selection.inflated(P)) for T, P in self.drive.motions(rows)]

    @property
    def keyframes(self) -> IntArray:
        """(M,) rows of the keyframes among the scans."""
        return np.array(self.drive.keyframes, dtype=np.int64)


OdometrySource = Literal["lidar", "recorded"]
# slow errors of an odometry that has hardly any; what else it does is in its covariances
CALIBRATED = OdometryNoise(
    turn_noise=1e-3,
    distance_noise=0.01,
    scale=1e-3,
    scale_drift=1e-4,
    bias=1e-4,
    bias_drift=1e-5,
    course=1e-4,
    course_drift=1e-5,
)


@dataclass(frozen=True)
class LidarSlamSettings(Settings):
    """Settings of LiDAR SLAM."""

    odometry: OdometrySettings = settings_group(OdometrySettings, "LiDAR odometry")
    observations: ScanLandmarkSettings = settings_group(ScanLandmarkSettings, "detection of landmarks in a scan")
    submaps: SubmapSettings = settings_group(SubmapSettings, "submaps and their landmarks")
    loops: LoopSettings = settings_group(LoopSettings, "loop closures by place")
    landmarks: bool = setting(True, "use landmarks as nodes of the graph")
    loop_closures: bool = setting(True, "search for loop closures")
    map_spacing: Positive = setting(
        0.25, "spacing of the points of the map, its submaps and map.ply, m; higher: less memory, smaller files"
    )
    map_format: CloudFormat = setting("ply", "format of the files of the map's submaps: ply or pcd")
    objects: JointSettings = settings_group(lambda: JointSettings(odometry=CALIBRATED), "objects in the same graph")
    recorded_rotation: Positive = setting(
        2e-4, "standard deviation of the rotation of a GPS/IMU increment between scans, rad; usual 1e-4 to 1e-3"
    )
    recorded_translation: Positive = setting(
        0.005,
        "standard deviation of the translation of a GPS/IMU increment between scans, m; accuracy of the velocity that "
        "the records state (KITTI: 0.01 to 0.05 m/s) times the period; higher: landmarks and objects move the path",
    )


class LidarSlam:
    """LiDAR SLAM of a drive: `step` takes scan by scan, `finish` gives the map.

    start       (4, 4) the sensor's first pose in the world, z up, or that and its covariance (6, 6), in its frame
    providers   of other factors, asked at every keyframe
    vehicle     whose path the result has, where the LiDAR is on it, and the sensors whose measurements `step` gets
    moving      leaves points on moving objects out of the scans, by the detections that `step` gets
    detectors   of other landmarks in the points of keyframes
    loops       search for loops, by default by place as the settings say
    odometry    by default that of the LiDAR

    A scan that `step` refuses is left out, and the next can follow. If a provider or detector raises, the scan is
    placed by odometry and becomes no keyframe.
    """

    def __init__(
        self,
        start: FloatArray | tuple[FloatArray, FloatArray] | None = None,
        settings: LidarSlamSettings | None = None,
        *,
        providers: Sequence[FactorProvider] = (),
        detectors: Sequence[LandmarkDetector] = (),
        loops: SubmapLoops | None = None,
        odometry: Odometry | None = None,
        moving: MovingObjects | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        self.settings = s = settings or LidarSlamSettings()
        pose, first = start if isinstance(start, tuple) else (start, START)
        self._first: FloatArray = first
        self._start = np.eye(4) if pose is None else checked_transform("start", pose)
        self._odometry = LidarOdometry(s.odometry) if odometry is None else odometry
        self._sensors, self._moving = VehicleSensors(vehicle or Vehicle(), bool(providers)), moving
        self._measured = self._sensors.since_keyframe
        both = [*self._sensors.new_providers(), *providers]
        self._new_graph = partial(SubmapGraph, settings=s.submaps, providers=both)
        self._graph = self._new_graph(self._start, self._first)
        self._detectors, self._others = tuple(detectors), bool(providers)
        self._closed = ClosedSubmaps(PlaceLoops(s.loops) if loops is None and s.loop_closures else loops)
        self._builder = SubmapBuilder(s.map_spacing, straighten=not isinstance(self._odometry, LidarOdometry))
        self._path, self._online = Drive(), list[FloatArray]()
        self._degenerate, self._boxes = list[tuple[str, ...]](), list[Boxes]()  # of all scans
        self._finished, self._covariance = False, self._first  # of the last keyframe's pose

    @property
    def graph(self) -> SubmapGraph:
        """The running graph. To be read, not changed."""
        return self._graph

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
        if self._finished:
            raise InputError("step: expected no scan after finish; a new LidarSlam takes the next drive")
        self._path.check(scan, time, isinstance(self._odometry, LidarOdometry))
        measured = EgoMeasurements(gps=gps, imu=imu, wheels=wheels)
        self._measured.check(measured)
        if detections is not None and self._moving is None and not self._others:
            raise InputError("detections: expected with `moving`, or with providers that read them")
        moving = Boxes.empty()
        if self._moving is not None and detections is not None:
            self._moving.check(scan, detections)
            moving = self._moving.boxes(time, detections, self._path.expected(time) if len(self._path) else self._start)
            scan = without_objects(scan, moving)
        velocity = self._sensors.velocity(self._sensors.corrected(wheels))
        if isinstance(self._odometry, LidarOdometry):
            placed = self._odometry.step(scan, time, velocity)
        else:
            placed = checked_step(self._odometry.step(scan, time))
        if not self._path.keyframes:
            placed = replace(placed, keyframe=True)
        self._degenerate.append(placed.degenerate)
        self._boxes.append(moving)
        self._path.add(time, self._start @ placed.map_T_lidar, placed)
        self._measured.add(time, self._sensors.compared(measured, placed))
        self._online.append(self._path.poses[-1])
        row, submap, known = len(self._path) - 1, None, len(self._closed.loops)
        if placed.keyframe:
            submap = self._add_keyframe(row, placed, detections)
        since = self._path.moved(self._path.keyframes[-1])
        self._online[-1], now = moved_pose(self._graph.pose(len(self._graph) - 1), self._covariance, since)
        number = len(self._path.keyframes) - 1 if placed.keyframe else None
        return SlamStep(self._online[-1], now, placed, number, submap, tuple(self._closed.loops[known:]))

    def finish(self) -> LidarSlamResult:
        """Close the last submap, and solve everything together."""
        if self._finished:
            raise InputError("finish: expected to be called once")
        if not self._path.keyframes:
            raise InputError("expected at least one scan before the end, and a keyframe")
        if len(self._builder):
            self._closed.close(self._builder, self._graph, self._graph.poses())
        solved = self._graph.finish()
        self._finished = True
        fit = self._sensors.consistency
        fit.observe(solved.graph)
        fit.warn()
        drive = self._path
        submaps, (true_loops, false_loops) = self._closed.submaps, self._closed.judged(solved.loops)
        anchors = solved.world_T_pose[[submap.anchor for submap in submaps]]
        times, lidar_T_ego = np.array(self._path.times), self._sensors.lidar_T_ego
        return LidarSlamResult(
            drive,
            Trajectory(times, np.array(drive.poses) @ lidar_T_ego),
            Trajectory(times, drive.carried(solved.world_T_pose) @ lidar_T_ego),
            Trajectory(times, np.array(self._online) @ lidar_T_ego),
            solved.covariances,
            solved.landmarks,
            self._graph.observations(),
            true_loops,
            false_loops,
            solved.loops,
            self._degenerate,
            self._boxes,
            fit.misfits,
            fit.unjudged,
            submaps,
            np.array([world_T_submap(*each) for each in zip(submaps, anchors, strict=True)]),
            solved.world_T_pose,
        )

    def _add_keyframe(self, row: int, placed: OdometryStep, detections: Detections | None) -> Submap | None:
        s, points = self.settings, placed.scan.points
        seen = observe_landmarks(points, s.observations, self._detectors) if s.landmarks else []
        moved = None
        if self._path.keyframes:
            moved = self._path.moved(self._path.keyframes[-1])
        elif row:  # a detector or provider raised at the scans before
            self._graph = self._new_graph(self._path.poses[row], self._first + self._path.moved(0)[1])
        frame = self._measured.frame(self._path.times[row], detections)
        closes = self._graph.append(self._path.times[row], moved, seen, frame)
        self._measured.clear()
        self._path.keyframes.append(row)
        submap = self._closed.close(self._builder, self._graph, self._graph.poses()[:-1]) if closes else None
        pose = self._graph.pose(len(self._graph) - 1)
        driven = 0.0 if moved is None else float(np.linalg.norm(moved[0][:3, 3]))
        self._builder.add(points[voxel_downsample(points, s.map_spacing)], pose, driven)
        self._covariance = self._graph.covariance()
        return submap


def lidar_slam(
    scans: ScanSequence,
    source: OdometrySource = "lidar",
    *,
    settings: LidarSlamSettings | None = None,
    progress: Progress | None = None,
    providers: Sequence[FactorProvider] = (),
    detectors: Sequence[LandmarkDetector] = (),
    log: SensorLog | None = None,
    objects: tuple[Sequence[Frame], Tracker] | None = None,
) -> LidarSlamResult:
    """Estimate everything from K >= 2 scans of a recording, one after the other. The only pose of the recording that
    counts is the first, unless the source is "recorded". Without poses the world is the vehicle's frame at the first
    scan, or that of the fixes by GPS, if there are any: the first scans then tell which way it looks.

    providers, detectors: as of `LidarSlam`; log: of the vehicle's sensors, in the recording's world; objects: frames
    with detections at the times of all scans, and a new tracker: moving objects leave the scans.
    Raises `InputError` for a scan without a frame.
    """
    s = settings or LidarSlamSettings()
    recorded = (
        RecordedOdometry(scans, s.recorded_rotation, s.recorded_translation, s.odometry)
        if source == "recorded"
        else None
    )
    log = log or SensorLog({})
    start: FloatArray | tuple[FloatArray, FloatArray] = scans.ego_T_lidar
    if scans.world_T_ego is not None:
        start = scans.world_T_ego[0] @ scans.ego_T_lidar
    elif "gps" in log.tables:
        start = start_by_fixes(scans, log.tables["gps"], np.array(log.settings.gps.antenna), s.odometry)
    seen: Sequence[Frame | None] = [None] * len(scans.timestamps)
    if objects is not None:
        seen = frames_at(objects[0], scans.timestamps, inverse_transform(scans.ego_T_lidar), objects[1])
    slam = LidarSlam(
        start,
        s,
        providers=providers,
        detectors=detectors,
        odometry=recorded,
        moving=None if objects is None else MovingObjects(objects[1]),
        vehicle=Vehicle(scans.ego_T_lidar, tuple(log.tables), log.settings),
    )
    for k, (time, ego) in enumerate(log.until(scans.timestamps)):
        detections = None if (frame := seen[k]) is None else frame.detections
        with scan_context(scans, k):
            slam.step(scans[k], time, imu=ego.imu, gps=ego.gps, detections=detections, wheels=ego.wheels)
        if progress is not None:
            progress("slam", k + 1, len(scans))
    return slam.finish()


def known_providers(
    result: LidarSlamResult, epochs: Sequence[int], settings: SubmapSettings
) -> tuple[LandmarkObservations, Loops]:
    """Providers of landmarks seen from keyframes and of loops between these, whose poses are those of `epochs`."""
    start = {mark.number: mark.state for mark in result.landmarks}
    seen: dict[int, list[tuple[int, Observation]]] = {}
    for one in result.observations:
        if one.landmark in start:
            seen.setdefault(epochs[one.pose], []).append((one.landmark, one.observation))
    return LandmarkObservations(seen, start, settings.robust), Loops(result.loops, epochs)


def path_tracker(config: TrackConfig) -> Tracker:
    """A new tracker along a path."""
    return Tracker(replace(config.tracker, estimator="kalman"), config.sensors)


def with_objects(
    result: LidarSlamResult,
    scans: ScanSequence,
    frames: Sequence[Frame],
    config: TrackConfig,
    settings: LidarSlamSettings | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
    log: SensorLog | None = None,
) -> LidarSlamResult:
    """Solve again with the objects in `frames`, which cover the times of all scans; config: of the tracker.

    new_providers: gives fresh providers of other factors; log: of the vehicle's sensors, as of `lidar_slam`.
    Raises `InputError` for a scan without a frame.
    """
    s = settings or LidarSlamSettings()
    rows = _moments(result.drive.keyframes, scans.timestamps.tolist(), KEYFRAME_PERIOD)
    lidar_T_ego = inverse_transform(scans.ego_T_lidar)
    new_tracker = partial(path_tracker, config)
    seen = frames_at(frames, scans.timestamps[rows], lidar_T_ego, new_tracker())
    seen = _with_sensors(seen, log)
    motions = result.motions(rows)
    odometry = OdometryIncrements(
        scans.timestamps[rows],
        np.array([motion for motion, _ in motions]).reshape(-1, 4, 4),
        np.array([covariance for _, covariance in motions]).reshape(-1, 6, 6),
    )
    at = np.searchsorted(rows, result.keyframes)
    known = known_providers(result, at.tolist(), s.submaps)
    of_sensors = [] if log is None else sensor_providers(log.settings, tuple(log.tables), lidar_T_ego)
    start = result.drive.poses[0]
    estimate = estimate_jointly(
        seen, odometry, new_tracker, s.objects, start, new_providers=lambda: [*known, *of_sensors, *new_providers()]
    )
    poses = result.drive.carried(estimate.world_T_ego, rows) @ lidar_T_ego
    placed = estimate.world_T_ego[at]
    return replace(
        result,
        trajectory=Trajectory(scans.timestamps, poses),
        covariances=estimate.pose_covariances[at],
        landmarks=known[0].landmarks(estimate.solution, s.submaps.confirm_after),
        world_T_submap=np.array([world_T_submap(one, placed[one.anchor]) for one in result.submaps]),
        world_T_lidar=placed,
        objects=estimate,
        alone=result.trajectory,
    )


def _with_sensors(frames: Sequence[Frame], log: SensorLog | None) -> list[Frame]:
    """The frames, each with what the log has of the time since the one before."""
    if log is None:
        return list(frames)
    measured = log.until(np.array([frame.timestamp for frame in frames]))
    return [replace(frame, ego=ego) for frame, (_, ego) in zip(frames, measured, strict=True)]


def _moments(keyframes: Sequence[int], timestamps: Sequence[float], period: float) -> list[int]:
    """Rows of the scans that are moments of the graph: all keyframes, and those more than `period` s after the last."""
    chosen: list[int] = []
    waiting = set(keyframes)
    for row, time in enumerate(timestamps):
        if row in waiting or not chosen or time > timestamps[chosen[-1]] + period:
            chosen.append(row)
    return chosen
