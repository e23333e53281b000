"""The vehicle and the objects around it online, in one running graph, against one after the other.

Decoupled: the odometry's path, and the tracker along it. Joint: `saga_fg.slam.joint.OnlineEstimator`, with the same
frames and odometry. Both are read out at every frame. Errors of objects are those of `benchmarks.joint_objects`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.joint_objects import (
    ObjectChange,
    ObjectErrors,
    ObjectRow,
    by_recording,
    detected_by,
    object_changes,
    object_rows,
    object_tables,
    planar_states,
    true_objects,
    true_speeds,
    truth_at,
)
from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval, paired_bootstrap
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.config import TrackConfig
from pipelines.slam.joint import degraded_drive, path_tracker
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint import JointSettings, OnlineEstimator
from saga_fg.slam.joint.record import in_ego
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame


@dataclass(frozen=True)
class OnlineRow:
    """One recording and seed: ATE (m), decoupled and joint, and errors of objects.

    settled_ate: joint, of moments as they leave the window
    """

    scene: str
    seed: int
    poses: int
    ate: tuple[float, float]
    settled_ate: float
    objects: tuple[ObjectRow, ...]


@dataclass(frozen=True)
class OnlineBench:
    """All rows, and relative changes of pooled errors, joint against decoupled: -0.2 says 20 % lower."""

    rows: tuple[OnlineRow, ...]
    ate: Interval
    objects: tuple[ObjectChange, ...]


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
    alone, joined = path_tracker(config), path_tracker(config)
    estimator = OnlineEstimator(joined, lag, settings, start=start)
    driven = odometry.path(start)
    errors = {"decoupled": ObjectErrors(), "joint": ObjectErrors()}
    newest: list[FloatArray] = []
    settled: list[FloatArray] = []
    labelled = []
    for k, frame in enumerate(frames):
        detections = in_ego(frame, alone.sensor(sensor))
        tracks = alone.step(Frame(frame.timestamp, frame.sensor, detections, driven[k], "ego"))
        step = estimator.step(frame, odometry.a_T_b[k - 1] if k else None)
        newest.append(step.newest.world_T_ego[-1])
        settled += [] if step.settled is None else [*step.settled.world_T_ego]
        if (truth := truth_at(scene, frame.timestamp)) is None:
            continue
        labelled.append((k, truth))
        objects = true_objects(detections, frame.world_T_ego, truth)
        now = step.newest.objects[-1]
        for name, tracker, ids, states, pose in (
            ("decoupled", alone, tracks.id, planar_states(tracks.boxes), driven[k]),
            ("joint", joined, now.id, planar_states(now), newest[-1]),
        ):
            detected = detected_by(tracker.assignment)
            errors[name].add(k, ids, states, (pose, path.world_T_ego[k]), detected, objects, truth)
    settled += [*estimator.window().world_T_ego]
    paths = (Trajectory(path.timestamps, np.stack(one)) for one in (list(driven), newest, settled))
    ate = [trajectory_errors(one, path).ate for one in paths]
    return OnlineRow(
        scene.name, seed, len(frames), (ate[0], ate[1]), ate[2], object_rows(errors, true_speeds(labelled))
    )


def _judged(rows: Sequence[OnlineRow]) -> OnlineBench:
    recordings = by_recording((row.scene, row.objects) for row in rows)
    sums = np.zeros((2, len(recordings), 2))
    for n, name in enumerate(recordings):
        for row in rows:
            if row.scene == name:
                sums[:, n] += np.stack([np.square(row.ate) * row.poses, np.full(2, row.poses)], axis=1)
    changes = object_changes(recordings, "joint", ["decoupled"])
    return OnlineBench(tuple(rows), paired_bootstrap(sums[1], sums[0]), changes)


def online_tables(result: OnlineBench) -> list[FigureTable]:
    """The error of the path of each recording and seed, errors of objects, and the changes of the pooled ones."""
    rows = [
        (row.scene, str(row.seed), cell(row.ate[0]), cell(row.ate[1]), cell(row.settled_ate)) for row in result.rows
    ]
    rows.append(("pooled, 95 % interval", "", "", percent(result.ate), ""))
    columns = ("recording", "seed", "ATE, m: decoupled", "joint", "joint, settled")
    recordings = by_recording((row.scene, row.objects) for row in result.rows)
    return [FigureTable("error of the path, online", columns, tuple(rows)), *object_tables(recordings, result.objects)]
