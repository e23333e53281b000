"""The vehicle and the objects around it online, in one running graph, against one after the other.

Decoupled: the odometry's path, and the tracker along it. Joint: `saga_fg.slam.joint.OnlineEstimator`, with the same
frames and odometry. Both are read out at every frame. Errors of objects are those of position and velocity in the
world, of the pairs (object, moment) that the tracker reports and that both have detected, within 2 m of the truth along
the true path, in at least `SETTLED` frames before: earlier, velocities are the priors of new tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_tools.figures import FigureTable, percent
from data_tools.metrics import Interval, paired_bootstrap
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.config import TrackConfig
from pipelines.slam.joint import degraded_drive
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import Assignment, assign
from saga_fg.slam.joint import JointSettings, OnlineEstimator
from saga_fg.slam.joint.record import in_ego
from saga_fg.tracking import Tracker
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame

NEAR, SETTLED = 2.0, 3  # m, of a detection from the object that it is of; frames
Pair = tuple[int, str]  # frame, object


@dataclass(frozen=True)
class OnlineRow:
    """One recording and seed, decoupled and joint: ATE (m), and of `pairs` the RMSE of positions (m) and velocities
    (m/s), and the median error of the velocities. settled_ate: of moments as they leave the window.
    """

    scene: str
    seed: int
    poses: int
    pairs: int
    ate: tuple[float, float]
    settled_ate: float
    position: tuple[float, float]
    velocity: tuple[float, float]
    median_velocity: tuple[float, float]


@dataclass(frozen=True)
class OnlineBench:
    """All rows, and relative changes of pooled errors, joint against decoupled: -0.2 says 20 % lower."""

    rows: tuple[OnlineRow, ...]
    ate: Interval
    position: Interval
    velocity: Interval


def bench_online(
    scenes: Sequence[Scene],
    config: TrackConfig,
    seeds: Sequence[int],
    lag: float,
    settings: JointSettings | None = None,
    sensor: str = "lidar",
    progress: Progress | None = None,
    so_far: Callable[[OnlineBench], None] | None = None,
) -> OnlineBench:
    """Run all scenes with the first seed, then with the next; so_far: called after every run with the results up to it.

    Raises `InputError` for a scene without ground truth.
    """
    rows: list[OnlineRow] = []
    for seed in seeds:
        for scene in scenes:
            rows.append(_run(scene, config, settings or JointSettings(), sensor, seed, lag))
            if progress is not None:
                progress(scene.name, len(rows), len(scenes) * len(seeds))
            if so_far is not None:
                so_far(_judged(rows))
    return _judged(rows)


def _run(scene: Scene, config: TrackConfig, settings: JointSettings, sensor: str, seed: int, lag: float) -> OnlineRow:
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth")
    frames, path, odometry = degraded_drive(scene, settings, sensor, seed)
    start = path.world_T_ego[0]
    alone, joined = (Tracker(replace(config.tracker, estimator="kalman"), config.sensors) for _ in range(2))
    estimator = OnlineEstimator(joined, lag, settings, start=start)
    driven = odometry.path(start)
    errors = _ObjectErrors(), _ObjectErrors()
    newest: list[FloatArray] = []
    settled: list[FloatArray] = []
    for k, frame in enumerate(frames):
        detections = in_ego(frame, alone.sensor(sensor))
        moment = int(np.argmin(np.abs(scene.timestamps - frame.timestamp)))
        truth, there = scene.ground_truth[moment], abs(scene.timestamps[moment] - frame.timestamp) < 1e-3
        objects = _objects(detections, frame.world_T_ego, truth) if there else {}
        tracks = alone.step(Frame(frame.timestamp, frame.sensor, detections, driven[k], "ego"))
        states = np.concatenate([tracks.boxes.position[:, :2], tracks.boxes.velocity], axis=1)
        errors[0].add(k, tracks.id, states, alone.assignment, objects, truth)
        step = estimator.step(frame, odometry.a_T_b[k - 1] if k else None)
        newest.append(step.newest.world_T_ego[-1])
        settled += [] if step.settled is None else [*step.settled.world_T_ego]
        now = step.newest.objects[-1]
        states = np.concatenate([now.position, now.velocity], axis=1)
        errors[1].add(k, now.id, states, joined.assignment, objects, truth)
    settled += [*estimator.window().world_T_ego]
    paths = (Trajectory(path.timestamps, np.stack(one)) for one in (list(driven), newest, settled))
    ate = [trajectory_errors(one, path).ate for one in paths]
    both = sorted(errors[0].found.keys() & errors[1].found.keys())
    off = [np.array([one.found[pair] for pair in both]).reshape(-1, 2, 2) for one in errors]
    length = [np.linalg.norm(one, axis=2) for one in off]  # (pairs, 2): of position and velocity
    rmse = [np.sqrt((one**2).mean(axis=0)) if len(both) else np.full(2, np.nan) for one in length]
    median = [float(np.median(one[:, 1])) if len(both) else float("nan") for one in length]
    return OnlineRow(
        scene.name,
        seed,
        len(frames),
        len(both),
        (ate[0], ate[1]),
        ate[2],
        (float(rmse[0][0]), float(rmse[1][0])),
        (float(rmse[0][1]), float(rmse[1][1])),
        (median[0], median[1]),
    )


def _objects(detections: Detections, world_T_ego: FloatArray | None, truth: Annotations) -> dict[int, int]:
    """Rows of the truth by those of detections in the vehicle's frame."""
    boxes: Boxes = detections.boxes.transformed(np.eye(4) if world_T_ego is None else world_T_ego)
    apart = boxes.position[:, None, :2] - truth.boxes.position[None, :, :2]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    same = boxes.label[:, None] == truth.boxes.label[None, :]
    return dict(zip(*(rows.tolist() for rows in assign(distance, same & (distance < NEAR), NEAR)), strict=True))


