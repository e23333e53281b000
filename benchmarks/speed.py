"""Speed of the tracking methods: milliseconds a frame, where they go, memory, and growth with the number of objects.

All methods and the reference take the frames of a recording in turn. They are compared with `centerpoint`, and with
clocks that never change: a hundred textbook Kalman filters, one after the other in NumPy, and one singular value
decomposition of a 300 x 300 matrix.

Simulated cars come in columns. Loosely connected: lanes far apart, in each a queue of five with the shipped edge rules:
who is in plain view is hardly tied to others. Densely: cars side by side, each tied to the four around it by a rate of
0.5 /s: one connected graph.
"""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from benchmarks.recording_sets import recording_set
from benchmarks.runner import Data, Row, Rows, Seed, counts, growth, in_turn
from benchmarks.service.served import round_trips
from pipelines.config import Method, TrackConfig, load_config
from saga_fg.model import Neighbours, SharedVelocity
from saga_fg.tracking import Stage, TrackerView
from saga_fg.types import Boxes, Detections, Frame

Ties = Literal["loose", "dense"]
INTERVAL, SPEED, NOISE, DETECTED = 0.1, 12.0, 0.15, 0.9  # s, m/s, m, share
QUEUE = 5
LABEL, SIZE = "car", (4.5, 1.9, 1.6)
METHODS: tuple[Method, ...] = ("saga", "kf", "centerpoint")
RECORDINGS = {"nuscenes": ("megvii", "scene-0655"), "kitti": ("kitti", "0011")}  # set and scene, neither the smallest
TIES: tuple[Ties, ...] = ("loose", "dense")
WARM_UP = 5  # frames that are not counted: tracks are new
GROWTH_FROM, SERVED = 100, 200  # objects; those of the live service


@dataclass(frozen=True, eq=False)
class SpeedCase:
    """Frames, and the configuration to track them with; `kind` is what cases of several sizes have in common."""

    kind: str
    size: int | None
    frames: Sequence[Frame]
    config: TrackConfig


class StageClock:
    """CPU time of each stage of a frame, added up. `start()` is to be called before every frame."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._mark = 0.0

    def start(self) -> None:
        """Begin a frame."""
        self._mark = time.thread_time()

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Add the time of a stage that is done."""
        now = time.thread_time()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now


def speed(
    data: Data = None,
    sizes: Annotated[
        str, typer.Option("--sizes", help="Numbers of simulated objects, with commas between.")
    ] = "10,100,200,500,1000,5000",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of each case that are counted.")] = 60,
    seconds: Annotated[
        float,
        typer.Option("--seconds", min=0.1, help="No more frames of a case after that; no larger case after a quarter."),
    ] = 60.0,
    trips: Annotated[
        int, typer.Option("--round-trips", min=0, help="Frames to the live service, at 10 Hz; 0: none.")
    ] = 200,
    seed: Seed = 0,
) -> Rows:
    """Measure what a frame costs: milliseconds by method and stage, memory, growth with the number of objects.

    With --data, first two recordings of nuScenes and KITTI. All methods take the frames in turn on one thread; times
    are CPU times, beside those of clocks that never change.

    \b
    Examples:
      python -m benchmarks speed --sizes 10,100 --frames 20
      python -m benchmarks speed --data data --json figures.json --markdown tables.md
    """
    cases = speed_cases(data, sorted(counts("--sizes", sizes)), frames + WARM_UP, seed)
    slow: set[tuple[str, str]] = set()
    growing: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for case in cases:
        for title, row in measured(case, [m for m in METHODS if (case.kind, m) not in slow], seconds):
            yield title, row
            if "ms" in row:
                if row["ms"] * len(case.frames) > 250 * seconds:
                    slow.add((case.kind, row["method"]))
                if (case.size or 0) >= GROWTH_FROM:
                    growing.setdefault((case.kind, row["method"]), []).append((case.size or 0, row["ms"]))
    for (kind, method), points in growing.items():
        if len(points) > 1:
            yield "growth", {"case": kind, "method": method, "objects^": growth(*zip(*points, strict=True))}
    if trips:
        yield "live service at 10 Hz: round trip on the wall's clock, ms", round_trips(SERVED, trips, seed)


def speed_cases(data: Path | None, sizes: Sequence[int], length: int, seed: int) -> Iterator[SpeedCase]:
    """The recordings in `data`, then simulated objects, from few to many."""
    for kind, (name, scene) in RECORDINGS.items() if data is not None else ():
        recordings = recording_set(name, data, 1)
        yield SpeedCase(kind, None, list(recordings.scene(scene).frames)[:length], load_config(recordings.family))
    for ties, size in product(TIES, sizes):
        yield SpeedCase(ties, size, speed_frames(size, ties, length, seed), speed_config(ties))


