"""What it is worth to estimate the vehicle and the objects around it together, where the odometry is poor.

Decoupled: the odometry's path. Joint: odometry and objects in one graph. Both know the same odometry, degraded by
errors drawn with a seed. The absolute error (ATE) of a path is that after it was moved to lie nearest to the true one.
Intervals are paired bootstraps over recordings, the seeds of one recording taken together, of the pooled ATE's change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from data_tools.metrics import Interval, paired_bootstrap
from pipelines.config import TrackConfig
from pipelines.slam.joint import run_joint
from pipelines.slam.roadside import observe_poles
from pipelines.tracking import Progress
from saga_fg.dataset import Scene
from saga_fg.ego import JointSettings


@dataclass(frozen=True)
class JointRow:
    """One recording and seed: ATE (m) and relative error (m per 10 m) of each path, and poses in them.

    landmarks_ate: with poles as well; NaN where there are none
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


@dataclass(frozen=True)
class JointBench:
    """All rows, and relative changes of the pooled ATE: -0.2 says that it is 20 % lower.

    change: of joint against decoupled; landmarks: of joint with poles against joint without, None without poles
    """

    rows: tuple[JointRow, ...]
    change: Interval
    landmarks: Interval | None


def bench_joint(
    scenes: Sequence[Scene],
    config: TrackConfig,
    seeds: Sequence[int],
    settings: JointSettings | None = None,
    sensor: str = "lidar",
    poles: bool = False,
    progress: Progress | None = None,
    so_far: Callable[[JointBench], None] | None = None,
) -> JointBench:
    """Run all scenes with the first seed, then with the next; with `poles` once more, with those beside the road.

    so_far: told after every run what the runs up to it say
    """
    settings = settings or JointSettings()
    rows: list[JointRow] = []
    for seed in seeds:
        for scene in scenes:
            run = run_joint(scene, config, settings, sensor, seed)
            odometry, joint = run.errors()
            with_poles = float("nan")
            if poles:
                see = partial(observe_poles, seed=seed)
                with_poles = run_joint(scene, config, settings, sensor, seed, see).errors()[1].ate
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
                )
            )
            if progress is not None:
                progress(scene.name, len(rows), len(scenes) * len(seeds))
            if so_far is not None:
                so_far(_judged(rows, poles))
    return _judged(rows, poles)


def _judged(rows: Sequence[JointRow], poles: bool) -> JointBench:
    change = _change(rows, lambda row: row.joint_ate, lambda row: row.decoupled_ate)
    landmarks = _change(rows, lambda row: row.landmarks_ate, lambda row: row.joint_ate) if poles else None
    return JointBench(tuple(rows), change, landmarks)


def _change(rows: Sequence[JointRow], a: Callable[[JointRow], float], b: Callable[[JointRow], float]) -> Interval:
    names = list(dict.fromkeys(row.scene for row in rows))

    def sums(ate: Callable[[JointRow], float]) -> list[list[float]]:
        """Of each recording: squared errors, poses."""
        mine = ([row for row in rows if row.scene == name] for name in names)
        return [[sum(r.poses * ate(r) ** 2 for r in some), float(sum(r.poses for r in some))] for some in mine]

    return paired_bootstrap(sums(a), sums(b))
