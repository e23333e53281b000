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
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.runner import Rows, each
from pipelines.config import load_config
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking import Tracker
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

Kind = Literal["steady", "glitch", "drift", "jumps"]

START, END = 5.0, 25.0  # s; when the clock goes wrong, and the end
RATES = {"lidar": 10.0, "camera": 12.0}  # Hz
RADAR_RATES = (5.0, 15.0, 20.0)
NOISE = 0.2  # m
JUMP = 10.0  # s; largest jump of a clock that jumps every second
OBSERVATIONS = 200  # after which an offset is judged
TRACKED, MOST_ERROR, MOST_RATIO, WITHIN = 0.99, 0.01, 1.05, 0.95  # to reach; the second in s
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


@dataclass(frozen=True)
class WrongClock:
    """One sensor with a wrong clock: `tracked` shares of the frames of the others from then on, by name."""

    sensor: str
    radar_rate: float
    fault: ClockFault
    tracked: dict[str, float]


@dataclass(frozen=True)
class SteadyOffset:
    """A steady offset, s, in several recordings; times in s.

    errors       (n,) of the estimates after `OBSERVATIONS` shared observations
    within       share of them within two standard deviations
    rmse         root mean square error of positions in the last third, m, and that without an offset
    """

    sensor: str
    offset: float
    errors: FloatArray
    within: float
    rmse: tuple[float, float]


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


def wrong_clock(objects: int, wrong: str, radar_rate: float, fault: ClockFault, seed: int) -> WrongClock:
    """Track one recording with a wrong clock."""
    rates, tracker = {**RATES, "radar": radar_rate}, _tracker()
    tracked, sent = dict.fromkeys(rates, 0), dict.fromkeys(rates, 0)
    for time, frame in frames_of(RoundAbout(objects, seed), rates, wrong, fault, START, END, seed):
        tracker.step(frame)
        if time >= START:
            sent[frame.sensor] += 1
            tracked[frame.sensor] += tracker.time_verdict not in ("late", "unconfirmed")
    return WrongClock(wrong, radar_rate, fault, {n: tracked[n] / sent[n] for n in rates if n != wrong})


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


def bench_wrong_clocks(seed: int) -> list[WrongClock]:
    """All faults of the radar and of the lidar, at all rates of the radar."""
    cases = [(wrong, rate, fault) for wrong in ("radar", "lidar") for rate in RADAR_RATES for fault in FAULTS]
    return [wrong_clock(OBJECTS, wrong, rate, fault, seed) for wrong, rate, fault in each(cases, "wrong clocks")]


def bench_steady_offsets(first_seed: int) -> list[SteadyOffset]:
    """Steady offsets of the radar and of the lidar from the start, either way in turn."""
    seeds = range(first_seed, first_seed + REPETITIONS)
    without = math.sqrt(float(np.mean(np.square([offset_run(OBJECTS, "radar", 0.0, seed)[2] for seed in seeds]))))
    cases, found = [(wrong, offset) for wrong in ("radar", "lidar") for offset in OFFSETS], []
    for wrong, offset in each(cases, "steady offsets"):
        runs = np.array([offset_run(OBJECTS, wrong, offset * (-1) ** seed, seed) for seed in seeds])
        errors, deviations, rmse = runs.T
        within = float(np.mean(np.abs(errors) <= 2 * deviations))
        found.append(SteadyOffset(wrong, offset, errors, within, (math.sqrt(float(np.mean(rmse**2))), without)))
    return found


def clock_shortcomings(wrong: list[WrongClock], steady: list[SteadyOffset]) -> list[str]:
    """One text for each figure that is out of bounds."""
    found = [
        f"{w.sensor} {w.fault}, radar at {w.radar_rate:g} Hz: {100 * least:.1f} % tracked, expected {100 * TRACKED:g} %"
        for w in wrong
        if (least := min(w.tracked.values())) < TRACKED
    ]
    for one in steady:
        name, largest = f"{one.sensor} {one.offset:g} s", float(np.abs(one.errors).max())
        if not largest <= MOST_ERROR:
            found.append(f"{name}: estimate off by {1e3 * largest:.1f} ms, expected {1e3 * MOST_ERROR:g} ms")
        if one.rmse[0] > MOST_RATIO * one.rmse[1]:
            found.append(f"{name}: error of positions {one.rmse[0] / one.rmse[1]:.3f} times that without an offset")
    if steady and (within := float(np.mean([one.within for one in steady]))) < WITHIN:
        found.append(f"{100 * within:.0f} % of estimates within two deviations, expected {100 * WITHIN:g} %")
    return found


def clock_rows(wrong: list[WrongClock], steady: list[SteadyOffset]) -> Rows:
    """The rows of both tables: a fault of the clock, and a steady offset."""
    share = {(w.sensor, w.radar_rate, w.fault): 100 * min(w.tracked.values()) for w in wrong}
    for fault in dict.fromkeys(w.fault for w in wrong):
        mine = {(sensor, rate): figure for (sensor, rate, which), figure in share.items() if which == fault}
        figures = {f"of the {sensor}, radar at {rate:g} Hz": figure for (sensor, rate), figure in mine.items()}
        yield "frames of right sensors tracked, the worse of two, %", {"fault of the clock": str(fault), **figures}
    for one in steady:
        yield (
            f"offsets after {OBSERVATIONS} shared observations",
            {
                "steady offset": f"{one.sensor}, +-{one.offset:g} s",
                "largest error, ms": 1e3 * float(np.nanmax(np.abs(one.errors))),
                "rms error, ms": 1e3 * float(np.sqrt(np.nanmean(one.errors**2))),
                "within two deviations, %": 100 * one.within,
                "error of positions, m": one.rmse[0],
                "by that without an offset": one.rmse[0] / one.rmse[1],
            },
        )
