"""SLAM with a LiDAR: scan poses and landmarks as nodes of one graph.

    prior         the first pose
    odometry      || log( (T_k^-1 T_(k+1))^-1  D_k ) ||_{P_k}      between successive keyframes
    landmarks     walls, ground and poles seen from keyframes, told apart online (`saga_fg.landmarks`)
    loops         || log( (T_i^-1 T_j)^-1  L_ij ) ||, robust       places that the vehicle came back to

Online, every keyframe is placed when it comes, by the joint Gaussian of pose and landmarks; the whole graph is smoothed
from time to time. At the end everything is solved once more, with the loops, and covariances are read off (batch).
Scans between keyframes go along with the keyframe before them, by their odometry.

Odometry is that of the LiDAR, or the recording's own poses, for comparison and for objects alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from data_tools.lidar import constant_velocity, deskewed, voxel_downsample
from data_tools.trajectories import Trajectory
from factors import Linearisable, ResidualFactors, Robust, Solution, between_factor, pose, pose_prior_factor, solve
from pipelines.scan_sequence import ScanSequence
from pipelines.slam.loop_closures import LoopClosure, LoopSettings, find_loops
from pipelines.slam.odometry import LidarOdometry, OdometrySettings
from pipelines.slam.sightings import Seen, SightingSettings, landmarks_seen
from pipelines.tracking import Progress
from saga_fg.arrays import FloatArray, IntArray
from saga_fg.geometry import inverse_transform
from saga_fg.landmarks import Landmark, LandmarkMap, LandmarkMapper, MapperSettings, Sighting
from saga_fg.settings import require_positive, setting, settings_group

OdometrySource = Literal["lidar", "oxts"]
_LEAST = np.diag([1e-4] * 3 + [5e-3] * 3) ** 2  # of a motion: what no registration gets better than, rad and m
_START = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2  # of the first pose, which is where the world begins


@dataclass(frozen=True)
class LidarSlamSettings:
    """All that shapes a run."""

    odometry: OdometrySettings = settings_group(OdometrySettings, "of the LiDAR")
    sightings: SightingSettings = settings_group(SightingSettings, "of landmarks in a scan")
    mapper: MapperSettings = settings_group(lambda: MapperSettings(confirm=4), "telling landmarks apart")
    loops: LoopSettings = settings_group(LoopSettings, "closing loops")
    landmarks: bool = setting(True, "whether landmarks are nodes of the graph")
    loop_closures: bool = setting(True, "whether loops are looked for")
    robust_scale: float = setting(3.0, "of the Geman-McClure loss of loops and poles, standard deviations")
    map_spacing: float = setting(0.25, "a scan is thinned to this for the accumulated map, m")
    oxts_rotation: float = setting(1e-3, "standard deviation of a motion by GPS/IMU between scans, rad")
    oxts_translation: float = setting(0.03, "and of its translation, m")

    def __post_init__(self) -> None:
        require_positive(self, "robust_scale", "map_spacing", "oxts_rotation", "oxts_translation")


@dataclass(frozen=True, eq=False)
class LidarSlam:
    """What a run made of K scans, M of them keyframes. World coordinates are those of the recording's first pose.

    odometry     (K) poses of the vehicle by odometry alone; trajectory (K): by the graph; online (K): as estimated
                 when the keyframe came
    keyframes    (M,) rows of the keyframes among the scans
    covariances  (M, 6, 6) of the sensor's pose at the keyframes, (rotation, translation) in its frame, rad^2, m^2
    landmarks    of the map, those seen more than once
    sightings    what was seen, of which of them, from which keyframe
    extents      (2, 3) of each sighting: ends of the piece that was seen, m, in the sensor's frame
    loops        that were closed
    clouds       M arrays (N, 3), thinned, without skew, in the sensor's frame; world_T_lidar (M, 4, 4) their places
    """

    odometry: Trajectory
    trajectory: Trajectory
    online: Trajectory
    keyframes: IntArray
    covariances: FloatArray
    landmarks: Sequence[Landmark]
    sightings: Sequence[Sighting]
    extents: Sequence[FloatArray]
    loops: Sequence[LoopClosure]
    clouds: Sequence[FloatArray]
    world_T_lidar: FloatArray


@dataclass(frozen=True, eq=False)
class _Drive:
    """Odometry: poses (K, 4, 4) of the sensor, motion covariances (K, 6, 6), keyframe rows, their points."""

    poses: FloatArray
    covariances: FloatArray
    keyframes: list[int]
    points: list[FloatArray]


def lidar_slam(
    scans: ScanSequence,
    source: OdometrySource = "lidar",
    settings: LidarSlamSettings | None = None,
    progress: Progress | None = None,
) -> LidarSlam:
    """Estimate everything from K >= 2 scans. The only pose of the recording that counts is the first, unless the source
    is "oxts".
    """
    s = settings or LidarSlamSettings()
    start = scans.world_T_ego[0] @ scans.ego_T_lidar
    drive = _by_lidar(scans, start, s, progress) if source == "lidar" else _by_oxts(scans, s, progress)
    motions = _motions(drive)
    mapper = LandmarkMapper(drive.poses[0], _START, s.mapper)
    online, seen = [], list[list[Seen]]()
    for k, points in enumerate(drive.points):
        if k:
            mapper.move(*motions[k - 1])
        if s.landmarks:
            seen.append(landmarks_seen(points, s.sightings))
            mapper.observe([each.observation for each in seen[-1]])
        online.append(mapper.estimate.pose.matrix())
        if progress is not None:
            progress("landmarks", k + 1, len(drive.points))
    landmark_map = mapper.map()
    clouds = [points[voxel_downsample(points, s.map_spacing)] for points in drive.points]
    loops = find_loops(clouds, landmark_map.world_T_pose, s.loops) if s.loop_closures else []
    solution = _solved(landmark_map, motions, loops, Robust("geman-mcclure", s.robust_scale))
    count = len(drive.keyframes)
    world_T_lidar = np.array([solution.values.atPose3(_pose_key(k)).matrix() for k in range(count)])
    return LidarSlam(
        _trajectory(scans, drive.poses),
        _trajectory(scans, _carried(drive, world_T_lidar)),
        _trajectory(scans, _carried(drive, np.array(online))),
        np.array(drive.keyframes, dtype=np.int64),
        np.array([solution.covariance([_pose_key(k)]) for k in range(count)]),
        _updated([mark for mark in landmark_map.landmarks if mark.confirmed], solution),
        landmark_map.sightings,
        [each.extent for scan in seen for each in scan],
        loops,
        clouds,
        world_T_lidar,
    )


def _by_lidar(scans: ScanSequence, start: FloatArray, s: LidarSlamSettings, progress: Progress | None) -> _Drive:
    odometry = LidarOdometry(s.odometry)
    drive = _Drive(np.empty((len(scans), 4, 4)), np.empty((len(scans), 6, 6)), [], [])
    for k, timestamp in enumerate(scans.timestamps.tolist()):
        step = odometry.step(scans[k], timestamp)
        drive.poses[k], drive.covariances[k] = start @ step.map_T_lidar, step.covariance + _LEAST
        if step.keyframe:
            drive.keyframes.append(k)
            drive.points.append(step.scan.points)
        if progress is not None:
            progress("odometry", k + 1, len(scans))
    return drive


def _by_oxts(scans: ScanSequence, s: LidarSlamSettings, progress: Progress | None) -> _Drive:
    poses = scans.world_T_ego @ scans.ego_T_lidar
    noise = np.diag([s.oxts_rotation] * 3 + [s.oxts_translation] * 3) ** 2
    drive = _Drive(poses, np.broadcast_to(noise, (len(scans), 6, 6)), [], [])
    for k in range(len(scans)):
        moved = inverse_transform(poses[drive.keyframes[-1]]) @ poses[k] if k else np.eye(4)
        if k == 0 or np.linalg.norm(moved[:3, 3]) >= s.odometry.keyframe_distance:
            scan = scans[k].within(s.odometry.nearest, s.odometry.reach)
            before = max(k - 1, 0)
            if scan.time is not None:
                duration = float(scans.timestamps[before + 1] - scans.timestamps[before])
                scan = deskewed(scan, constant_velocity(inverse_transform(poses[before]) @ poses[before + 1], duration))
            drive.keyframes.append(k)
            drive.points.append(scan.points)
        if progress is not None:
            progress("reading", k + 1, len(scans))
    return drive


def _motions(drive: _Drive) -> list[tuple[FloatArray, FloatArray]]:
    """From each keyframe to the next: motion (4, 4), and the covariances of the steps added up at its end (6, 6)."""
    motions = []
    for a, b in zip(drive.keyframes[:-1], drive.keyframes[1:], strict=True):
        total = np.zeros((6, 6))
        for k in range(a + 1, b + 1):
            Ad = gtsam.Pose3(inverse_transform(drive.poses[b]) @ drive.poses[k]).AdjointMap()
            total += Ad @ drive.covariances[k] @ Ad.T
        motions.append((inverse_transform(drive.poses[a]) @ drive.poses[b], (total + total.T) / 2))
    return motions


def _solved(
    landmark_map: LandmarkMap,
    motions: Sequence[tuple[FloatArray, FloatArray]],
    loops: Sequence[LoopClosure],
    robust: Robust,
) -> Solution:
    """The whole graph, from where the mapper left it."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(pose_prior_factor(_pose_key(0), landmark_map.world_T_pose[0], _START))
    for k, (motion, covariance) in enumerate(motions):
        graph.add(between_factor(_pose_key(k), _pose_key(k + 1), motion, covariance))
    for loop in loops:
        keys = (_pose_key(loop.first), _pose_key(loop.second))
        graph.add(between_factor(*keys, loop.first_T_second, loop.covariance + _LEAST, robust))
    for k, world_T_pose in enumerate(landmark_map.world_T_pose):
        values.insert(_pose_key(k), pose("world_T_pose", world_T_pose))
    for landmark in landmark_map.landmarks:
        if landmark.confirmed:
            values.insert(_landmark_key(landmark.number), landmark.state)
    factors: list[Linearisable] = []
    by_kind: dict[str, list[Sighting]] = {}
    certain = {landmark.number for landmark in landmark_map.landmarks if landmark.confirmed}
    for sighting in (s for s in landmark_map.sightings if s.landmark in certain):
        by_kind.setdefault(sighting.observation.kind.name, []).append(sighting)
    for sightings in by_kind.values():
        made = sightings[0].observation.kind.factors(
            np.array([[_pose_key(s.pose), _landmark_key(s.landmark)] for s in sightings], dtype=np.int64),
            np.stack([s.observation.value for s in sightings]),
            np.stack([s.observation.covariance for s in sightings]),
        )
        if isinstance(made, gtsam.NonlinearFactorGraph):
            graph.push_back(made)
        else:
            factors += [replace(f, robust=robust) if isinstance(f, ResidualFactors) else f for f in made]
    return solve(graph, factors, values)


def _updated(landmarks: Sequence[Landmark], solution: Solution) -> list[Landmark]:
    """The landmarks where the last solution has them."""
    updated = []
    for mark in landmarks:
        key = _landmark_key(mark.number)
        state, covariance = mark.kind.variable.read(solution.values, key), solution.covariance([key])
        updated.append(Landmark(mark.number, mark.kind, state, covariance, mark.sightings, mark.confirmed))
    return updated


def _carried(drive: _Drive, world_T_keyframe: FloatArray) -> FloatArray:
    """Poses (K, 4, 4) of all scans, each fixed to the keyframe before it."""
    of = np.searchsorted(drive.keyframes, np.arange(len(drive.poses)), side="right") - 1
    reference = drive.poses[np.array(drive.keyframes)[of]]
    return np.asarray(world_T_keyframe[of] @ inverse_transform(reference) @ drive.poses)


def _trajectory(scans: ScanSequence, world_T_lidar: FloatArray) -> Trajectory:
    return Trajectory(scans.timestamps, world_T_lidar @ inverse_transform(scans.ego_T_lidar))


def _pose_key(index: int) -> int:
    return int(gtsam.symbol("x", index))


def _landmark_key(number: int) -> int:
    return int(gtsam.symbol("l", number))
