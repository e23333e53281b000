"""Memory and time of smoothing a recording without an end, from a file to labels.

Platoons of five cars, each on a road of its own, come and go, and cars are hidden for seconds at a time. They are
written as a table of detections, which `smooth_stream` reads in parts. A short recording is smoothed in short chunks
and as a whole, and the labels are compared. With clutter and missed detections it makes many tracks of few cars.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.runner import Rows, Seed
from data_tools.datasets.detection_files import read_detections, read_scenes_in_parts
from pipelines.smoothing import load_smooth_config, smooth_scene, smooth_stream, write_labels
from pipelines.tracking import one_thread, peak_memory, resident_memory
from saga_fg.smoothing import ChunkSettings, Labels
from saga_fg.types import Scene

PLATOON, GAP = 5, 15.0  # cars, and m between them
ROADS, APART = 400, 1000.0  # side by side, m apart: platoons do not meet
STAY = 60.0  # mean time that a platoon is there, s
HIDING, HIDDEN = 0.02, 3.0  # hidden spells of a car in a second, and their mean length, s
AROUND = 10.0  # standard deviation of false detections about the cars, m
NOISE = np.array([0.3, 0.3, 1.0, 1.0])  # standard deviations of measured positions, m, and velocities, m/s
PART, RATE = 30.0, 10.0  # s that are read at a time, after which memory is read; frames a second


def streaming(
    objects: Annotated[int, typer.Option("--objects", min=PLATOON, help="Objects at any time.")] = 200,
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="Length of the recording.")] = 300.0,
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
    seed: Seed = 0,
) -> Rows:
    """Smooth a long file of detections as it is read: memory, time, and the difference from smoothing it at once.

    \b
    Examples:
      python -m benchmarks streaming --seconds 60
      python -m benchmarks streaming --seconds 3600 --json figures.json
      python -m benchmarks streaming --seconds 1 --compared 4 --compared-objects 100 --detected 0.6 --clutter 100
    """
    config, rows = load_smooth_config("file"), list[dict[str, float]]()
    with TemporaryDirectory() as folder, one_thread():
        table, spools = Path(folder) / "detections.csv", Path(folder) / "spools"
        write_traffic(table, objects, seconds, seed, detected, clutter)
        begin = time.thread_time()

        def look(seconds: float) -> None:
            figures = {"read, s": seconds, "memory, MB": resident_memory(), "most so far, MB": peak_memory()}
            rows.append({**figures, "CPU, s": time.thread_time() - begin})

        def parts() -> Iterator[Scene]:
            for part in read_scenes_in_parts(table, round(PART * RATE * objects)):
                yield part
                look(float(part.timestamps[-1]))  # the next part is asked for when this one is smoothed

        (done,) = write_labels(Path(folder) / "labels", lambda kept: smooth_stream(parts(), config, kept))
        look(seconds)
        yield from (("read and smoothed", row) for row in rows)
        first = next(row for row in rows if row["read, s"] >= seconds / 4)
        ratios = {
            "boxes": done.counts.boxes,
            "peak / first quarter's": rows[-1]["most so far, MB"] / first["most so far, MB"],
            "CPU s / s": rows[-1]["CPU, s"] / seconds,
        }
        spools.mkdir()
        write_traffic(table, min(objects, compared_objects), compared, seed, detected, clutter)
        yield "the whole", ratios
        yield f"{compared:g} s in chunks against at once", _against_batch(table, spools, compared)


def write_traffic(path: Path, objects: int, seconds: float, seed: int, detected: float, clutter: float) -> None:
    """Write a table of detections of cars of one size, with headings and measured velocities."""
    rng, dt, faults = np.random.default_rng(seed), 1 / RATE, np.random.default_rng([seed, 1])
    count = objects // PLATOON
    front, speed = rng.uniform(0, 1000, count), rng.normal(15, 3, count)
    road, latest, hidden = np.arange(count), count, np.zeros((count, PLATOON))
    with path.open("w", encoding="utf-8") as file:
        file.write("timestamp,label,x,y,z,length,width,height,yaw,vx,vy,score\n")
        for k in range(1, round(seconds * RATE) + 1):
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
            seen = (hidden <= 0) & (faults.random(hidden.shape) < detected)
            near = state.reshape(-1, 4)[faults.integers(hidden.size, size=faults.poisson(clutter))]
            false = near + faults.normal(size=near.shape) * [AROUND, AROUND, NOISE[2], NOISE[3]]
            measured = state[seen] + rng.normal(size=(int(seen.sum()), 4)) * NOISE
            for x, y, vx, vy in (*measured.tolist(), *false.tolist()):
                file.write(f"{k * dt:.6f},car,{x:.4f},{y:.4f},0.8,4.5,1.8,1.6,0.0,{vx:.4f},{vy:.4f},0.9\n")


def _against_batch(table: Path, spools: Path, seconds: float) -> dict[str, Any]:
    """A recording smoothed in short chunks against at once: differences, and what the latter allocates."""
    config, dataset = load_smooth_config("file"), read_detections(table)
    tracemalloc.start()
    smoothed = smooth_scene(dataset.scene(dataset.scenes[0]), config)
    at_once = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    chunks = ChunkSettings(seconds / 4, ChunkSettings().margin)
    (run,) = smooth_stream(read_scenes_in_parts(table, 1000), config, spools, chunks=chunks)
    moments = zip(run.labels, smoothed.labels, strict=True)
    apart, alone = zip(*(_apart(mine, theirs) for mine, theirs in moments), strict=True)
    boxes, counts = sum(map(len, smoothed.labels)), smoothed.counts
    return {
        "off by at most, m": max(apart),
        "boxes": boxes,
        "boxes of one alone": sum(alone),
        "MB at once": at_once,
        "kB a box": 1e3 * at_once / boxes,
        "tracks": counts.objects + counts.dropped_objects + counts.joined,
    }


def _apart(mine: Labels, theirs: Labels) -> tuple[float, int]:
    """The largest difference of positions of the same objects, m, and how many boxes only one has."""
    both, a, b = np.intersect1d(mine.tracks.id, theirs.tracks.id, return_indices=True)
    difference = mine.tracks.boxes.position[a] - theirs.tracks.boxes.position[b]
    return float(np.abs(difference).max(initial=0.0)), len(mine) + len(theirs) - 2 * len(both)
