"""Joint estimation of the vehicle's path and the objects around it, from the frames of one scene.

Ego odometry comes from the scene's own poses, degraded by a stated amount. The joint estimate is compared with the
decoupled pipeline: the odometry's path, and objects tracked along it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from data_tools.simulator import SimulatorSettings
from data_tools.simulator.settings import LightSettings, SurroundingSettings
from data_tools.trajectories import Trajectory, TrajectoryErrors, degraded_odometry, trajectory_errors
from pipelines.config import TrackConfig
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.slam.joint import (
    JointEstimate,
    JointSettings,
    Observations,
    OdometryIncrements,
    OnlineEstimate,
    estimate_jointly,
    estimate_online,
)
from saga_fg.slam.joint.settings import KEYFRAME_PERIOD
from saga_fg.tracking import Tracker
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame


@dataclass(frozen=True, eq=False)
class JointRun:
    """One scene: its frames and odometry, the true path, the odometry's, the estimate, and the online one if there is
    one."""

    frames: Sequence[Frame]
    increments: OdometryIncrements
    truth: Trajectory
    odometry: Trajectory
    estimate: JointEstimate
    online: OnlineEstimate | None = None

    @property
    def paths(self) -> dict[str, Trajectory]:
        """Paths by name: truth, odometry, joint; online, with each pose as known at once, and settled, a lag later."""
        paths = {"truth": self.truth, "odometry": self.odometry}
        paths["joint"] = Trajectory(self.estimate.timestamps, self.estimate.world_T_ego)
        if self.online is not None:
            paths["online"] = Trajectory(self.online.timestamps, self.online.newest)
            paths["settled"] = Trajectory(self.online.timestamps, self.online.settled)
        return paths

    def errors(self) -> dict[str, TrajectoryErrors]:
        """Errors of each path but the true one, by name, each path moved to lie nearest to the truth."""
        return {name: trajectory_errors(path, self.truth) for name, path in self.paths.items() if name != "truth"}


def street(parked: bool = True, mapped: bool = False) -> SimulatorSettings:
    """Simulated scenes with cars parked on both sides of the road, or on none; mapped: frames bring the lanes along."""
    surroundings = SurroundingSettings(parking_probability=1.0 if parked else 0.0)
    return SimulatorSettings(surroundings=surroundings, lights=LightSettings(mapped=mapped))


def run_joint(
    scene: Scene,
    config: TrackConfig,
    settings: JointSettings,
    sensor: str,
    seed: int,
    landmarks: Callable[[Sequence[Frame]], Observations] | None = None,
    lag: float | None = None,
    new_providers: Callable[[], Sequence[FactorProvider]] = tuple,
) -> JointRun:
    """Estimate jointly from the frames of one sensor and odometry degraded as `settings.odometry` says.

    landmarks: gives their observations at n frames; lag: s, to estimate online as well; new_providers: gives fresh
    providers of other factors. Raises `InputError` as `degraded_drive`.
    """
    frames, truth, odometry = degraded_drive(scene, settings, sensor, seed)
    start = truth.world_T_ego[0]

    new_tracker = partial(path_tracker, config)
    observed = None if landmarks is None else landmarks(frames)
    estimate = estimate_jointly(frames, odometry, new_tracker, settings, start, observed, new_providers)
    online = None
    if lag is not None:
        tracker, own = new_tracker(), new_providers()
        online = estimate_online(frames, odometry, tracker, lag, settings, start, observed, providers=own)
    return JointRun(frames, odometry, truth, Trajectory(truth.timestamps, odometry.path(start)), estimate, online)


def path_tracker(config: TrackConfig) -> Tracker:
    """A new tracker along a path."""
    return Tracker(replace(config.tracker, estimator="kalman"), config.sensors)


def degraded_drive(
    scene: Scene, settings: JointSettings, sensor: str, seed: int
) -> tuple[list[Frame], Trajectory, OdometryIncrements]:
    """The keyframes of one sensor, their true path, and odometry degraded as `settings.odometry` says.

    Raises `InputError` where the sensor has no frames, or frames without poses to make the odometry of.
    """
    frames = keyframes([frame for frame in scene.frames if frame.sensor == sensor], KEYFRAME_PERIOD)
    if not frames:
        raise InputError(f"scene {scene.name}: expected frames of {sensor}, there are those of {scene.sensors}")
    poses = [frame.world_T_ego for frame in frames if frame.world_T_ego is not None]
    if len(poses) < len(frames):
        raise InputError(f"scene {scene.name}: expected a pose with every frame of {sensor}")
    truth = Trajectory(np.array([frame.timestamp for frame in frames]), np.stack(poses))
    exact = OdometryIncrements.of(truth.timestamps, truth.world_T_ego)
    return frames, truth, degraded_odometry(exact, settings.odometry, np.random.default_rng(seed))


def keyframes(frames: Sequence[Frame], period: float) -> list[Frame]:
    """Return the first frame, and each that comes more than `period` s after the last one chosen."""
    chosen: list[Frame] = []
    for frame in frames:
        if not chosen or frame.timestamp > chosen[-1].timestamp + period:
            chosen.append(frame)
    return chosen
