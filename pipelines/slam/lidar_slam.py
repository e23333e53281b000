"""SLAM with a LiDAR: scan poses and landmarks as nodes of one graph.

    prior         the first pose
    odometry      || log( (T_k^-1 T_(k+1))^-1  D_k ) ||_{P_k}      between successive keyframes
    landmarks     walls, ground and poles observed at keyframes, associated online (`saga_fg.slam.mapping`)
    loops         || log( (T_i^-1 T_j)^-1  L_ij ) ||, robust       places that the vehicle came back to

Online, every keyframe is placed when it comes, by the joint Gaussian of pose and landmarks; the whole graph is smoothed
from time to time. At the end everything is solved once more, with the loops, and covariances are read off (batch).
Scans between keyframes go along with the keyframe before them, by their odometry.

Odometry is that of the LiDAR, or the recording's own poses, for comparison and for objects alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from data_tools.lidar import voxel_downsample
from data_tools.lidar.scan import ScanSequence
from data_tools.trajectories import Trajectory
from factors import Robust, between_factor
from pipelines.slam.drive import LEAST, Drive, drive_by_lidar, drive_by_poses
from pipelines.slam.loop_closures import LoopClosure, LoopSettings, find_loops
from pipelines.slam.odometry import OdometrySettings
from pipelines.slam.scan_landmarks import ObservedLandmark, ScanLandmarkSettings, observe_landmarks
from pipelines.tracking import Progress
from saga_fg.estimators import BatchSolver
from saga_fg.graph import Additions, FactorProvider, GraphView
from saga_fg.model.landmarks.detector import LandmarkDetector
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.slam.joint import JointSettings, OdometryNoise
from saga_fg.slam.mapping import (
    AssociatedObservation,
    LandmarkMapper,
    LandmarkObservations,
    MapperSettings,
    MeasuredMotion,
    pose_key,
)
from saga_fg.types.landmark import Landmark, Observation

OdometrySource = Literal["lidar", "oxts"]
_START = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2  # of the first pose, which is where the world begins
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
    mapper: MapperSettings = settings_group(lambda: MapperSettings(confirm_after=4), "association of landmarks")
    loops: LoopSettings = settings_group(LoopSettings, "loop closures")
    landmarks: bool = setting(True, "use landmarks as nodes of the graph")
    loop_closures: bool = setting(True, "search for loop closures")
    robust_scale: Positive = setting(
        3.0, "residual from which the Geman-McClure loss discounts loops and poles, standard deviations"
    )
    map_spacing: Positive = setting(0.25, "spacing of the points of the accumulated map, m; higher: smaller files")
    objects: JointSettings = settings_group(lambda: JointSettings(odometry=CALIBRATED), "objects in the same graph")
    oxts_rotation: Positive = setting(
        1e-3, "standard deviation of the rotation of a GPS/IMU increment between scans, rad"
    )
    oxts_translation: Positive = setting(
        0.03, "standard deviation of the translation of a GPS/IMU increment between scans, m"
    )


@dataclass(frozen=True, eq=False)
class LidarSlam:
    """Result for K scans, M of them keyframes. World coordinates are those of the recording's first pose.

    drive        the odometry; keyframes (M,) are rows among the scans
    odometry     (K) poses of the vehicle by odometry alone; trajectory (K): by the graph; online (K): as estimated
                 when the keyframe came
    covariances  (M, 6, 6) of the sensor's pose at the keyframes, (rotation, translation) in its frame, rad^2, m^2
    landmarks    of the map, those seen more than once
    observations of landmarks, with the landmark and the keyframe of each
    extents      (2, 3) of each observation: ends of the observed piece, m, in the sensor's frame
    loops        that were closed
    clouds       M arrays (N, 3), thinned, without skew, in the sensor's frame; world_T_lidar (M, 4, 4) their places
    """

    drive: Drive
    odometry: Trajectory
    trajectory: Trajectory
    online: Trajectory
    covariances: FloatArray
    landmarks: Sequence[Landmark]
    observations: Sequence[AssociatedObservation]
    extents: Sequence[FloatArray]
    loops: Sequence[LoopClosure]
    clouds: Sequence[FloatArray]
    world_T_lidar: FloatArray

    @property
    def keyframes(self) -> IntArray:
        """(M,) rows of the keyframes among the scans."""
        return np.array(self.drive.keyframes, dtype=np.int64)


def lidar_slam(
    scans: ScanSequence,
    source: OdometrySource = "lidar",
    settings: LidarSlamSettings | None = None,
    progress: Progress | None = None,
    providers: Sequence[FactorProvider] = (),
    detectors: Sequence[LandmarkDetector] = (),
) -> LidarSlam:
    """Estimate everything from K >= 2 scans. The only pose of the recording that counts is the first, unless the source
    is "oxts". providers: of other factors for the graph of all keyframes, one an epoch; detectors: of other landmarks
    in the points of keyframes.
    """
    s = settings or LidarSlamSettings()
    start = scans.world_T_ego[0] @ scans.ego_T_lidar
    if source == "lidar":
        drive = drive_by_lidar(scans, start, s.odometry, progress)
    else:
        drive = drive_by_poses(scans, s.oxts_rotation, s.oxts_translation, s.odometry, progress)
    motions = drive.motions(drive.keyframes)
    mapper = LandmarkMapper(drive.poses[0], _START, s.mapper)
    online, seen = [], list[list[ObservedLandmark]]()
    for k, points in enumerate(drive.points):
        if k:
            mapper.move(*motions[k - 1])
        if s.landmarks:
            seen.append(observe_landmarks(points, s.observations, detectors))
            mapper.observe([each.observation for each in seen[-1]])
        online.append(mapper.ekf.pose.matrix())
        if progress is not None:
            progress("landmarks", k + 1, len(drive.points))
    landmark_map = mapper.map()
    clouds = [points[voxel_downsample(points, s.map_spacing)] for points in drive.points]
    loops = find_loops(clouds, landmark_map.world_T_pose, s.loops) if s.loop_closures else []
    count = len(drive.keyframes)
    certain = [mark for mark in landmark_map.landmarks if mark.confirmed]
    observations, closed = known_providers(certain, landmark_map.observations, loops, range(count), s.robust_scale)
    solver = BatchSolver()
    for k, (time, place) in enumerate(zip(scans.timestamps[drive.keyframes], landmark_map.world_T_pose, strict=True)):
        motion, covariance = motions[k - 1] if k else (place, _START)
        solver.step(time, [MeasuredMotion(motion, covariance, place), observations, closed, *providers])
    solution = solver.solve()
    world_T_lidar = np.array([solution.values.atPose3(pose_key(k)).matrix() for k in range(count)])
    return LidarSlam(
        drive,
        _trajectory(scans, drive.poses),
        _trajectory(scans, drive.carried(world_T_lidar)),
        _trajectory(scans, drive.carried(np.array(online))),
        np.array([solution.marginal(pose_key(k)) for k in range(count)]),
        observations.landmarks(solution, s.mapper.confirm_after),
        landmark_map.observations,
        [each.extent for scan in seen for each in scan],
        loops,
        clouds,
        world_T_lidar,
    )


@dataclass(frozen=True, eq=False)
class Loops:
    """Loops between keyframes, whose poses are those of `epochs`."""

    loops: Sequence[LoopClosure]
    epochs: Sequence[int]
    robust: Robust
    name: str = "loops"

    def factors(self, view: GraphView) -> Additions:
        mine = [loop for loop in self.loops if self.epochs[loop.second] == view.epoch]
        pairs = [(pose_key(self.epochs[loop.first]), pose_key(view.epoch)) for loop in mine]
        return Additions(
            factors=[
                between_factor(*pair, loop.first_T_second, loop.covariance + LEAST, self.robust)
                for pair, loop in zip(pairs, mine, strict=True)
            ]
        )


def known_providers(
    landmarks: Sequence[Landmark],
    observations: Sequence[AssociatedObservation],
    loops: Sequence[LoopClosure],
    epochs: Sequence[int],
    robust_scale: float,
) -> tuple[LandmarkObservations, Loops]:
    """Providers of landmarks seen from keyframes and of loops between these, whose poses are those of `epochs`."""
    robust, start = Robust("geman-mcclure", robust_scale), {mark.number: mark.state for mark in landmarks}
    seen: dict[int, list[tuple[int, Observation]]] = {}
    for one in observations:
        if one.landmark in start:
            seen.setdefault(epochs[one.pose], []).append((one.landmark, one.observation))
    return LandmarkObservations(seen, start, robust), Loops(loops, epochs, robust)


def _trajectory(scans: ScanSequence, world_T_lidar: FloatArray) -> Trajectory:
    return Trajectory(scans.timestamps, world_T_lidar @ inverse_transform(scans.ego_T_lidar))
