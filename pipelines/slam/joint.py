"""LiDAR SLAM with objects: the vehicle, walls, poles, loops and the objects of a detector, in one graph.

The graph of `pipelines.slam.lidar_slam` (odometry, landmarks, loops) and that of `saga_fg.slam.joint` (detections,
interactions, stationary objects) are solved as one. Its moments are the keyframes, and scans in between where the
vehicle is slow, since objects move while it is stationary. Poses are those of the sensor; detections are brought into
its frame. The vehicle's sensors measure between moments, so their factors are made anew from their log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from data_tools.lidar.scan import ScanSequence
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory
from pipelines.config import TrackConfig
from pipelines.slam.lidar_slam import LidarSlamResult, LidarSlamSettings, known_providers
from pipelines.slam.scan_content import frames_at
from pipelines.slam.submaps import world_T_submap
from saga_fg.graph import FactorProvider
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.slam.joint import OdometryIncrements, estimate_jointly
from saga_fg.slam.joint.record import KEYFRAME_PERIOD
from saga_fg.slam.sensors import sensor_providers
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame


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
