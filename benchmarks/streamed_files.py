"""What a long file of one's own costs from its first line to the last label: memory and time of `smooth_stream`.

The platoons of `benchmarks.streaming`, each on a road of its own, written as a table of detections.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.streaming import PLATOON, StreamingBenchSettings, traffic
from data_tools.datasets.detection_files import read_detections, read_scenes_in_parts
from pipelines.process import one_thread, resident_memory
from pipelines.smoothing import StretchSettings, load_smooth_config, smooth_scene, smooth_stream, write_streamed_labels
from saga_fg.smoothing import Labels

ROADS, APART = 400, 1000.0  # side by side, m apart: platoons do not meet
VELOCITY_NOISE = 1.0  # standard deviation of a measured velocity, m/s
PART = 30.0  # s that are read at a time, after which memory is looked at


@dataclass(frozen=True)
class FileRow:
    """When so much was recorded (s): resident memory and the most so far (MB), and CPU time so far (s)."""

    recorded: float
    memory: float
    peak: float
    cpu: float


@dataclass(frozen=True)
class FileBench:
    """What was measured: rows over the recording; peak memory of the process (MB); CPU time over recorded time; boxes.

    growth              peak memory over that of a recording of a quarter of the length
    largest_difference  of any position from what is made of the whole recording at once, m, on a short one
    differing           boxes that only one of the two has there, of `compared`
    """

    rows: tuple[FileRow, ...]
    peak: float
    growth: float
    ratio: float
    boxes: int
    largest_difference: float
    differing: int
    compared: int


def bench_files(settings: StreamingBenchSettings, progress: Callable[[str, int, int], None] | None = None) -> FileBench:
    """Write a recording, smooth it as it is read; then a short one in short stretches and at once."""
    config = load_smooth_config("file")
    with TemporaryDirectory() as folder, one_thread():
        table = Path(folder) / "detections.csv"
        write_traffic(table, settings)
        frames = round(settings.seconds * settings.rate)
        rows: list[FileRow] = []
        begin = time.thread_time()

        def look(name: str, done: int, _: int) -> None:
            rows.append(FileRow(done / settings.rate, resident_memory(), _peak(), time.thread_time() - begin))
            if progress is not None:
                progress(name, done, frames)

        rows_read = round(PART * settings.rate * settings.objects)
        (done,) = write_streamed_labels(
            Path(folder) / "labels",
            lambda spools: smooth_stream(read_scenes_in_parts(table, rows_read), config, spools, progress=look),
        )
        cpu = time.thread_time() - begin
        rows.append(FileRow(settings.seconds, resident_memory(), _peak(), cpu))
        difference, differing, compared = _against_batch(Path(folder), settings)
    peak = rows[-1].peak
    growth = peak / next(row.peak for row in rows if row.recorded >= settings.seconds / 4)
    boxes = done.counts.boxes
    return FileBench(tuple(rows), peak, growth, cpu / settings.seconds, boxes, difference, differing, compared)


def _peak() -> float:
    """Most memory that the process ever held, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def write_traffic(path: Path, settings: StreamingBenchSettings) -> None:
    """A table of what is seen of the traffic: cars of one size that head where they drive, velocities measured."""
    rng = np.random.default_rng(settings.seed)
    with path.open("w", encoding="utf-8") as file:
        file.write("timestamp,label,x,y,z,length,width,height,yaw,vx,vy,score\n")
        for k, instant in enumerate(traffic(settings, round(settings.seconds * settings.rate)), start=1):
            seen = instant.measurements
            road = APART * (np.asarray(seen.nodes) // PLATOON % ROADS)
            velocity = instant.truth[np.searchsorted(instant.transition.nodes, seen.nodes), 2:]
            yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
            measured = velocity + VELOCITY_NOISE * rng.normal(size=velocity.shape)
            for x, y, *moves in np.column_stack([seen.z[:, 0], seen.z[:, 1] + road, yaw, measured]).tolist():
                moves_text = ",".join(f"{value:.4f}" for value in moves)
                file.write(f"{k / settings.rate:.6f},car,{x:.4f},{y:.4f},0.8,4.5,1.8,1.6,{moves_text},0.9\n")


def _against_batch(folder: Path, settings: StreamingBenchSettings) -> tuple[float, int, int]:
    """The largest difference of positions (m), boxes that only one has, and boxes in all."""
    table = folder / "short.csv"
    write_traffic(table, replace(settings, seconds=settings.compared, objects=min(settings.objects, 10 * PLATOON)))
    config = load_smooth_config("file")
    dataset = read_detections(table)
    whole = smooth_scene(dataset.scene(dataset.scenes[0]), config).labels
    stretches = StretchSettings(settings.compared / 4, StretchSettings().margin)
    spools = folder / "spools"
    spools.mkdir()
    (run,) = smooth_stream(read_scenes_in_parts(table, 1000), config, spools, stretches=stretches)
    parts = [moment for _, moments in run.spool.labels() for moment in moments]
    found = [_apart(mine, theirs) for mine, theirs in zip(parts, whole, strict=True)]
    return max(apart for apart, _ in found), sum(alone for _, alone in found), sum(map(len, whole))


def _apart(mine: Labels, theirs: Labels) -> tuple[float, int]:
    """The largest difference of positions of the same objects, m, and how many boxes only one has."""
    both, a, b = np.intersect1d(mine.tracks.id, theirs.tracks.id, return_indices=True)
    difference = mine.tracks.boxes.position[a] - theirs.tracks.boxes.position[b]
    return float(np.abs(difference).max(initial=0.0)), len(mine) + len(theirs) - 2 * len(both)