class _ObjectErrors:
    """Errors (4,) of the states of tracks, by frame and object; count: of detections of an object by a track."""

    def __init__(self) -> None:
        self.found: dict[Pair, FloatArray] = {}
        self._count: dict[tuple[int, str], int] = {}

    def add(
        self,
        frame: int,
        ids: IntArray,
        states: FloatArray,
        assignment: Assignment,
        objects: dict[int, int],
        truth: Annotations,
    ) -> None:
        """Take in the states (n, 4) of the tracks `ids` (n,) at a frame."""
        row = {id_: n for n, id_ in enumerate(ids.tolist())}
        for id_, detection in zip(assignment.id.tolist(), assignment.detection.tolist(), strict=True):
            if detection not in objects:
                continue
            n = objects[detection]
            name = str(truth.id[n])
            before = self._count.get((id_, name), 0)
            self._count[id_, name] = before + 1
            true = np.concatenate([truth.boxes.position[n, :2], truth.boxes.velocity[n]])
            if id_ in row and before >= SETTLED and np.isfinite(true).all():
                self.found[frame, name] = states[row[id_]] - true


def _judged(rows: Sequence[OnlineRow]) -> OnlineBench:
    names = list(dict.fromkeys(row.scene for row in rows))

    def change(errors: Callable[[OnlineRow], tuple[float, float]], count: Callable[[OnlineRow], int]) -> Interval:
        """Change of an RMSE from decoupled to joint; `count` is the number of poses or pairs in its squares."""
        sums = np.zeros((2, len(names), 2))
        for row in rows:
            if count(row):
                squares = np.square(errors(row)) * count(row)
                sums[:, names.index(row.scene)] += np.stack([squares, np.full(2, count(row))], axis=1)
        return paired_bootstrap(sums[1], sums[0])

    return OnlineBench(
        tuple(rows),
        change(lambda row: row.ate, lambda row: row.poses),
        change(lambda row: row.position, lambda row: row.pairs),
        change(lambda row: row.velocity, lambda row: row.pairs),
    )


def online_table(result: OnlineBench) -> FigureTable:
    """A row for each recording and seed, and the changes of the pooled errors."""
    names = ("ate", "position", "velocity", "median_velocity")
    rows = []
    for row in result.rows:
        ate, *objects = ("{:.3f} -> {:.3f}".format(*getattr(row, name)) for name in names)
        rows.append((row.scene, str(row.seed), ate, f"{row.settled_ate:.3f}", str(row.pairs), *objects))
    changes = (percent(result.ate), "", "", percent(result.position), percent(result.velocity), "")
    rows.append(("pooled, 95 % interval", "", *changes))
    columns = ("recording", "seed", "ATE, m", "settled", "pairs", "position, m", "velocity, m/s", "median")
    return FigureTable("decoupled -> joint, RMSE of objects in the world", columns, tuple(rows))
