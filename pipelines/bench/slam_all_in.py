"""LiDAR SLAM all in: CPU time of every step on some scans, odometry, landmarks, graph and loops together."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from data_tools.lidar.scan import ScanSequence
from pipelines.process import one_thread, peak_memory
from pipelines.slam.lidar_slam import LidarSlam
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import FloatArray


@dataclass(frozen=True)
class AllIn:
    """points: of a scan, mean; milliseconds of CPU: of all scans, of odometry's part, of keyframes, mean, and the
    longest (which closes a submap); growth: the last third's keyframes to the first third's, those that close submaps
    left out; finish: s; memory: MB, largest of the process.
    """

    case: str
    scans: int
    keyframes: int
    submaps: int
    points: float
    mean: float
    between: float
    keyframe: float
    longest: float
    growth: float
    finish: float
    memory: float


def bench_all_in(case: str, scans: ScanSequence, progress: Progress | None = None) -> AllIn:
    """Place all scans, one after the other."""
    slam = LidarSlam(scans.world_T_ego[0] @ scans.ego_T_lidar, ego_T_lidar=scans.ego_T_lidar)
    spent, points = np.zeros(len(scans)), np.zeros(len(scans))
    keyframe, closes = np.zeros(len(scans), dtype=bool), np.zeros(len(scans), dtype=bool)
    with one_thread():
        for k, timestamp in enumerate(scans.timestamps.tolist()):
            scan = scans[k]
            began = time.process_time()
            step = slam.step(scan, timestamp)
            spent[k], keyframe[k], points[k] = time.process_time() - began, step.keyframe is not None, len(scan)
            closes[k] = step.submap is not None
            if progress is not None:
                progress("all in", k + 1, len(scans))
        began = time.process_time()
        result = slam.finish()
        finish = time.process_time() - began
    plain = spent[keyframe & ~closes]
    early, late = plain[: len(plain) // 3], plain[-(len(plain) // 3) :]
    return AllIn(
        case,
        len(scans),
        int(keyframe.sum()),
        len(result.submaps),
        float(points.mean()),
        _mean(spent),
        _mean(spent[~keyframe]),
        _mean(spent[keyframe]),
        1e3 * float(spent.max()),
        _mean(late) / _mean(early),
        finish,
        peak_memory(),
    )


def _mean(seconds: FloatArray) -> float:
    return 1e3 * float(seconds.mean()) if len(seconds) else float("nan")
