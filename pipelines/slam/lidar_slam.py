"""SLAM with a LiDAR: the front end of `pipelines.slam.driver` for it, and whole recordings, with objects too.

Scans are registered with the surfels of those before; walls and poles are observed at keyframes; submaps that
look alike from above are proved by registration.

LiDAR SLAM with objects: the vehicle, walls, poles, loops and the objects of a detector, in one graph.

The graph of the drive (odometry, landmarks, loops) and that of `saga_fg.slam.joint` (detections, interactions,
stationary objects) are solved as one. Its moments are the keyframes, and scans in between where the
vehicle is slow, since objects move while it is stationary. Poses are those of the sensor; detections are brought into
its frame. The vehicle's sensors measure between moments, so their factors are made anew from their log.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from data_tools.lidar import Scan, ScanSequence, extract_poles, extract_walls, scan_context, segment_ground
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory
from pipelines.config import TrackConfig
from pipelines.slam.driver import FrontEnd, MovingObjects, Slam, SlamResult, SlamStep
from pipelines.slam.loop_closures import LoopSearch, LoopSettings, PlaceLoops
from pipelines.slam.odometry import LidarOdometry, Odometry, OdometrySettings
from pipelines.slam.vehicle_sensors import Vehicle, start_by_fixes
from saga_fg import InputError, Tracker
from saga_fg.graph import FactorProvider
from saga_fg.model import LandmarkDetector, PlaneLandmark, PoleLandmark
from saga_fg.numerics import FloatArray, inverse_transform
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.slam.joint import (
    KEYFRAME_PERIOD,
    JointSettings,
    OdometryIncrements,
    OdometryNoise,
    estimate_jointly,
    in_ego,
)
from saga_fg.slam.mapping import LandmarkObservations
from saga_fg.slam.sensors import sensor_providers
from saga_fg.slam.submaps import Loops, SubmapSettings
from saga_fg.types import Frame, Observation

Watch = Callable[[Slam, Scan, float, SlamStep], None]
"""Told of each scan: the estimate so far, the scan, its time since the first, s, and where it was placed."""

WALL = PlaneLandmark(name="wall")
POLE = PoleLandmark()


_WALLS, _POLES = 6, 12  # of a scan: the largest walls and the nearest poles are kept


def observe_landmarks(points: FloatArray, detectors: Sequence[LandmarkDetector] = ()) -> list[Observation]:
    """Observe landmarks in points (N, 3) of a scan without skew, m, in the sensor's frame.

    detectors: of further kinds of landmarks
    """
    ground = segment_ground(points)
    walls = extract_walls(points[~ground.is_ground])
    found = [Observation(WALL, wall.coefficients, wall.covariance, wall.extent) for wall in walls[:_WALLS]]
    poles = extract_poles(points, ground.height, walls)
    for pole in sorted(poles, key=lambda pole: float(np.hypot(*pole.foot[:2])))[:_POLES]:
        extent = np.stack([pole.foot, [*pole.foot[:2], pole.top]])
        found.append(Observation(POLE, pole.foot, pole.covariance, extent))
    return found + [other for detector in detectors for other in detector.observations(points)]


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
    submaps: SubmapSettings = settings_group(SubmapSettings, "submaps and their landmarks")
    loops: LoopSettings = settings_group(LoopSettings, "loop closures by place")
    landmarks: bool = setting(True, "use landmarks as nodes of the graph")
    loop_closures: bool = setting(True, "search for loop closures")
    map_spacing: Positive = setting(
        0.25, "spacing of the points of the map, its submaps and map.ply, m; higher: less memory, smaller files"
    )
    objects: JointSettings = settings_group(lambda: JointSettings(odometry=CALIBRATED), "objects in the same graph")


class LidarSlam(Slam):
    """LiDAR SLAM of a drive, scan by scan.

    start, providers, moving, vehicle  as of `Slam`
    detectors   of other landmarks in the points of keyframes
    loops       search for loops, by default by place as the settings say
    odometry    by default that of the LiDAR
    """

    def __init__(
        self,
        start: FloatArray | tuple[FloatArray, FloatArray] | None = None,
        settings: LidarSlamSettings | None = None,
        *,
        providers: Sequence[FactorProvider] = (),
        detectors: Sequence[LandmarkDetector] = (),
        loops: LoopSearch | None = None,
        odometry: Odometry | None = None,
        moving: MovingObjects | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        self.settings = s = settings or LidarSlamSettings()
        by_place = PlaceLoops(s.loops) if loops is None and s.loop_closures else loops

        def observe(points: FloatArray) -> list[Observation]:
            return observe_landmarks(points, detectors) if s.landmarks else []

        front_end = FrontEnd(odometry or LidarOdometry(s.odometry), s.submaps, s.map_spacing, by_place, observe)
        super().__init__(front_end, start, providers, moving, vehicle)


def lidar_slam(
    scans: ScanSequence,
    *,
    settings: LidarSlamSettings | None = None,
    providers: Sequence[FactorProvider] = (),
    detectors: Sequence[LandmarkDetector] = (),
    odometry: Odometry | None = None,
    log: SensorLog | None = None,
    objects: tuple[Sequence[Frame], Tracker] | None = None,
    watch: Watch | None = None,
) -> SlamResult:
    """Estimate everything from K >= 2 scans of a recording, one after the other. The only pose of the recording that
    counts is the first. Without poses the world is the vehicle's frame at the first
    scan, or that of the fixes by GPS, if there are any: the first scans then tell which way it looks.

    providers, detectors, odometry: as of `LidarSlam`; log: of the vehicle's sensors, in the recording's world; objects:
    frames with detections at the times of all scans, and a new tracker: moving objects leave the scans; watch: is
    told of each scan.
    Raises `InputError` for a scan without a frame.
    """
    s = settings or LidarSlamSettings()
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
        odometry=odometry,
        moving=None if objects is None else MovingObjects(objects[1]),
        vehicle=Vehicle(scans.ego_T_lidar, tuple(log.tables), log.settings),
    )
    for k, (time, ego) in enumerate(log.until(scans.timestamps)):
        detections = None if (frame := seen[k]) is None else frame.detections
        with scan_context(scans, k):
            scan = scans[k]
            step = slam.step(scan, time, imu=ego.imu, gps=ego.gps, detections=detections, wheels=ego.wheels)
        if watch is not None:
            watch(slam, scan, time - float(scans.timestamps[0]), step)
    return slam.finish()


def known_providers(
    result: SlamResult, epochs: Sequence[int], settings: SubmapSettings
) -> tuple[LandmarkObservations, Loops]:
    """Providers of landmarks seen from keyframes and of loops between these, whose poses are those of `epochs`."""
    start = {mark.number: mark.state for mark in result.landmarks}
    known = ([(n, one) for n, one in now if n in start] for now in result.observations)
    seen = {epoch: now for epoch, now in zip(epochs, known, strict=True) if now}
    return LandmarkObservations(seen, start, settings.robust), Loops(result.loops, epochs)


SAME_TIME = 0.01  # s


def frames_at(
    frames: Sequence[Frame], timestamps: FloatArray, lidar_T_ego: FloatArray, tracker: Tracker
) -> list[Frame]:
    """The frame at each time, its detections in the frame of the scanner. Raises `InputError` where there is none."""
    times = np.array([frame.timestamp for frame in frames])
    found = []
    for time in timestamps.tolist():
        nearest = int(np.argmin(np.abs(times - time))) if len(times) else -1
        if nearest < 0 or abs(times[nearest] - time) > SAME_TIME:
            raise InputError(f"frames: expected one of detections at {time:.3f} s, the time of a scan; there is none")
        frame = frames[nearest]
        detections = in_ego(frame, tracker.sensor(frame.sensor)).transformed(lidar_T_ego)
        found.append(Frame(time, frame.sensor, detections, np.eye(4), "ego"))
    return found


def path_tracker(config: TrackConfig) -> Tracker:
    """A new tracker along a path."""
    return Tracker(replace(config.tracker, estimator="kalman"), config.sensors)


def with_objects(
    result: SlamResult,
    scans: ScanSequence,
    frames: Sequence[Frame],
    config: TrackConfig,
    settings: LidarSlamSettings | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
    log: SensorLog | None = None,
) -> SlamResult:
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
        world_T_submap=np.array([submap.frame(placed) for submap in result.submaps]),
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
