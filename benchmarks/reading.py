"""What it takes to read nuScenes: peak memory and time of a process that does nothing else."""

from __future__ import annotations

import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from benchmarks.large_tables import VERSION
from data_tools.datasets.nuscenes import NuScenes


@dataclass(frozen=True)
class ReadingFigures:
    """scenes, samples, annotations and detections read; seconds of CPU time; start and peak: memory before, and at
    most, MB."""

    scenes: int
    samples: int
    annotations: int
    detections: int
    seconds: float
    start: float
    peak: float


def bench_reading(folder: Path) -> ReadingFigures:
    """Read all of what `write_large_tables` has written to a folder, ground truth and detections, in a new process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(read_everything, folder).result()


def read_everything(folder: Path) -> ReadingFigures:
    """In this process, of which the figures are."""
    start, begin = peak_memory(), time.process_time()
    dataset = NuScenes(folder, VERSION, {"lidar": folder / "lidar.json"}, ground_truth=True)
    samples = annotations = detections = 0
    for name in dataset.scenes:
        scene = dataset.scene(name)
        samples += len(scene)
        annotations += sum(len(moment) for moment in scene.ground_truth or ())
        detections += sum(len(frame) for frame in scene.frames)
    seconds = time.process_time() - begin
    return ReadingFigures(len(dataset.scenes), samples, annotations, detections, seconds, start, peak_memory())


def peak_memory() -> float:
    """The most that this process ever held, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3
