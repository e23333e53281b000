"""The vehicle and the objects around it in one graph, against one after the other, with poor odometry.

Decoupled: the odometry's path, and the tracker along it. Joint: odometry and objects in one graph. Held: objects by the
same graph, with past and future, the path held where the odometry has it. Online: the joint estimate in a running
graph, read out at every frame. All know the same odometry, degraded by errors sampled with a seed. Paths are aligned
with the true one before their absolute trajectory error (ATE) is taken.

A pair is an object at a frame, with a detection within `NEAR` of the truth along the true path, of a track that has
detected it in at least `SETTLED` frames before: earlier, velocities are the priors of new tracks. Contenders are
compared on the pairs that all of them have. With the estimated and the true pose (R, t), (R', t') of the vehicle,

    in the world    p - p',  v - v'                     from it    R^T (p - t) - R'^T (p' - t'),  R^T v - R'^T v'

Intervals are paired bootstraps over recordings, the seeds of one taken together, of changes of pooled errors.

Online, each frame adds an epoch to the running graph of the last seconds. The stationarity of objects follows from
the window, and iSAM2 solves that with the new factors. Epochs older than `lag` leave: they are marginalised with all
factors on their variables, linearised at the present estimate. On recordings it pays neither for the path nor for the
objects beside a tracker along LiDAR odometry, so that no command offers it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import gtsam
import numpy as np
import typer
from scipy.spatial.transform import Rotation

from benchmarks.runner import Row, Rows, each, paired_bootstrap
from data_tools.datasets.kitti import KittiTracking
from data_tools.simulator import SimulatorSettings, simulate_scene
from data_tools.trajectories import Trajectory, TrajectoryErrors, trajectory_errors
from pipelines.cli.options import Config
from pipelines.config import TrackConfig, load_config
from pipelines.slam.lidar_slam import path_tracker
from saga_fg.errors import InputError
from saga_fg.estimators import GraphSolution, IncrementalSmoother, RelinearisationSettings
from saga_fg.graph import EGO_POSE, Additions, FactorProvider, Factors, GraphError, GraphView
from saga_fg.numerics import (
    Assignment,
    FloatArray,
    IntArray,
    assign,
    checked_covariances,
    checked_transform,
    yaw_transform,
)
from saga_fg.slam.joint import (
    JointSettings,
    OdometryIncrements,
    OdometryNoise,
    estimate_jointly,
)
from saga_fg.slam.joint.graph import (
    JointEstimate,
    ObjectStates,
    Record,
    VehicleAndObjects,
    error_key,
    read_estimate,
    stationary_factors,
)
from saga_fg.slam.joint.record import (
    KEYFRAME_PERIOD,
    MAX_ITERATIONS,
    EpochRecorder,
    RecordedEpoch,
    in_ego,
    stationary_probabilities,
)
from saga_fg.slam.mapping import Given, pose_key
from saga_fg.tracking import Tracker
from saga_fg.types import Annotations, Boxes, Detections, Frame, Scene

_SAME = 1e-3  # probability


class StationaryPairs:
    """Factors of stationary objects for every two epochs, given anew where the probabilities have changed."""

    name = "stationary objects"

    def __init__(self) -> None:
        self._given: dict[int, tuple[FloatArray, FloatArray]] = {}

    def changed(self, record: Record, stationary: Sequence[FloatArray]) -> Given:
        """Return the provider of a window, with the probabilities (n,) of the objects of each epoch."""
        named: dict[Hashable, Factors] = {}
        given: dict[int, tuple[FloatArray, FloatArray]] = {}
        for pair, rows in zip(pairwise(stationary), pairwise(record), strict=True):
            k, before = rows[1].epoch, self._given.get(rows[1].epoch)
            if before is None or not all(np.allclose(a, b, atol=_SAME) for a, b in zip(before, pair, strict=True)):
                named[k], before = stationary_factors(rows, pair), pair
            given[k] = before
        self._given = given
        return Given(Additions(named=named), self.name)


_THRESHOLD = 0.1  # standard deviations that a variable moves before its factors are linearised anew


class OnlineEstimator:
    """Estimate one frame after the other.

        estimator = OnlineEstimator(Tracker(...), lag=3.0)
        newest = estimator.step(frame, a_T_b)
        newest.world_T_ego[-1], newest.objects[-1]

    tracker    a new one, which associates detections
    lag        s; the window begins at the last epoch that is at least so old
    settings   of the graph
    start      first pose (4, 4), by default the identity
    providers  of factors of your own, asked with each frame after its vehicle and objects are added

    Raises `InputError` for a negative lag, and a first pose that is not rigid.
    """

    def __init__(
        self,
        tracker: Tracker,
        lag: float,
        settings: JointSettings | None = None,
        start: FloatArray | None = None,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        if not (math.isfinite(lag) and lag >= 0):
            raise InputError(f"lag: expected a finite number of seconds >= 0, got {lag!r}")
        self._settings, self._lag = settings or JointSettings(), lag
        # without a lag of its own: epochs leave here, and elimination in the order of time would cost thrice as much
        self._smoother = IncrementalSmoother(providers, None, RelinearisationSettings(_THRESHOLD, MAX_ITERATIONS))
        self._recorder = EpochRecorder(tracker)
        self._start = np.eye(4) if start is None else checked_transform("start", start)
        self._slow = self._settings.odometry.slow
        self._pairs, self._stationary = StationaryPairs(), list[FloatArray]()
        self._record = list[RecordedEpoch]()  # of the window
        self._solution: GraphSolution | None = None

    def step(
        self, frame: Frame, a_T_b: FloatArray | None = None, covariance: FloatArray | None = None
    ) -> JointEstimate:
        """Add the next frame, after the vehicle moved by a_T_b (4, 4) since the last one by its odometry; its estimate.

        a_T_b: not needed for the first frame; covariance: (6, 6) of it as in `OdometryIncrements`, if the device states
        one. Raises `InputError` for a motion that is missing or not rigid, a bad covariance, a frame that is not later
        than the last one, or in world coordinates without a pose.
        """
        if not self._record:
            pose, increment, covariance = self._start, np.eye(4), None
        elif a_T_b is None:
            raise InputError("a_T_b: expected the motion since the last frame")
        else:
            increment = checked_transform("a_T_b", a_T_b)
            covariance = None if covariance is None else checked_covariances("covariance", [covariance], 1, 6)[0]
            pose = self._predicted(frame.timestamp, increment)
        number = self._record[-1].epoch + 1 if self._record else 0
        now = self._recorder.add(number, frame, pose, increment, covariance)
        record = [*self._record, now]
        self._stationary = self._probabilities(record, [*map(self._pose, self._record), pose])
        new = VehicleAndObjects(record[-2:], [pose], self._settings, known=len(record[-2:]) - 1)
        given = self._pairs.changed(record, self._stationary)
        try:
            self._smoother.step(now.time, [new, given, *self._smoother.providers], frame)
        except GraphError:
            self._pairs = StationaryPairs()  # whose factors are unknown now
            raise
        self._record, self._solution = record, self._smoother.solution()
        newest = self._estimate(1)
        since = now.time - self._lag
        gone = sum(one.time <= since for one in record[1:])
        self._smoother.forget(since=since)
        self._record, self._stationary = self._record[gone:], self._stationary[gone:]
        self._slow = newest.slow_errors
        return newest

    def window(self) -> JointEstimate:
        """The estimate of all epochs in the window. Raises `InputError` before the first frame."""
        if not self._record:
            raise InputError("expected a frame before the estimate is asked for")
        return self._estimate(len(self._record))

    def _estimate(self, count: int) -> JointEstimate:
        """The estimate of the newest epochs by the last solution, which has the epochs that left after it, too."""
        assert self._solution is not None
        return read_estimate(self._record[-count:], self._solution, self._stationary[-count:])

    def _probabilities(self, record: Sequence[RecordedEpoch], path: Sequence[FloatArray]) -> list[FloatArray]:
        """For each epoch the probabilities that its objects are stationary, along a path (n, 4, 4)."""
        return stationary_probabilities(record, np.stack(path), self._slow, self._settings, online=True)

    def _pose(self, epoch: RecordedEpoch) -> FloatArray:
        pose = self._smoother.state(pose_key(epoch.epoch))
        assert isinstance(pose, gtsam.Pose3)
        return pose.matrix()

    def _predicted(self, time: float, a_T_b: FloatArray) -> FloatArray:
        """The pose (4, 4) after the motion a_T_b, corrected by the estimated errors of the odometry."""
        last = self._record[-1]
        scale, bias, course = np.asarray(self._smoother.state(error_key(last.epoch)))
        step = yaw_transform(yaw=-bias * (time - last.time)) @ a_T_b
        step[:3, 3] = yaw_transform(yaw=-course)[:3, :3] @ a_T_b[:3, 3] / (1 + scale)
        return np.asarray(self._pose(last) @ step)


SENSOR = "lidar"
NEAR, SETTLED, MOVING = 2.0, 3, 1.0  # m, of a detection from the object that it is of; frames; m/s
SAME_TIME = 1e-3  # s, between a frame and its truth
FIGURES = ("world position, m", "world velocity, m/s", "ego position, m", "ego velocity, m/s")
Pair = tuple[int, str]  # frame, object
State = tuple[IntArray, FloatArray, FloatArray, Assignment]  # ids, states (n, 4), the vehicle's pose, detections
At = Callable[[int, Frame, Detections], Mapping[str, State]]


def joint(
    dataroot: Annotated[
        Path | None, typer.Option("--dataroot", help="KITTI tracking; without it, simulated streets.")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option("--detections", help="Folder of a detector: Car/, Pedestrian/, Cyclist/.")
    ] = None,
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes.")] = 10,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Samples of the odometry's errors per recording.")] = 1,
    online: Annotated[bool, typer.Option("--online", help="In a running graph, frame by frame.")] = False,
    lag: Annotated[float, typer.Option("--lag", min=0.0, help="Of the running graph, s.")] = 3.0,
    config: Config = None,
) -> Rows:
    """Joint against decoupled estimation with degraded odometry: errors of the path and of the objects.

    Decoupled: the odometry's path and the tracker along it; held: objects from the whole recording along that path.
    The odometry has noise, a scale error and a bias of the yaw rate, all wandering, sampled anew for every seed.

    \b
    Examples:
      python -m benchmarks joint --scenes 10
      python -m benchmarks joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --seeds 10
      python -m benchmarks joint --dataroot data/kitti --detections data/kitti/detections/pointrcnn --online
    """
    if (dataroot is None) != (detections is None):
        raise InputError("expected both --dataroot and --detections, or neither")
    if dataroot is None:
        many = [simulate_scene(street(), seed) for seed in range(scenes)]
    else:
        found = KittiTracking(dataroot, detections, None, True)
        many = [found.scene(name) for name in found.scenes]
    base = load_config("simulated" if dataroot is None else "kitti", config)
    run = partial(online_run, lag=lag) if online else batch_run
    yield from joint_rows(many, range(seeds), partial(run, config=base, settings=JointSettings()))


@dataclass
class Outcome:
    """A run: path by contender, (2,) sum of squared errors and number of poses; objects by contender and whether they
    move, (4, 2) sum of squares of each of FIGURES and pairs; figures of the path."""

    paths: dict[str, FloatArray] = field(default_factory=dict)
    objects: dict[tuple[str, bool], FloatArray] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)

    def add_path(self, name: str, column: str, error: float, poses: int) -> None:
        """Take in an error, RMS over the poses, m."""
        self.paths[name], self.figures[column] = np.array([error**2 * poses, poses]), error


OBJECTS = (("joint", "decoupled"), ("joint", "held"))


def joint_rows(scenes: Sequence[Scene], seeds: Sequence[int], run: Callable[..., Outcome]) -> Iterator[Row]:
    """A row for every run, and the changes of pooled errors: all scenes with the first seed, then with the next."""
    runs: dict[str, list[Outcome]] = {scene.name: [] for scene in scenes}
    for seed, scene in each([(seed, scene) for seed in seeds for scene in scenes], "runs"):
        outcome = run(scene, seed)
        runs[scene.name].append(outcome)
        yield "error of the vehicle's path", {"recording": scene.name, "seed": seed, **outcome.figures}
        for (name, moving), sums in outcome.objects.items():
            if moving and sums[0, 1]:
                rmse = dict(zip(FIGURES, np.sqrt(sums[:, 0] / sums[:, 1]), strict=True))
                about = {"recording": scene.name, "seed": seed, "method": name, "pairs": int(sums[0, 1])}
                yield "RMSE of moving objects, at every frame", {**about, **rmse}
    known = next(iter(runs.values()))[0]
    a, b = ([np.sum([o.paths[one] for o in some], axis=0) for some in runs.values()] for one in ("joint", "decoupled"))
    row = {"error": "joint against decoupled", "change": paired_bootstrap(a, b)}
    yield "changes of the pooled error of the path", row
    for name, base in OBJECTS:
        for moving in (True, False) if (base, True) in known.objects else ():
            mine, theirs = (
                np.array([np.sum([o.objects[one, moving] for o in some], axis=0) for some in runs.values()])
                for one in (name, base)
            )
            changes = {figure: paired_bootstrap(mine[:, k], theirs[:, k]) for k, figure in enumerate(FIGURES)}
            about = {"compared": f"{name} against {base}", "objects": "moving" if moving else "stationary"}
            yield "changes of pooled errors of objects", {**about, **changes}


def street(duration: float = 20.0) -> SimulatorSettings:
    """Simulated scenes with cars parked on both sides of the road."""
    return SimulatorSettings(parking_probability=1.0, duration=duration)


def degraded_drive(
    scene: Scene, settings: JointSettings, sensor: str, seed: int
) -> tuple[list[Frame], Trajectory, OdometryIncrements]:
    """The frames of one sensor, `KEYFRAME_PERIOD` apart, their true path, and odometry degraded as `settings.odometry`
    says."""
    frames = list[Frame]()
    for frame in scene.frames:
        if frame.sensor == sensor and (not frames or frame.timestamp > frames[-1].timestamp + KEYFRAME_PERIOD):
            frames.append(frame)
    poses = np.stack([frame.world_T_ego for frame in frames if frame.world_T_ego is not None])
    truth = Trajectory(np.array([frame.timestamp for frame in frames]), poses)
    exact = OdometryIncrements.of(truth.timestamps, poses)
    return frames, truth, degraded_odometry(exact, settings.odometry, np.random.default_rng(seed))


def degraded_odometry(
    odometry: OdometryIncrements, noise: OdometryNoise, rng: np.random.Generator
) -> OdometryIncrements:
    """Odometry with errors sampled from `noise`: independent ones, and random walks of scale, bias and course."""
    n, dt = len(odometry.a_T_b), odometry.dt
    deviations = np.sqrt(
        np.diagonal(noise.covariances(np.linalg.norm(odometry.a_T_b[:, :3, 3], axis=1), dt), axis1=1, axis2=2)
    )
    sampled = deviations * rng.standard_normal(deviations.shape)
    slow = rng.standard_normal(3) * noise.slow + np.cumsum(sampled[:, 6:], axis=0)
    bias = np.zeros((n, 3))
    bias[:, 2] = slow[:, 1] * dt
    a_T_b = odometry.a_T_b.copy()
    a_T_b[:, :3, :3] = _rotations(bias) @ a_T_b[:, :3, :3] @ _rotations(sampled[:, :3])
    course = np.zeros((n, 3))
    course[:, 2] = slow[:, 2]
    turned = (_rotations(course) @ a_T_b[:, :3, 3, None])[:, :, 0]
    a_T_b[:, :3, 3] = turned * (1 + slow[:, :1]) + sampled[:, 3:6]
    return OdometryIncrements(odometry.timestamps, a_T_b)


def _rotations(vector: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def batch_run(scene: Scene, seed: int, config: TrackConfig, settings: JointSettings) -> Outcome:
    """From the whole recording."""
    frames, truth, odometry = degraded_drive(scene, settings, SENSOR, seed)
    outcome, n, driven, tracker = Outcome(), len(frames), odometry.path(truth.world_T_ego[0]), path_tracker(config)
    once, new = replace(settings, passes=1), partial(path_tracker, config)
    solved = partial(estimate_jointly, frames, odometry, new)
    estimate = solved(settings, driven[0])

    def errors(path: FloatArray) -> TrajectoryErrors:
        return trajectory_errors(Trajectory(truth.timestamps, path), truth)

    alone, joined = errors(driven), errors(estimate.world_T_ego)
    outcome.figures["path, m"] = alone.path_length
    outcome.add_path("decoupled", "ATE, m: decoupled", alone.ate, n)
    outcome.add_path("joint", "joint", joined.ate, n)
    relative = (one.relative_translation for one in (alone, joined))
    outcome.figures |= dict(zip(("m per 10 m: decoupled", "m per 10 m: joint"), relative, strict=True))
    held = solved(once, driven[0], new_providers=lambda: [HeldPath(driven)])

    def at(k: int, frame: Frame, found: Detections) -> dict[str, State]:
        tracks = tracker.step(Frame(frame.timestamp, frame.sensor, found, driven[k], "ego"))
        states: dict[str, State] = {"decoupled": (tracks.id, _planar(tracks.boxes), driven[k], tracker.assignment)}
        for name, one in (("held", held), ("joint", estimate)):
            now = one.objects[k]
            states[name] = now.id, _planar(now), one.world_T_ego[k], one.assignment(k)
        return states

    if scene.ground_truth is not None:
        outcome.objects = object_sums(scene, frames, truth.world_T_ego, config, at)
    return outcome


def online_run(scene: Scene, seed: int, config: TrackConfig, settings: JointSettings, lag: float) -> Outcome:
    """In a running graph, read out at every frame. Raises `InputError` for a scene without ground truth."""
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth")
    frames, path, odometry = degraded_drive(scene, settings, SENSOR, seed)
    driven, outcome = odometry.path(path.world_T_ego[0]), Outcome()
    alone, joined = path_tracker(config), path_tracker(config)
    estimator = OnlineEstimator(joined, lag, settings, start=path.world_T_ego[0])
    newest = list[FloatArray]()

    def at(k: int, frame: Frame, found: Detections) -> dict[str, State]:
        tracks = alone.step(Frame(frame.timestamp, frame.sensor, found, driven[k], "ego"))
        step = estimator.step(frame, odometry.a_T_b[k - 1] if k else None)
        newest.append(step.world_T_ego[-1])
        now = step.objects[-1]
        return {
            "decoupled": (tracks.id, _planar(tracks.boxes), driven[k], alone.assignment),
            "joint": (now.id, _planar(now), newest[-1], joined.assignment),
        }

    outcome.objects = object_sums(scene, frames, path.world_T_ego, config, at)
    for name, poses in (("decoupled", driven), ("joint", np.stack(newest))):
        ate = trajectory_errors(Trajectory(path.timestamps, poses), path).ate
        outcome.add_path(name, f"ATE, m: {name}", ate, len(frames))
    return outcome


def object_sums(
    scene: Scene, frames: Sequence[Frame], true: FloatArray, config: TrackConfig, at: At
) -> dict[tuple[str, bool], FloatArray]:
    """Sums of squares (4, 2) with their counts, by contender and whether the objects move, over common pairs.

    true: poses (n, 4, 4) of the vehicle; at: states of the contenders at a frame
    """
    found: dict[str, dict[Pair, FloatArray]] = {}
    counts: dict[tuple[str, int, str], int] = {}
    speeds: dict[Pair, float] = {}
    for k, frame in enumerate(frames):
        detections = in_ego(frame, path_tracker(config).sensor(frame.sensor))
        contenders = at(k, frame, detections)
        truth = _truth_at(scene, frame.timestamp)
        if truth is None:
            continue
        objects = _true_objects(detections, frame.world_T_ego, truth)
        for contender, (ids, states, pose, assignment) in contenders.items():
            row, errors = {id_: n for n, id_ in enumerate(ids.tolist())}, found.setdefault(contender, {})
            for id_, detection in zip(assignment.id.tolist(), assignment.detection.tolist(), strict=True):
                if detection not in objects:
                    continue
                n = objects[detection]
                name = str(truth.id[n])
                before = counts.get((contender, id_, name), 0)
                counts[contender, id_, name] = before + 1
                real = np.concatenate([truth.boxes.position[n, :2], truth.boxes.velocity[n]])
                speeds[k, name] = float(np.hypot(*real[2:]))
                if id_ in row and before >= SETTLED and np.isfinite(real).all():
                    state = states[row[id_]]
                    seen = _from_vehicle(state, pose) - _from_vehicle(real, true[k])
                    errors[k, name] = np.concatenate([state - real, seen])
    common = sorted(set.intersection(*(set(errors) for errors in found.values()))) if found else []
    sums = {}
    for moving in (True, False):
        chosen = [pair for pair in common if (speeds[pair] > MOVING) == moving]
        for contender, errors in found.items():
            off = np.array([errors[pair] for pair in chosen]).reshape(-1, len(FIGURES), 2)
            squares = (off**2).sum(axis=(0, 2))
            sums[contender, moving] = np.stack([squares, np.full(len(FIGURES), len(chosen))], axis=1)
    return sums


def _from_vehicle(state: FloatArray, pose: FloatArray) -> FloatArray:
    R = pose[:2, :2]
    return np.concatenate([(state[:2] - pose[:2, 3]) @ R, state[2:] @ R])


def _truth_at(scene: Scene, time: float) -> Annotations | None:
    """The truth of a moment, s; None where the scene has none then."""
    moment = int(np.argmin(np.abs(scene.timestamps - time)))
    there = scene.ground_truth is not None and abs(scene.timestamps[moment] - time) <= SAME_TIME
    return scene.ground_truth[moment] if scene.ground_truth is not None and there else None


def _planar(objects: Boxes | ObjectStates) -> FloatArray:
    """States (n, 4) of objects: place and velocity in the plane."""
    return np.concatenate([objects.position[:, :2], objects.velocity], axis=1)


def _true_objects(detections: Detections, world_T_ego: FloatArray | None, truth: Annotations) -> dict[int, int]:
    """Rows of the truth by those of detections in the vehicle's frame."""
    boxes: Boxes = detections.boxes.transformed(np.eye(4) if world_T_ego is None else world_T_ego)
    apart = boxes.position[:, None, :2] - truth.boxes.position[None, :, :2]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    same = boxes.label[:, None] == truth.boxes.label[None, :]
    return dict(zip(*(rows.tolist() for rows in assign(distance, same & (distance < NEAR), NEAR)), strict=True))


@dataclass(frozen=True, eq=False)
class HeldPath:
    """Provider that holds the vehicle on a path (n, 4, 4), so that objects are estimated along it."""

    path: FloatArray
    name: str = "held path"

    def factors(self, view: GraphView) -> Additions:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
        pose = gtsam.Pose3(self.path[view.epoch])
        return Additions(factors=[gtsam.PriorFactorPose3(view.key(EGO_POSE, 0), pose, noise)])
