"""`python -m benchmarks streaming`: memory and time of smoothing a recording without an end, from a file to labels.

Platoons of five cars, each on a road of its own, come and go, and cars are hidden for seconds at a time. They are
written as a table of detections, which `smooth_stream` reads in parts. A short recording is smoothed in short chunks
and as a whole, and the labels are compared. With clutter and missed detections it makes many tracks of few cars.
"""

from __future__ import annotations

import resource
import time
import tracemalloc
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer

from data_tools.datasets.detection_files import read_detections, read_scenes_in_parts
from data_tools.figures import FigureTable, cell
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.process import one_thread, resident_memory
from pipelines.smoothing import ChunkSettings, load_smooth_config, smooth_scene, smooth_stream, write_streamed_labels
from pipelines.tracking import Progress
from saga_fg.settings import NonNegative, Positive, Range, Settings, setting
from saga_fg.smoothing import Labels

PLATOON, GAP = 5, 15.0  # cars, and m between them
ROADS, APART = 400, 1000.0  # side by side, m apart: platoons do not meet
STAY = 60.0  # mean time that a platoon is there, s
HIDING, HIDDEN = 0.02, 3.0  # hidden spells of a car in a second, and their mean length, s
AROUND = 10.0  # standard deviation of false detections about the cars, m
NOISE, VELOCITY_NOISE = 0.3, 1.0  # standard deviations of measured positions, m, and velocities, m/s
PART = 30.0  # s that are read at a time, after which memory is read


@dataclass(frozen=True)
class StreamingBenchSettings(Settings):
    """Size of the benchmark."""

    objects: Annotated[int, Range(PLATOON, 10**6)] = setting(200, "objects at any time")
    seconds: Positive = setting(300.0, "length of the recording, s")
    rate: Positive = setting(10.0, "frames a second")
    compared: Positive = setting(20.0, "length of the recording that is compared with the batch's labels, s")
    compared_objects: Annotated[int, Range(PLATOON, 10**6)] = setting(10 * PLATOON, "largest number of objects in it")
    detected: Annotated[float, Range(0.0, 1.0)] = setting(1.0, "probability that a car in view is detected")
    clutter: NonNegative = setting(0.0, "mean number of false detections a frame")
    seed: int = setting(0, "seed of the traffic")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.seconds * self.rate)


@dataclass(frozen=True)
class StreamingRow:
    """Resident memory and its peak so far (MB), and CPU time so far (s), by the length recorded (s)."""

    recorded: float
    memory: float
    peak: float
    cpu: float


@dataclass(frozen=True)
class StreamingBench:
    """Rows over the recording; peak memory of the process (MB); CPU time over recorded time; boxes.

    growth              peak memory over that after a quarter of the recording
    largest_difference  of any position from the labels of the whole recording at once, m, on a short one
    differing           boxes that only one of the two has there, of `compared`
    at_once             peak of what is allocated while that recording is smoothed at once, MB
    tracks              of that recording, before they are stitched
    """

    rows: tuple[StreamingRow, ...]
    peak: float
    growth: float
    ratio: float
    boxes: int
    largest_difference: float
    differing: int
    compared: int
    at_once: float
    tracks: int


def bench_streaming(settings: StreamingBenchSettings, progress: Progress | None = None) -> StreamingBench:
    """Write a recording and smooth it as it is read; then smooth a short one in short chunks and as a whole."""
    config = load_smooth_config("file")
    with TemporaryDirectory() as folder, one_thread():
        table = Path(folder) / "detections.csv"
        write_traffic(table, settings)
        rows: list[StreamingRow] = []
        begin = time.thread_time()

        def look(name: str, done: int, _: int) -> None:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
            rows.append(StreamingRow(done / settings.rate, resident_memory(), peak, time.thread_time() - begin))
            if progress is not None:
                progress(name, done, settings.frames)

        rows_read = round(PART * settings.rate * settings.objects)
        (done,) = write_streamed_labels(
            Path(folder) / "labels",
            lambda spools: smooth_stream(read_scenes_in_parts(table, rows_read), config, spools, progress=look),
        )
        look("written", settings.frames, settings.frames)
        against_batch = _against_batch(Path(folder), settings)
    last = rows[-1]
    growth = last.peak / next(row.peak for row in rows if row.recorded >= settings.seconds / 4)
    ratio = last.cpu / settings.seconds
    return StreamingBench(tuple(rows), last.peak, growth, ratio, done.counts.boxes, *against_batch)


