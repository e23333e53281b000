"""Wrong clocks: one of three sensors has one, and the frames of the others have to be tracked.

    lidar 10 Hz, camera 12 Hz, radar 5, 15 or 20 Hz     all see the same objects, in order of arrival
    the clock of the radar, or of the lidar             is off from t = 5 s on: for good, for one or two frames, drifts,
                                                        or jumps every second

Printed is the least share of frames of a right sensor that were tracked. A second table has steady offsets from the
start: how far the estimate is from the truth after `OBSERVATIONS` shared observations, how often within two of its
standard deviations, and the root mean square error of the positions in the last third beside that without an offset.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from benchmarks.runner import Rows, each
from pipelines.config import load_config
from saga_fg.errors import SagaError
from saga_fg.numerics import FloatArray
from saga_fg.tracking import Tracker
from saga_fg.types import Boxes, Detections, Frame

Kind = Literal["steady", "glitch", "drift", "jumps"]

START, END = 5.0, 25.0  # s; when the clock goes wrong, and the end
RATES = {"lidar": 10.0, "camera": 12.0}  # Hz
RADAR_RATES = (5.0, 15.0, 20.0)
NOISE = 0.2  # m
JUMP = 10.0  # s; largest jump of a clock that jumps every second
OBSERVATIONS = 200  # after which an offset is judged
TRACKED, MAX_ERROR, MAX_RATIO, WITHIN = 0.99, 0.01, 1.05, 0.95  # to reach; the second in s
OBJECTS, REPETITIONS = 10, 10  # seen by all sensors; recordings of every steady offset
OFFSETS = (0.05, 0.1, 0.3, 0.5, 1.0, 2.0)  # s, either way


@dataclass(frozen=True)
class ClockFault:
    """What is wrong with a clock: off by `size` s, for `frames` frames, or drifting by `size` s in a second."""

    kind: Kind
    size: float = 0.0
    frames: int = 0

    def stamp(self, time: float, count: int, start: float, rng: np.random.Generator) -> float:
        """The timestamp of frame number `count` since the fault began, s; rng: of this second."""
        if self.kind == "steady":
            return time + self.size
        if self.kind == "glitch":
            return time + self.size * (count < self.frames)
        if self.kind == "drift":
            return time + self.size * (time - start)
        return time + float(rng.uniform(-JUMP, JUMP))

    def __str__(self) -> str:
        if self.kind == "steady":
            return f"{self.size:+g} s"
        if self.kind == "glitch":
            return f"{self.size:+g} s, {self.frames} frame{'s' * (self.frames > 1)}"
        return f"drift {self.size:g}" if self.kind == "drift" else "a jump every second"


FAULTS = (
    *(ClockFault("steady", sign * size) for size in (0.1, 1.0, 8.0, 3600.0) for sign in (1, -1)),
    *(ClockFault("glitch", size, frames) for size in (8.0, 3600.0) for frames in (1, 2)),
    ClockFault("drift", 1e-3),
    ClockFault("jumps"),
)


class RoundAbout:
    """Cars within 100 m, each on a circle of 20 m at 4 to 10 m/s; their positions (n, 2) at a time, s."""

    def __init__(self, number: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        self._centre = rng.uniform(-100, 100, (number, 2))
        self._phase, self._rate = rng.uniform(0, 2 * np.pi, number), rng.uniform(0.2, 0.5, number)

    def __call__(self, time: float) -> FloatArray:
        """Return the positions, m."""
        angle = self._phase + self._rate * time
        return np.asarray(self._centre + 20 * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def frames_of(
    objects: RoundAbout, rates: dict[str, float], wrong: str, fault: ClockFault, start: float, end: float, seed: int
) -> Iterator[tuple[float, Frame]]:
    """Frames of all sensors in order of arrival, with the time of each, s."""
    arrivals = sorted(
        (k / rate + 0.013 * n, name) for n, (name, rate) in enumerate(rates.items()) for k in range(int(end * rate))
    )
    rng, count = np.random.default_rng([seed, 3]), 0
    for time, name in arrivals:
        stamp, position = time, objects(time)
        if name == wrong and time >= start:
            stamp, count = fault.stamp(time, count, start, np.random.default_rng([seed, int(time)])), count + 1
        position = position + rng.normal(0, NOISE, position.shape)
        centre = np.concatenate([position, np.ones((len(position), 1))], axis=1)
        boxes = Boxes.of(
            np.full(len(position), "car"), centre, np.full((len(position), 3), 2.0), np.zeros(len(position))
        )
        yield time, Frame(stamp, name, Detections(boxes, np.full(len(position), 0.9)))


def _tracker() -> Tracker:
    tracker = load_config("file").new_tracker("kf")
    assert isinstance(tracker, Tracker)
    return tracker


def wrong_clock(objects: int, wrong: str, radar_rate: float, fault: ClockFault, seed: int) -> float:
    """Track one recording with a wrong clock; the least share of frames of a right sensor that were tracked."""
    rates, tracker = {**RATES, "radar": radar_rate}, _tracker()
    tracked, sent = dict.fromkeys(rates, 0), dict.fromkeys(rates, 0)
    for time, frame in frames_of(RoundAbout(objects, seed), rates, wrong, fault, START, END, seed):
        tracker.step(frame)
        if time >= START:
            sent[frame.sensor] += 1
            tracked[frame.sensor] += tracker.time_verdict not in ("late", "unconfirmed")
    return min(tracked[name] / sent[name] for name in rates if name != wrong)


def offset_run(objects: int, wrong: str, offset: float, seed: int) -> tuple[float, float, float]:
    """Error of the estimated offset and its deviation, s, after 200 shared observations; error of positions, m."""
    rates, tracker, truth = {**RATES, "radar": 15.0}, _tracker(), RoundAbout(objects, seed)
    error = deviation = math.nan
    squares: list[FloatArray] = []
    for time, frame in frames_of(truth, rates, wrong, ClockFault("steady", offset), 0.0, 15.0, seed):
        tracks = tracker.step(frame)
        found = tracker.sensor_times.get(wrong)
        if math.isnan(error) and found is not None and found.objects >= OBSERVATIONS:
            error, deviation = found.offset - offset, found.deviation
        if time > 10.0 and len(tracks):
            apart = tracks.boxes.position[:, None, :2] - truth(tracks.timestamp)[None]
            squares.append((apart**2).sum(axis=2).min(axis=0))
    return error, deviation, math.sqrt(float(np.mean(squares)))


def fault_rows(seed: int) -> Rows:
    """A row for each fault: of the radar and of the lidar, at all rates of the radar. Raises `SagaError` at the end for
    figures out of bounds."""
    short = []
    for fault in each(FAULTS, "wrong clocks"):
        cases = list(product(("radar", "lidar"), RADAR_RATES))
        least = {case: wrong_clock(OBJECTS, *case, fault, seed) for case in cases}
        figures = {f"of the {wrong}, radar at {rate:g} Hz": 100 * share for (wrong, rate), share in least.items()}
        yield "frames of right sensors tracked, the worse of two, %", {"fault of the clock": str(fault), **figures}
        short += [f"{fault}, {name}: {share:.1f} % tracked" for name, share in figures.items() if share < 100 * TRACKED]
    if short:
        raise SagaError("; ".join(short))


def offset_rows(first_seed: int) -> Rows:
    """A row for each steady offset of the radar and of the lidar from the start, either way in turn. Raises `SagaError`
    at the end for figures out of bounds."""
    seeds, short, shares = range(first_seed, first_seed + REPETITIONS), list[str](), list[float]()
    without = math.sqrt(float(np.mean(np.square([offset_run(OBJECTS, "radar", 0.0, seed)[2] for seed in seeds]))))
    for wrong, offset in each(list(product(("radar", "lidar"), OFFSETS)), "steady offsets"):
        runs = np.array([offset_run(OBJECTS, wrong, offset * (-1) ** seed, seed) for seed in seeds])
        errors, deviations, rmse = runs.T
        row = offset_figures(errors, deviations, rmse, without)
        yield (
            f"offsets after {OBSERVATIONS} shared observations",
            {"steady offset": f"{wrong}, +-{offset:g} s", **row},
        )
        short += [f"{wrong} {offset:g} s: {text}" for text in offset_shortcomings(row)]
        shares.append(row["within two deviations, %"])
    if (within := float(np.mean(shares))) < 100 * WITHIN:
        short.append(f"{within:.0f} % of estimates within two deviations, expected {100 * WITHIN:g} %")
    if short:
        raise SagaError("; ".join(short))


def offset_figures(errors: FloatArray, deviations: FloatArray, rmse: FloatArray, without: float) -> dict[str, float]:
    """Figures of an offset in n recordings: errors (n,) of the estimates and their deviations (n,), s; root mean square
    errors of positions (n,), and that without an offset, m."""
    error = math.sqrt(float(np.mean(rmse**2)))
    return {
        "largest error, ms": 1e3 * float(np.abs(errors).max()),
        "rms error, ms": 1e3 * float(np.sqrt(np.mean(errors**2))),
        "within two deviations, %": 100 * float(np.mean(np.abs(errors) <= 2 * deviations)),
        "error of positions, m": error,
        "by that without an offset": error / without,
    }


def offset_shortcomings(row: Mapping[str, float]) -> list[str]:
    """One text for each figure that is out of bounds."""
    error, ratio = row["largest error, ms"], row["by that without an offset"]
    checks = {
        f"estimate off by {error:.1f} ms, expected {1e3 * MAX_ERROR:g} ms": not error <= 1e3 * MAX_ERROR,
        f"error of positions {ratio:.3f} times that without an offset": ratio > MAX_RATIO,
    }
    return [text for text, wrong in checks.items() if wrong]
