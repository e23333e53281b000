"""What it is worth to estimate the vehicle and the objects around it together, where the odometry is poor.

Decoupled: the odometry's path. Joint: odometry and objects in one graph. Both know the same odometry, degraded by
errors drawn with a seed. The absolute error (ATE) of a path is that after it was moved to lie nearest to the true one.
Intervals are paired bootstraps over recordings, the seeds of one recording taken together, of the pooled ATE's change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from data_tools.metrics import Interval, paired_bootstrap
from pipelines.config import TrackConfig
from pipelines.slam.joint import JointRun, run_joint
from pipelines.slam.simulated_poles import poles_at
from pipelines.tracking import Progress
from saga_fg.slam.joint import JointSettings, LaneSettings
from saga_fg.types.dataset import Scene


@dataclass(frozen=True)
class JointRow:
    """One recording and seed: ATE (m) and relative error (m per 10 m) of each path, and poses in them.

    landmarks_ate        with poles as well; NaN where there are none
    joint_in_map         RMS distance from the truth as the path is, not moved to lie nearest to it, m
    lanes_in_map         the same with vehicles drawn to the lanes of a map; NaN where there is none
    lanes_ate            and the ATE
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


@dataclass(frozen=True)
class JointBench:
    """All rows, and relative changes of the pooled ATE: -0.2 says that it is 20 % lower.

    change     of joint against decoupled
    landmarks  of joint with poles against joint without; None without poles
    lanes      of joint with lanes against joint without, of the error in the map; None without lanes
    """

    rows: tuple[JointRow, ...]
    change: Interval
    landmarks: Interval | None
    lanes: Interval | None


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

    so_far: told after every run what the runs up to it say
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
                )
            )
            if progress is not None:
                progress(scene.name, len(rows), len(scenes) * len(seeds))
            if so_far is not None:
                so_far(_judged(rows, poles, lanes))
    return _judged(rows, poles, lanes)


def _in_map(run: JointRun) -> float:
    off = run.paths["joint"].positions - run.truth.positions
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _judged(rows: Sequence[JointRow], poles: bool, lanes: bool) -> JointBench:
    change = _change(rows, lambda row: row.joint_ate, lambda row: row.decoupled_ate)
    landmarks = _change(rows, lambda row: row.landmarks_ate, lambda row: row.joint_ate) if poles else None
    in_lanes = _change(rows, lambda row: row.lanes_in_map, lambda row: row.joint_in_map) if lanes else None
    return JointBench(tuple(rows), change, landmarks, in_lanes)


def _change(rows: Sequence[JointRow], a: Callable[[JointRow], float], b: Callable[[JointRow], float]) -> Interval:
    names = list(dict.fromkeys(row.scene for row in rows))

    def sums(ate: Callable[[JointRow], float]) -> list[list[float]]:
        """Of each recording: squared errors, poses."""
        mine = ([row for row in rows if row.scene == name] for name in names)
        return [[sum(r.poses * ate(r) ** 2 for r in some), float(sum(r.poses for r in some))] for some in mine]

    return paired_bootstrap(sums(a), sums(b))