def measured(case: SpeedCase, methods: Sequence[Method], seconds: float) -> Iterator[Row]:
    """The rows of a case: cost, and shares of the stages."""
    settings: dict[str, tuple[TrackConfig, Method]] = {method: (case.config, method) for method in methods}
    if case.kind == "nuscenes":
        settings["saga, isam2"] = replace(case.config, tracker=replace(case.config.tracker, estimator="isam2")), "saga"
    clocks = {name: StageClock() for name in settings}
    trackers = {name: config.new_tracker(method, clocks[name]) for name, (config, method) in settings.items()}
    filters = _Filters()
    reported: dict[str, list[int]] = {name: [] for name in trackers}
    before: dict[str, Mapping[str, float]] = {name: {} for name in trackers}

    def contender(name: str) -> Callable[[Frame], Callable[[], Any]]:
        def prepare(frame: Frame) -> Callable[[], Any]:
            clocks[name].start()
            return partial(trackers[name].step, frame)

        return prepare

    def counted() -> Iterator[Frame]:
        for number, frame in enumerate(case.frames):
            if number == WARM_UP:
                before.update({name: dict(clock.seconds) for name, clock in clocks.items()})
            yield frame
            for name, tracker in trackers.items():
                reported[name].append(len(tracker.tracks(frame.timestamp).id))

    contenders = {name: contender(name) for name in trackers}
    contenders |= {"filters": lambda _: filters.step, "svd": lambda _: _svd}
    times = in_turn(contenders, counted(), WARM_UP, seconds)
    medians = {name: float(np.median(spent)) for name, spent in times.items()}
    title = case.kind if case.size is None else f"{case.size} {case.kind}"
    references = {"/ centerpoint": "centerpoint", "/ 100 filters": "filters", "/ SVD": "svd"}
    for name, tracker in trackers.items():
        about = {"case": title, "method": name, "tracks": np.mean(reported[name][-len(times[name]) :])}
        cost = {
            "ms": medians[name],
            "p99": float(np.percentile(times[name], 99)),
            "MB": len(pickle.dumps(tracker.snapshot())) / 1e6,
        }
        ratios = {column: medians[name] / medians.get(one, math.nan) for column, one in references.items()}
        yield "CPU time a frame", {**about, **cost, **ratios}
    for name, clock in clocks.items():
        spent = {stage: seconds - before[name].get(stage, 0.0) for stage, seconds in clock.seconds.items()}
        if total := math.fsum(spent.values()):
            shares = {stage: seconds / total for stage, seconds in spent.items()}
            yield "shares of the stages", {"case": title, "method": name, **shares}


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


def speed_frames(count: int, ties: Ties, frames: int, seed: int) -> list[Frame]:
    """Frames of `count` cars that drive along; each is missed now and then, nothing false is detected."""
    rng = np.random.default_rng(seed)
    k = np.arange(count)
    if ties == "loose":
        column, row, across, along = k // QUEUE % 50, k // QUEUE // 50 * (QUEUE + 5) + k % QUEUE, 12.0, 20.0
    else:
        side = int(np.ceil(np.sqrt(count)))
        column, row, across, along = k % side, k // side, 4.0, 12.0
    place = np.stack([row * along, column * across], axis=-1) + rng.normal(scale=(1.0, 0.3), size=(count, 2))
    speed, found = SPEED + rng.normal(scale=0.5, size=count), []
    for number in range(frames):
        place[:, 0] += speed * INTERVAL
        speed += rng.normal(scale=0.1, size=count)
        seen = np.flatnonzero(rng.random(count) < DETECTED)
        z = np.zeros((len(seen), 3))
        z[:, :2] = place[seen] + rng.normal(scale=NOISE, size=(len(seen), 2))
        label, size, unknown = np.full(len(seen), LABEL), np.tile(SIZE, (len(seen), 1)), np.full((len(seen), 2), np.nan)
        boxes = Boxes.of(label, z, size, np.zeros(len(seen)), unknown)
        found.append(Frame(number * INTERVAL, "lidar", Detections(boxes, np.full(len(seen), 0.9)), None))
    return found


def speed_config(ties: Ties) -> TrackConfig:
    """The shipped configuration of recorded traffic; where cars are densely connected, with edges of their own."""
    config = load_config("traffic")
    if ties == "loose":
        return config
    around = Neighbours(
        SharedVelocity(), rate=0.5, distance_scale=15.0, max_distance=20.0, max_degree=4, classes=(LABEL,)
    )
    return replace(config, tracker=replace(config.tracker, edges=(around,)))
