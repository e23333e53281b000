"""Trackers that run for long, and frames at the edge of what is allowed.

long runs       cars enter a lane at one end, leave it at the other, are missed now and then, among false detections:
                tracks begin and end all the time. A young tracker takes turns with the old one over the last two
                tenths, so that whatever else the machine does hits both alike
nothing         hours without a frame; a fresh tracker takes the frames after that beside the old one
crowds          frames of many detections, by frames of a tenth
sensors         frames of many sensors in turn, by as many frames of one
far away        the same traffic near the largest position, by that at the origin

files           open files of the process
last / second   of the medians of the last and the second tenth
apart           largest distance between tracks of both trackers, m
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
import typer

from benchmarks.runner import Row, Rows, Seed, chosen, clocked, each, only_errors, timed
from pipelines.config import TrackConfig, load_config
from pipelines.tracking import one_thread, resident_memory
from saga_fg.numerics import FloatArray
from saga_fg.tracking import Tracker
from saga_fg.types import MAX_POSITION, Boxes, Detections, Frame

ESTIMATORS = ("kalman", "isam2", "fixed-lag")
SHORTER = 4  # runs of the others than kalman, which take longer
EPOCH, INTERVAL = 1.7e9, 0.1  # s
LENGTH, SPEED, HEADWAY = 100.0, 10.0, 2.5  # m, m/s, s between cars
NOISE, DETECTED, FALSE = 0.2, 0.9, 0.3  # m; share; false detections in a frame
NOTHING = 24 * 3600.0  # s
SETTLED = 100  # frames before and after that
CROWD_FRAMES, SENSOR_FRAMES = 12, 2  # frames of a crowd; of each sensor
SPACING = 20.0  # m, in a crowd
LONG, NONE, EDGES = "long runs", "a day of nothing", "crowds, sensors, and far away"


def endurance(
    frames: Annotated[
        int, typer.Option("--frames", min=40, help="Length of the long run of kalman; a quarter for the others.")
    ] = 200_000,
    names: Annotated[
        str, typer.Option("--estimators", metavar="NAME,...", help="Which, with commas between them.")
    ] = ",".join(ESTIMATORS),
    crowd: Annotated[int, typer.Option("--crowd", min=0, help="Detections of the largest frames; 0: none.")] = 20_000,
    sensors: Annotated[int, typer.Option("--sensors", min=0, help="Sensors; 0: none.")] = 1000,
    seed: Seed = 0,
) -> Rows:
    """Run trackers for long: do time, memory and open files grow?

    Also a day between two frames, frames of very many detections, a thousand sensors, and positions near the limit.

    \b
    Examples:
      python -m benchmarks endurance
      python -m benchmarks endurance --frames 4000 --estimators kalman --crowd 2000 --json figures.json
    """
    with one_thread(), only_errors("saga_fg.tracking"):  # the clock is set after a day of nothing
        for name in chosen("--estimators", names, ESTIMATORS):
            yield from _nothing(name, seed)
            yield from _long_run(name, frames if name == "kalman" else max(40, frames // SHORTER), seed)
        if crowd:
            yield from _crowd(crowd, seed)
        if sensors:
            yield from _sensors(sensors, seed)
        yield from _far(seed)


def _tracker(estimator: str = "kalman", config: TrackConfig | None = None) -> Tracker:
    config = config or load_config("file")
    tracker = replace(config, tracker=replace(config.tracker, estimator=estimator)).new_tracker("saga")
    assert isinstance(tracker, Tracker)
    return tracker


def traffic_frame(number: int, seed: int, origin: float = 0.0, time: float = EPOCH) -> Frame:
    """Frame of the traffic, which has no end; origin: of x and y, m."""
    rng, elapsed = np.random.default_rng([seed, number]), number * INTERVAL
    along = SPEED * np.arange(elapsed % HEADWAY, LENGTH / SPEED, HEADWAY)
    place = np.stack([along, np.zeros(len(along))], axis=-1)[rng.random(len(along)) < DETECTED]
    place = place + rng.normal(0, NOISE, place.shape)
    false = rng.uniform((0, -20), (LENGTH, 28), (rng.poisson(FALSE), 2))
    score = np.repeat([0.9, 0.3], [len(place), len(false)])
    return _frame(time + elapsed, "lidar", np.concatenate([place, false]) + origin, score)


def _frame(time: float, sensor: str, place: FloatArray, score: FloatArray) -> Frame:
    n = len(place)
    centre = np.concatenate([place, np.ones((n, 1))], axis=1)
    boxes = Boxes.of(np.full(n, "car"), centre, np.tile((4.5, 1.9, 1.6), (n, 1)), np.zeros(n))
    return Frame(time, sensor, Detections(boxes, score))


def _long_run(name: str, frames: int, seed: int) -> Iterator[Row]:
    part = frames // 10
    old, young = _tracker(name), _tracker(name)
    spent, spent_young = np.zeros(frames), np.full(frames, math.nan)
    memory, files, tracks = np.zeros(frames), np.zeros(frames), np.zeros(frames)
    for k in each(range(frames), f"{name}, frames"):
        frame = traffic_frame(k, seed)
        found, spent[k] = clocked(old.step, frame)
        if k >= frames - 2 * part:
            spent_young[k] = timed(young.step, frame)
        memory[k], files[k], tracks[k] = resident_memory(), _open_files(), len(found)
    second, before, last = (slice(tenth * part, (tenth + 1) * part) for tenth in (1, 7, 9))  # before: the young one
    ms, ms_young = float(np.median(spent[last])), float(np.median(spent_young[last]))
    grown, files_then = np.median(memory[before]) / np.median(memory[second]), np.median(files[second])
    yield (
        LONG,
        {
            "estimator": name,
            "frames": frames,
            "tracks": int(old.tracks(frame.timestamp).id.max(initial=0)),
            "reported": float(tracks[part:].mean()),
            "ms": ms,
            "old / young": ms / ms_young,
            "time, last / second": ms / float(np.median(spent[second])),
            "memory, eighth / second": float(grown),
            "files, last - second": float(np.median(files[last]) - files_then),
        },
    )


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0  # noqa: PTH112, PTH208


def _nothing(name: str, seed: int) -> Iterator[Row]:
    old, fresh = _tracker(name), _tracker(name)
    for k in range(SETTLED):
        old.step(traffic_frame(k, seed))
    times = np.zeros((SETTLED, 2))
    apart, reported = 0.0, np.zeros((SETTLED, 2))
    for k in range(SETTLED):
        frame = traffic_frame(k, seed, time=EPOCH + NOTHING)
        (one, times[k, 0]), (other, times[k, 1]) = clocked(old.step, frame), clocked(fresh.step, frame)
        reported[k] = len(one), len(other)
        if k >= SETTLED // 2:  # the first frame is left out: such a jump of the clock has to be confirmed
            apart = max(apart, _distance(one.boxes.position, other.boxes.position))
    yield (
        NONE,
        {
            "estimator": name,
            "first frame, old / fresh": times[0, 0] / times[0, 1],
            "reported, old / fresh": reported[:, 0].sum() / reported[:, 1].sum(),
            "apart": apart,
        },
    )


def _distance(one: FloatArray, other: FloatArray) -> float:
    """Largest distance from a position of one to the nearest of the other, m; infinite where only one has any."""
    if not len(one) or not len(other):
        return 0.0 if len(one) == len(other) else math.inf
    return float(np.linalg.norm(one[:, None] - other, axis=2).min(axis=1).max())


def _crowd(most: int, seed: int) -> Iterator[Row]:
    rows: dict[float, Mapping[str, float]] = {}
    for count in (most // 10, most):
        rng, tracker, side = np.random.default_rng([seed, count]), _tracker(), math.ceil(math.sqrt(count))
        at = SPACING * np.stack(np.divmod(np.arange(count), side), axis=-1)
        made = [
            _frame(EPOCH + k * INTERVAL, "lidar", at + rng.normal(0, NOISE, at.shape), np.full(count, 0.9))
            for k in range(CROWD_FRAMES)
        ]
        rows[count] = _measured(tracker, made)
    yield from _compared("detections in a frame", rows, per=True)


def _sensors(most: int, seed: int) -> Iterator[Row]:
    rows: dict[float, Mapping[str, float]] = {}
    for count in (1, most):
        made = []
        for k in range(SENSOR_FRAMES * most):
            frame = traffic_frame(k // 10, seed)
            made.append(replace(frame, timestamp=EPOCH + k * INTERVAL / 10, sensor=f"sensor-{k % count}"))
        rows[count] = _measured(_tracker(), made)
    yield from _compared("sensors", rows, per=False)


def _far(seed: int) -> Iterator[Row]:
    rows: dict[float, Mapping[str, float]] = {}
    for origin in (0.0, 0.9 * MAX_POSITION):
        rows[origin] = _measured(_tracker(), [traffic_frame(k, seed, origin) for k in range(SETTLED)])
    yield from _compared("position, m", rows, per=False)


def _measured(tracker: Tracker, frames: list[Frame]) -> dict[str, float]:
    """CPU time of a frame in the later half, ms, memory that was added, MB, and tracks at the end."""
    before, half = resident_memory(), len(frames) // 2
    times = [timed(tracker.step, frame) for frame in frames]
    return {
        "ms": float(np.median(times[half:])),
        "MB more": resident_memory() - before,
        "reported": float(len(tracker.tracks(frames[-1].timestamp))),
    }


def _compared(what: str, rows: Mapping[float, Mapping[str, float]], per: bool) -> Iterator[Row]:
    """A row for each size, with its time by that of the first; `per`: of each of what is counted."""
    first, base = next(iter(rows.items()))
    for size, row in rows.items():
        ratio = row["ms"] / base["ms"] / (size / first if per else 1.0)
        yield EDGES, {"case": what, "size": size, **row, "ms, by the first": ratio}
