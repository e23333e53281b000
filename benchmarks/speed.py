"""Speed of the tracking methods: milliseconds a frame, where they go, memory, and growth with the number of objects.

All methods and the reference take the frames of a recording in turn, so that whatever else the machine does hits all
alike. Times are CPU times of one thread. They are compared with `centerpoint`, and with clocks that never change: its
frozen copy (`benchmarks.frozen_greedy`), a hundred textbook Kalman filters, one after the other in NumPy, and one
singular value decomposition of a 300 x 300 matrix.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.frozen_greedy import FrozenGreedy
from benchmarks.measuring import environment, size_of, timed
from benchmarks.recordings import recording_set
from benchmarks.sampling_profiler import SamplingProfiler
from benchmarks.service.round_trip import RoundTrip, round_trips
from benchmarks.speed_scenes import Ties, speed_config, speed_frames
from pipelines.config import Method, TrackConfig, load_config
from pipelines.observers import StageClock
from pipelines.process import one_thread
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.model.sensor import sensor_model
from saga_fg.settings import setting
from saga_fg.types.frame import Frame

METHODS: tuple[Method, ...] = ("saga", "kf", "centerpoint")
FROZEN = "centerpoint, frozen"
RECORDINGS = {"nuscenes": ("megvii", "scene-0655"), "kitti": ("kitti", "0011")}  # set and scene, neither the smallest
ISAM2_ON = ("nuscenes",)
TIES: tuple[Ties, ...] = ("loose", "dense")
WARM_UP = 5  # frames that are not counted: tracks are new
EVERY = 5  # frames from one reading of the fixed clocks to the next
GROWTH_FROM = 100  # objects
SERVED = 200  # objects of the live service


@dataclass(frozen=True)
class SpeedBenchSettings:
    """Size of the benchmark."""

    sizes: tuple[int, ...] = setting((10, 100, 200, 500, 1000, 5000), "numbers of simulated objects; (): none")
    frames: int = setting(60, "largest number of frames of a case that are counted")
    seconds: float = setting(
        60.0,
        "end a case after this time, s; a method that took a quarter of it is left out of larger cases of the kind",
    )
    seed: int = setting(0, "seed of the simulated objects")
    round_trips: int = setting(200, "round trips of the live service, at 10 Hz; 0: none")

    def __post_init__(self) -> None:
        if any(size < 1 for size in self.sizes) or self.frames < 1 or self.seconds <= 0 or self.round_trips < 0:
            raise InputError("sizes, frames, seconds: expected positive numbers")


@dataclass(frozen=True)
class SpeedRow:
    """One method on one case.

    case           name of the recording, or how simulated objects are connected
    objects        mean number of reported tracks
    median, p99    ms of CPU time a frame
    stages         ms a frame by stage, of the methods that tell
    memory         of the tracker's state at the end, MB
    to_centerpoint, to_frozen, to_filters, to_svd   median over that of the reference; NaN where it was left out
    """

    case: str
    method: str
    objects: float
    median: float
    p99: float
    stages: Mapping[str, float]
    memory: float
    to_centerpoint: float
    to_frozen: float
    to_filters: float
    to_svd: float


@dataclass(frozen=True)
class SpeedBench:
    """All rows; growth: the exponent of time over the number of objects, by case and method; the live service."""

    rows: tuple[SpeedRow, ...]
    growth: Mapping[str, float]
    service: RoundTrip | None
    settings: SpeedBenchSettings
    environment: Mapping[str, str] = field(default_factory=environment)


@dataclass(frozen=True, eq=False)
class SpeedCase:
    """Frames, and the configuration to track them with; `kind` is what cases of several sizes have in common."""

    kind: str
    size: int | None
    frames: Sequence[Frame]
    config: TrackConfig

    @property
    def name(self) -> str:
        return self.kind if self.size is None else f"{self.size} {self.kind}"

    def contenders(self, methods: Sequence[Method]) -> dict[str, tuple[TrackConfig, Method]]:
        """Trackers by name: the methods, and `saga` with iSAM2 on recordings of `ISAM2_ON`."""
        found: dict[str, tuple[TrackConfig, Method]] = {method: (self.config, method) for method in methods}
        if self.kind in ISAM2_ON and "saga" in methods:
            tracker = replace(self.config.tracker, estimator="isam2")
            found["saga, isam2"] = replace(self.config, tracker=tracker), "saga"
        return found


def speed_cases(settings: SpeedBenchSettings, data: Path | None) -> Iterator[SpeedCase]:
    """The recordings in `data`, then simulated objects, from few to many."""
    for name, (recordings, scene) in RECORDINGS.items() if data is not None else ():
        chosen = recording_set(recordings, data, 1)
        frames = list(chosen.dataset.scene(scene).frames)[: settings.frames + WARM_UP]
        yield SpeedCase(name, None, frames, load_config(chosen.family))
    for ties in TIES:
        for size in sorted(settings.sizes):
            frames = speed_frames(size, ties, settings.frames + WARM_UP, settings.seed)
            yield SpeedCase(ties, size, frames, speed_config(ties))


def bench_speed(settings: SpeedBenchSettings, data: Path | None = None, progress: Progress | None = None) -> SpeedBench:
    """Measure everything, one case after the other."""
    rows: list[SpeedRow] = []
    slow: set[tuple[str, str]] = set()
    growing: dict[str, list[tuple[int, float]]] = {}
    with one_thread():
        for case in speed_cases(settings, data):
            methods = [method for method in METHODS if (case.kind, method) not in slow]
            measured, spent = _measured(case, methods, settings, progress)
            rows += measured
            slow |= {(case.kind, method) for method, seconds in spent.items() if seconds > settings.seconds / 4}
            for row in measured:
                if case.size is not None and case.size >= GROWTH_FROM:
                    growing.setdefault(f"{case.kind}, {row.method}", []).append((case.size, row.median))
    growth = {name: _exponent(points) for name, points in growing.items() if len(points) > 1}
    trips = settings.round_trips
    service = round_trips(SERVED, trips, settings.seed, progress) if trips else None
    return SpeedBench(tuple(rows), growth, service, settings)


def write_profile(path: Path, case: SpeedCase, method: Method) -> None:
    """Track a case and write where the time goes, for speedscope."""
    profiler, tracker = SamplingProfiler(), case.config.new_tracker(method)
    with one_thread(), profiler.running():
        for frame in case.frames:
            tracker.step(frame)
    profiler.write(path, f"{case.name}, {method}")


def _measured(
    case: SpeedCase, methods: Sequence[Method], settings: SpeedBenchSettings, progress: Progress | None
) -> tuple[list[SpeedRow], dict[str, float]]:
    """The rows of a case, and the seconds that each method took; a case ends early when these run out."""
    contenders = case.contenders(methods)
    clocks = {name: StageClock() for name in contenders}
    trackers = {name: config.new_tracker(method, clocks[name]) for name, (config, method) in contenders.items()}
    frozen, references = FrozenGreedy(), {"filters": _Filters().step, "svd": _svd}
    times: dict[str, list[float]] = {name: [] for name in (*contenders, FROZEN, *references)}
    stages: dict[str, dict[str, float]] = {}
    reported: dict[str, list[int]] = {name: [] for name in contenders}
    for number, frame in enumerate(case.frames):
        if number == WARM_UP:
            stages = {name: dict(clock.seconds) for name, clock in clocks.items()}
        for name, tracker in trackers.items():
            clocks[name].start()
            times[name].append(timed(partial(tracker.step, frame)))
            reported[name].append(len(tracker.tracks(frame.timestamp).id))
        detections = sensor_model(case.config.sensors, frame.sensor).in_world(frame)
        boxes = detections.boxes
        taken = partial(frozen.step, frame.timestamp, boxes.label, boxes.position, detections.score)
        times[FROZEN].append(timed(taken))
        for name, run in references.items() if number % EVERY == 0 else ():
            times[name].append(timed(run))
        if progress is not None:
            progress(case.name, number + 1, len(case.frames))
        if number > WARM_UP and max((sum(times[name]) for name in contenders), default=0.0) > 1e3 * settings.seconds:
            break
    first = min(WARM_UP, len(times[FROZEN]) - 1)
    counted = {name: spent if name in references else spent[first:] for name, spent in times.items()}
    medians = {name: float(np.median(spent)) for name, spent in counted.items()}
    rows = []
    for name in (*trackers, FROZEN):
        spent = counted[name]
        of_stage = clocks[name].seconds if name in clocks else {}
        before = stages.get(name, {})
        per_stage = {k: 1e3 * (v - before.get(k, 0.0)) / len(spent) for k, v in of_stage.items()}
        memory = size_of(trackers[name].snapshot() if name in trackers else vars(frozen))
        ratios = (medians[name] / medians.get(k, math.nan) for k in ("centerpoint", FROZEN, "filters", "svd"))
        objects = float(np.mean(reported[name][first:])) if name in reported else math.nan
        p99 = float(np.percentile(spent, 99))
        rows.append(SpeedRow(case.name, name, objects, medians[name], p99, per_stage, memory, *ratios))
    return rows, {method: sum(times[method]) / 1e3 for method in methods}


def _exponent(points: Sequence[tuple[int, float]]) -> float:
    """Slope of the times over the sizes, both as logarithms."""
    sizes, milliseconds = np.log(np.array(points)).T
    return float(np.polyfit(sizes, milliseconds, 1)[0])


class _Filters:
    """A hundred textbook Kalman filters of four states, one after the other."""

    def __init__(self) -> None:
        dt = 0.1
        self.F, self.Q = np.eye(4) + dt * np.eye(4, k=2), np.diag([0.01, 0.01, 0.1, 0.1])
        self.H, self.R = np.eye(2, 4), 0.1 * np.eye(2)
        self.states = [(np.zeros(4), np.eye(4)) for _ in range(100)]

    def step(self) -> None:
        """Predict, and correct by a measurement at the origin."""
        F, Q, H, R = self.F, self.Q, self.H, self.R
        for k, (m, P) in enumerate(self.states):
            m, P = F @ m, F @ P @ F.T + Q
            S = H @ P @ H.T + R
            K = np.linalg.solve(S, H @ P).T
            self.states[k] = m - K @ (H @ m), P - K @ S @ K.T


_MATRIX = np.random.default_rng(0).normal(size=(300, 300))


def _svd() -> None:
    np.linalg.svd(_MATRIX)
