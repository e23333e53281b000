"""LiDAR SLAM all in: CPU time of every step on some scans, odometry, landmarks, graph and loops together."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from data_tools.lidar.scan import ScanSequence
from pipelines.process import one_thread, peak_memory
from pipelines.slam.lidar_slam import LidarSlam
from pipelines.slam.odometry import LidarOdometry
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import BoolArray, FloatArray

_PARTS = 10
_EVERY = 50  # scans from one measurement of the machine's load to the next


@dataclass(frozen=True)
class AllInPart:
    """Scans `first` to before `last`: milliseconds of a keyframe, and of one that closes a submap; MB so far."""

    first: int
    last: int
    keyframe: float
    closing: float
    memory: float


@dataclass(frozen=True)
class AllIn:
    """points: of a scan, mean; milliseconds of CPU: of all scans, of odometry's part, of keyframes, mean, and the
    longest (which closes a submap); finish: s; memory: MB, largest of the process; loops, and those left out.

    growth  the last lap's keyframes to the first lap's, in the same streets, those that close submaps left out; without
            laps the last third's to the first third's
    closing the same of those that close submaps, which search for loops
    load    the same of a piece of work that never changes: two scans placed by odometry alone
    """

    case: str
    scans: int
    keyframes: int
    submaps: int
    loops: int
    false_loops: int
    points: float
    mean: float
    between: float
    keyframe: float
    longest: float
    growth: float
    closing: float
    load: float
    finish: float
    memory: float
    parts: list[AllInPart]


def bench_all_in(case: str, scans: ScanSequence, progress: Progress | None = None, lap: float | None = None) -> AllIn:
    """Place all scans, one after the other; lap: m, if the drive passes the same streets in each."""
    slam = LidarSlam(scans.world_T_ego[0] @ scans.ego_T_lidar, ego_T_lidar=scans.ego_T_lidar)
    spent, points, load, memory = np.zeros(len(scans)), np.zeros(len(scans)), np.full(len(scans), np.nan), []
    keyframe, closes = np.zeros(len(scans), dtype=bool), np.zeros(len(scans), dtype=bool)
    with one_thread():
        for k, timestamp in enumerate(scans.timestamps.tolist()):
            scan = scans[k]
            began = time.process_time()
            step = slam.step(scan, timestamp)
            spent[k], keyframe[k], points[k] = time.process_time() - began, step.keyframe is not None, len(scan)
            closes[k] = step.submap is not None
            memory.append(peak_memory())
            if k % _EVERY == _EVERY - 1:
                load[k] = _load(scans)
            if progress is not None:
                progress("all in", k + 1, len(scans))
        began = time.process_time()
        result = slam.finish()
        finish = time.process_time() - began
    way = np.linalg.norm(np.diff(scans.world_T_ego[:, :3, 3], axis=0), axis=1).cumsum()
    way = np.concatenate([[0.0], way])
    plain, closing = (np.where(keyframe & rows, spent, np.nan) for rows in (~closes, closes))
    parts = [
        AllInPart(a, b, _mean(plain[a:b]), _mean(closing[a:b]), memory[b - 1])
        for a, b in pairwise(np.linspace(0, len(scans), _PARTS + 1).astype(int).tolist())
        if b > a
    ]
    growth, closing_growth, load_growth = (_growth(each, keyframe, way, lap) for each in (plain, closing, load))
    return AllIn(
        case,
        len(scans),
        int(keyframe.sum()),
        len(result.submaps),
        len(result.loops),
        len(result.false_loops),
        float(points.mean()),
        _mean(spent),
        _mean(spent[~keyframe]),
        _mean(spent[keyframe]),
        1e3 * float(spent.max()),
        growth,
        closing_growth,
        load_growth,
        finish,
        peak_memory(),
        parts,
    )


def _growth(seconds: FloatArray, keyframe: BoolArray, way: FloatArray, lap: float | None) -> float:
    """The mean at the end by that at the beginning; NaN are left out."""
    if lap is None or way[-1] < lap:
        number = keyframe.cumsum()
        early, late = number <= number[-1] / 3, number > 2 * number[-1] / 3
    else:
        long = min(lap, way[-1] / 2)
        early, late = way <= long, way >= way[-1] - long
    return _mean(seconds[late]) / _mean(seconds[early])


def _load(scans: ScanSequence) -> float:
    first, second = scans[0], scans[1]
    odometry = LidarOdometry()
    began = time.process_time()
    for scan, timestamp in zip((first, second), scans.timestamps[:2].tolist(), strict=True):
        odometry.step(scan, timestamp)
    return time.process_time() - began


def _mean(seconds: FloatArray) -> float:
    known = seconds[np.isfinite(seconds)]
    return 1e3 * float(known.mean()) if len(known) else float("nan")
