"""The vehicle and the objects around it estimated together, with poor odometry, from whole recordings.

Decoupled: the odometry's path, and the tracker along it. Joint: odometry and objects in one graph. Held: objects by the
same graph, with past and future, the path held where the odometry has it. All know the same odometry, degraded by
errors sampled with a seed. Errors of objects are those of `benchmarks.joint_objects`. The absolute trajectory
error (ATE) of a path is measured after the path is aligned with the true one. Intervals are paired bootstraps over
recordings, the seeds of one recording taken together, of the change of the pooled error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.joint_objects import (
    HeldPath,
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
from benchmarks.simulated_poles import poles_at
from data_tools.figures import FigureTable, cell, percent
from data_tools.metrics import Interval, paired_bootstrap
from pipelines.config import TrackConfig
from pipelines.slam.joint import JointRun, path_tracker, run_joint
from pipelines.tracking import Progress
from saga_fg.slam.joint import JointSettings, LaneSettings, estimate_jointly
from saga_fg.slam.joint.record import in_ego
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame


@dataclass(frozen=True)
class JointRow:
    """One recording and seed: ATE (m) and relative error (m per 10 m) of each path, and poses in them.

    landmarks_ate        with poles as well; NaN where there are none
    joint_in_map         RMS distance from the truth without alignment, m
    lanes_in_map         RMS distance with vehicles drawn to the lanes of a map; NaN without a map
    lanes_ate            ATE with lanes
    objects              errors of objects; none without ground truth
    """

    scene: str
    seed: int
    poses: int
    path_length: float
    decoupled_ate: float
    joint_ate: float
    decoupled_relative: float
    joint_relative: float
    landmarks_ate: float
    joint_in_map: float
    lanes_in_map: float
    lanes_ate: float
    objects: tuple[ObjectRow, ...]


@dataclass(frozen=True)
class JointBench:
    """All rows, and relative changes of the pooled ATE: -0.2 says that it is 20 % lower.

    change     of joint against decoupled
    landmarks  of joint with poles against joint without; None without poles
    lanes      of joint with lanes against joint without, of the error in the map; None without lanes
    objects    of errors of objects, joint against the others
    """

    rows: tuple[JointRow, ...]
    change: Interval
    landmarks: Interval | None
    lanes: Interval | None
    objects: tuple[ObjectChange, ...]


def bench_joint(
    scenes: Sequence[Scene],
    config: TrackConfig,
    seeds: Sequence[int],
    settings: JointSettings | None = None,
    sensor: str = "lidar",
    poles: bool = False,
    lanes: bool = False,
    progress: Progress | None = None,
    so_far: Callable[[JointBench], None] | None = None,
) -> JointBench:
    """Run all scenes with the first seed, then with the next; with `poles` once more, with those beside the road, and
    with `lanes` once more, with vehicles drawn to the lanes of the maps that the scenes bring along.

    so_far: called after every run with the results up to it
    """
    settings = settings or JointSettings()
    rows: list[JointRow] = []
    for seed in seeds:
        for scene in scenes:
            run = run_joint(scene, config, settings, sensor, seed)
            errors = run.errors()
            odometry, joint = errors["odometry"], errors["joint"]
            with_poles = float("nan")
            if poles:
                see = partial(poles_at, seed=seed)
                with_poles = run_joint(scene, config, settings, sensor, seed, see).errors()["joint"].ate
            on_lanes = None
            if lanes:
                on_lanes = run_joint(scene, config, replace(settings, lanes=LaneSettings()), sensor, seed)
            rows.append(
                JointRow(
                    scene.name,
                    seed,
                    odometry.poses,
                    odometry.path_length,
                    odometry.ate,
                    joint.ate,
                    odometry.relative_translation,
                    joint.relative_translation,
                    with_poles,
                    _in_map(run),
                    float("nan") if on_lanes is None else _in_map(on_lanes),
                    float("nan") if on_lanes is None else on_lanes.errors()["joint"].ate,
                    score_objects(run, scene, config, settings),
                )
            )
            if progress is not None:
                progress(scene.name, len(rows), len(scenes) * len(seeds))
            if so_far is not None:
                so_far(_judged(rows, poles, lanes))
    return _judged(rows, poles, lanes)


def score_objects(run: JointRun, scene: Scene, config: TrackConfig, settings: JointSettings) -> tuple[ObjectRow, ...]:
    """Errors of the objects of a run; none without ground truth."""
    if scene.ground_truth is None:
        return ()
    driven, true = run.odometry.world_T_ego, run.truth.world_T_ego
    held = estimate_jointly(
        run.frames,
        run.increments,
        partial(path_tracker, config),
        replace(settings, passes=1),
        driven[0],
        new_providers=lambda: [HeldPath(driven)],
    )
    tracker = path_tracker(config)
    errors = {name: ObjectErrors() for name in ("decoupled", "held", "joint")}
    labelled = []
    for k, frame in enumerate(run.frames):
        detections = in_ego(frame, tracker.sensor(frame.sensor))
        tracks = tracker.step(Frame(frame.timestamp, frame.sensor, detections, driven[k], "ego"))
        if (truth := truth_at(scene, frame.timestamp)) is None:
            continue
        labelled.append((k, truth))
        objects = true_objects(detections, frame.world_T_ego, truth)
        found = {"decoupled": (tracks.id, planar_states(tracks.boxes), driven[k], tracker.assignment)}
        for name, one in (("held", held), ("joint", run.estimate)):
            now = one.objects[k]
            found[name] = now.id, planar_states(now), one.world_T_ego[k], one.assignment(k)
        for name, (ids, states, pose, assignment) in found.items():
            errors[name].add(k, ids, states, (pose, true[k]), detected_by(assignment), objects, truth)
    return object_rows(errors, true_speeds(labelled))


def _in_map(run: JointRun) -> float:
    off = run.paths["joint"].positions - run.truth.positions
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _judged(rows: Sequence[JointRow], poles: bool, lanes: bool) -> JointBench:
    change = _change(rows, lambda row: row.joint_ate, lambda row: row.decoupled_ate)
    landmarks = _change(rows, lambda row: row.landmarks_ate, lambda row: row.joint_ate) if poles else None
    in_lanes = _change(rows, lambda row: row.lanes_in_map, lambda row: row.joint_in_map) if lanes else None
    recordings = by_recording((row.scene, row.objects) for row in rows)
    objects = object_changes(recordings, "joint", ("decoupled", "held")) if any(row.objects for row in rows) else ()
    return JointBench(tuple(rows), change, landmarks, in_lanes, objects)


def _change(rows: Sequence[JointRow], a: Callable[[JointRow], float], b: Callable[[JointRow], float]) -> Interval:
    names = list(dict.fromkeys(row.scene for row in rows))

    def sums(ate: Callable[[JointRow], float]) -> list[list[float]]:
        """Sum of squared errors and number of poses of each recording."""
        mine = ([row for row in rows if row.scene == name] for name in names)
        return [[sum(r.poses * ate(r) ** 2 for r in some), float(sum(r.poses for r in some))] for some in mine]

    return paired_bootstrap(sums(a), sums(b))


def joint_tables(result: JointBench) -> list[FigureTable]:
    rows = []
    for name in dict.fromkeys(row.scene for row in result.rows):
        mine = [row for row in result.rows if row.scene == name]
        figures = [
            (r.decoupled_ate, r.joint_ate, r.decoupled_relative, r.joint_relative, r.landmarks_ate, r.lanes_in_map)
            for r in mine
        ]
        rows.append(
            (name, str(len(mine)), cell(mine[0].path_length, 0), *(cell(x) for x in np.median(figures, axis=0)))
        )
    columns = (
        *("recording", "samples", "path, m", "ATE, m: decoupled", "joint"),
        *("m per 10 m: decoupled", "joint", "ATE with poles, m", "in the map with lanes, m"),
    )
    compared = [("ATE, joint against decoupled", result.change, [r.joint_ate < r.decoupled_ate for r in result.rows])]
    if result.landmarks is not None:
        better = [r.landmarks_ate < r.joint_ate for r in result.rows]
        compared.append(("ATE, with poles against without", result.landmarks, better))
    if result.lanes is not None:
        better = [r.lanes_in_map < r.joint_in_map for r in result.rows]
        compared.append(("error in the map, with lanes against without", result.lanes, better))
    changes = tuple((what, percent(by), f"{sum(lower)} of {len(lower)}") for what, by, lower in compared)
    return [
        FigureTable("error of the vehicle's path, medians over samples", columns, tuple(rows)),
        FigureTable("changes of pooled errors", ("error", "change, 95 % interval", "lower in runs"), changes),
        *object_tables(by_recording((row.scene, row.objects) for row in result.rows), result.objects),
    ]
