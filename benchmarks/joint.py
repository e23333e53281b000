"""The vehicle and the objects around it in one graph, against one after the other, with poor odometry.

Decoupled: the odometry's path, and the tracker along it. Joint: odometry and objects in one graph. Held: objects by the
same graph, with past and future, the path held where the odometry has it. Online, joint is the tracker along
`saga_fg.slam.joint.OnlinePath`, read out at every frame. All know the same odometry, degraded by errors sampled with a
seed. Paths are aligned with the true one before their absolute trajectory error (ATE) is taken.

A pair is an object at a frame, with a detection within `NEAR` of the truth along the true path, of a track that has
detected it in at least `SETTLED` frames before: earlier, velocities are the priors of new tracks. Contenders are
compared on the pairs that all of them have. With the estimated and the true pose (R, t), (R', t') of the vehicle,

    in the world    p - p',  v - v'                     from it    R^T (p - t) - R'^T (p' - t'),  R^T v - R'^T v'

Intervals are paired bootstraps over recordings, the seeds of one taken together, of changes of pooled errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import gtsam
import numpy as np
import typer

from benchmarks.runner import Row, Rows, each, paired_bootstrap
from data_tools.datasets.kitti import KittiTracking
from data_tools.simulator import SimulatorSettings, simulate_scene
from data_tools.trajectories import Trajectory, TrajectoryErrors, trajectory_errors
from factors.manifolds import rotation_exp
from pipelines.cli.options import Config
from pipelines.config import TrackConfig, load_config
from pipelines.slam.lidar_slam import path_tracker
from saga_fg.errors import InputError
from saga_fg.graph import EGO_POSE, Additions, GraphView
from saga_fg.numerics import Assignment, FloatArray, IntArray, assign
from saga_fg.slam.joint import JointSettings, OdometryIncrements, OdometryNoise, OnlinePath, estimate_jointly
from saga_fg.slam.joint.graph import ObjectStates
from saga_fg.slam.joint.record import KEYFRAME_PERIOD, in_ego
from saga_fg.types import (
    Annotations,
    Boxes,
    Detections,
    Frame,
    Scene,
)

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
    online: Annotated[bool, typer.Option("--online", help="Frame by frame.")] = False,
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
    run = online_run if online else batch_run
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
    a_T_b[:, :3, :3] = rotation_exp(bias) @ a_T_b[:, :3, :3] @ rotation_exp(sampled[:, :3])
    course = np.zeros((n, 3))
    course[:, 2] = slow[:, 2]
    turned = (rotation_exp(course) @ a_T_b[:, :3, 3, None])[:, :, 0]
    a_T_b[:, :3, 3] = turned * (1 + slow[:, :1]) + sampled[:, 3:6]
    return OdometryIncrements(odometry.timestamps, a_T_b)


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


def online_run(scene: Scene, seed: int, config: TrackConfig, settings: JointSettings) -> Outcome:
    """Frame by frame. Raises `InputError` for a scene without ground truth."""
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth")
    frames, path, odometry = degraded_drive(scene, settings, SENSOR, seed)
    driven, outcome = odometry.path(path.world_T_ego[0]), Outcome()
    a_T_b = [np.eye(4), *odometry.a_T_b]
    alone, joined = path_tracker(config), path_tracker(config)
    online, newest, aside = OnlinePath(joined, settings, driven[0]), list[FloatArray](), list[bool]()

    def at(k: int, frame: Frame, found: Detections) -> dict[str, State]:
        decoupled = alone.step(Frame(frame.timestamp, frame.sensor, found, driven[k], "ego"))
        joint = online.step(frame, a_T_b[k])
        newest.append(online.world_T_ego)
        aside.append(online.aside)
        return {
            "decoupled": (decoupled.id, _planar(decoupled.boxes), driven[k], alone.assignment),
            "joint": (joint.id, _planar(joint.boxes), newest[-1], joined.assignment),
        }

    outcome.objects = object_sums(scene, frames, path.world_T_ego, config, at)
    for name, poses in (("decoupled", driven), ("joint", np.stack(newest))):
        ate = trajectory_errors(Trajectory(path.timestamps, poses), path).ate
        outcome.add_path(name, f"ATE, m: {name}", ate, len(frames))
    outcome.figures["share aside"] = float(np.mean(aside))
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
