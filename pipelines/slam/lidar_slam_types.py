"""Results of LiDAR SLAM: of each scan when it comes, and of the whole drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.lidar import Submap
from data_tools.trajectories import Trajectory
from pipelines.slam.drive import Drive
from pipelines.slam.odometry import OdometryStep
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.slam.mapping import AssociatedObservation
from saga_fg.slam.submaps import LoopClosure, LoopSelection
from saga_fg.types.boxes import Boxes
from saga_fg.types.landmark import Landmark

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

    drive          the odometry; keyframes (M,) are rows among the scans
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

    def motions(self, rows: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
        """Motions (4, 4) between scans by odometry, as `Drive.motions`, with the covariances of the solution."""
        return [(T, self.selection.inflated(P)) for T, P in self.drive.motions(rows)]

    @property
    def keyframes(self) -> IntArray:
        """(M,) rows of the keyframes among the scans."""
        return np.array(self.drive.keyframes, dtype=np.int64)