def write_traffic(path: Path, settings: StreamingBenchSettings) -> None:
    """Write a table of detections of cars of one size, with headings and measured velocities."""
    rng, dt, faults = np.random.default_rng(settings.seed), 1 / settings.rate, np.random.default_rng([settings.seed, 1])
    count = settings.objects // PLATOON
    front, speed = rng.uniform(0, 1000, count), rng.normal(15, 3, count)
    road, latest, hidden = np.arange(count), count, np.zeros((count, PLATOON))
    with path.open("w", encoding="utf-8") as file:
        file.write("timestamp,label,x,y,z,length,width,height,yaw,vx,vy,score\n")
        for k in range(1, settings.frames + 1):
            new = np.flatnonzero(rng.random(count) < dt / STAY)
            front[new], speed[new] = rng.uniform(0, 1000, len(new)), rng.normal(15, 3, len(new))
            road[new], latest = latest + np.arange(len(new)), latest + len(new)
            speed += np.sqrt(dt) * rng.normal(size=count)
            front += dt * speed
            hides = (hidden <= 0) & (rng.random(hidden.shape) < HIDING * dt)
            hidden = np.where(hides, rng.exponential(HIDDEN, hidden.shape), hidden - dt)
            state = np.zeros((*hidden.shape, 4))
            state[..., 0] = front[:, None] - GAP * np.arange(PLATOON)
            state[..., 1], state[..., 2] = (APART * (road % ROADS))[:, None], speed[:, None]
            seen = hidden <= 0
            seen &= faults.random(hidden.shape) < settings.detected
            measured = state[seen]
            measured += rng.normal(size=measured.shape) * [NOISE, NOISE, VELOCITY_NOISE, VELOCITY_NOISE]
            near = state.reshape(-1, 4)[faults.integers(hidden.size, size=faults.poisson(settings.clutter))]
            false = near + faults.normal(size=near.shape) * [AROUND, AROUND, VELOCITY_NOISE, VELOCITY_NOISE]
            for x, y, vx, vy in (*measured.tolist(), *false.tolist()):
                file.write(f"{k * dt:.6f},car,{x:.4f},{y:.4f},0.8,4.5,1.8,1.6,0.0,{vx:.4f},{vy:.4f},0.9\n")


def _against_batch(folder: Path, settings: StreamingBenchSettings) -> tuple[float, int, int, float, int]:
    """Largest difference of positions, m; boxes that only one has; boxes in all; peak of smoothing at once, MB, and
    number of its tracks."""
    table, objects = folder / "short.csv", min(settings.objects, settings.compared_objects)
    write_traffic(table, replace(settings, seconds=settings.compared, objects=objects))
    config = load_smooth_config("file")
    dataset = read_detections(table)
    tracemalloc.start()
    smoothed = smooth_scene(dataset.scene(dataset.scenes[0]), config)
    at_once = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    chunks = ChunkSettings(settings.compared / 4, ChunkSettings().margin)
    spools = folder / "spools"
    spools.mkdir()
    (run,) = smooth_stream(read_scenes_in_parts(table, 1000), config, spools, chunks=chunks)
    parts = [moment for _, moments in run.spool.labels() for moment in moments]
    found = [_apart(mine, theirs) for mine, theirs in zip(parts, smoothed.labels, strict=True)]
    alone, compared = sum(alone for _, alone in found), sum(map(len, smoothed.labels))
    tracks = smoothed.counts.objects + smoothed.counts.dropped_objects + smoothed.counts.joined
    return max(apart for apart, _ in found), alone, compared, at_once, tracks


def _apart(mine: Labels, theirs: Labels) -> tuple[float, int]:
    """The largest difference of positions of the same objects, m, and how many boxes only one has."""
    both, a, b = np.intersect1d(mine.tracks.id, theirs.tracks.id, return_indices=True)
    difference = mine.tracks.boxes.position[a] - theirs.tracks.boxes.position[b]
    return float(np.abs(difference).max(initial=0.0)), len(mine) + len(theirs) - 2 * len(both)


def streaming(
    objects: Annotated[int, typer.Option("--objects", min=PLATOON, help="Objects at any time.")] = 200,
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="Length of the recording.")] = 300.0,
    rate: Annotated[float, typer.Option("--rate", min=0.1, help="Frames a second.")] = 10.0,
    compared: Annotated[
        float, typer.Option("--compared", min=1.0, help="Length of a second one, compared with its smoothing at once.")
    ] = 20.0,
    compared_objects: Annotated[
        int, typer.Option("--compared-objects", min=PLATOON, help="Objects at any time of that one, at most.")
    ] = 50,
    detected: Annotated[
        float, typer.Option("--detected", min=0.0, max=1.0, help="Probability that a car in view is detected.")
    ] = 1.0,
    clutter: Annotated[
        float, typer.Option("--clutter", min=0.0, help="Mean number of false detections a frame.")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the traffic.")] = 0,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Smooth a long file of detections as it is read: memory, time, and the difference from smoothing it at once.

    \b
    Examples:
      python -m benchmarks streaming --seconds 60
      python -m benchmarks streaming --seconds 3600 --json figures.json
      python -m benchmarks streaming --seconds 1 --compared 4 --compared-objects 100 --detected 0.6 --clutter 100
    """
    settings = StreamingBenchSettings(objects, seconds, rate, compared, compared_objects, detected, clutter, seed)
    with progress_bar() as progress:
        result = bench_streaming(settings, progress)
    rows = tuple((cell(r.recorded, 0), cell(r.memory, 0), cell(r.peak, 0), cell(r.cpu, 1)) for r in result.rows)
    columns = ("read, s", "memory, MB", "most so far, MB", "CPU, s")
    table = FigureTable(f"{objects} objects at {rate:g} Hz, {result.boxes} boxes", columns, rows)
    figures = (
        cell(result.peak, 0),
        cell(result.growth, 2),
        cell(result.ratio),
        f"{result.largest_difference:.1e}",
        f"{result.differing} of {result.compared}",
        cell(result.at_once, 0),
        cell(1e3 * result.at_once / result.compared, 2),
        str(result.tracks),
    )
    names = (
        "peak, MB",
        "/ first quarter's",
        "CPU s / s",
        "off by at most, m",
        "boxes of one alone",
        "MB at once",
        "kB a box",
        "tracks",
    )
    title = f"the whole; the last five: {compared:g} s in chunks against at once"
    report([table, FigureTable(title, names, (figures,))], {"settings": settings, "result": result}, json_file)
