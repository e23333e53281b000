"""What a recording without an end costs: memory and time of `WindowedSmoother` as hours go by.

Cars in platoons of five on a road, each listening to the one ahead of it at a rate that falls with their gap. Platoons
come and go (new objects with new ids), cars are hidden for seconds at a time; data are drawn from the model, frame by
frame, so that the bench, too, holds nothing but the present.
"""

from __future__ import annotations

import resource
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pipelines.process import one_thread, resident_memory
from saga_fg import ConstantVelocity, Edges, NodeType, SceneGraph
from saga_fg.estimators import BatchSmoother, Measurements, SmoothedState, WindowedSmoother, WindowSettings
from saga_fg.model.discretisation import discretise
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import Positive, Range, Settings, setting

PLATOON = 5
CAR = NodeType("car", ConstantVelocity(acceleration_noise=1.0))
PRIOR = np.diag([0.25, 0.25, 1.0, 1.0])
NOISE = 0.3  # standard deviation of a measured position, m
GAP = 15.0  # m between the cars of a platoon
RATE = 1.0  # at which a car takes over the velocity of the one ahead, 1/s
STAY = 60.0  # s that a platoon is there, on average
HIDING, HIDDEN = 0.02, 3.0  # spells a second, and their length in s


@dataclass(frozen=True)
class StreamingBenchSettings(Settings):
    """How much is measured."""

    objects: Annotated[int, Range(PLATOON, 10**6)] = setting(200, "objects at any time")
    seconds: Positive = setting(300.0, "length of the recording")
    rate: Positive = setting(10.0, "frames a second")
    rows: Annotated[int, Range(1, 1000)] = setting(10, "times at which memory is looked at")
    compared: Positive = setting(20.0, "s of a recording of its own on which the result is compared with the batch's")
    seed: int = setting(0, "seed of the traffic")


@dataclass(frozen=True)
class StreamingRow:
    """At a time of the recording (s): resident memory (MB), moments held, and CPU time so far (s)."""

    recorded: float
    memory: float
    held: int
    cpu: float


@dataclass(frozen=True)
class StreamingBench:
    """What was measured.

    moments  smoothed; rmse of their positions (m) and anees of their states (1 where covariances are right)
    peak     most memory of the process, MB; growth: of memory over the second half, MB
    ratio    CPU time over recorded time
    largest_difference  of any component of any mean from the batch smoother's, m or m/s
    """

    rows: tuple[StreamingRow, ...]
    moments: int
    peak: float
    growth: float
    ratio: float
    rmse: float
    anees: float
    largest_difference: float


@dataclass(frozen=True, eq=False)
class Instant:
    """A frame: ids that go before it (g,), ids that come (b,) with prior means (b, 4), how all then present move, what
    is seen, and the truth (n, 4) in the order of the transition's nodes.
    """

    gone: IntArray
    born: IntArray
    means: FloatArray
    transition: Transition
    measurements: Measurements
    truth: FloatArray


def bench_streaming(
    settings: StreamingBenchSettings,
    window: WindowSettings | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> StreamingBench:
    """Run the traffic through the smoother, then a short part of it through the batch smoother as well."""
    smoother, score, rows = WindowedSmoother(window), _Score(), list[StreamingRow]()
    frames = round(settings.seconds * settings.rate)
    marks = {round(frames * k / settings.rows) for k in range(1, settings.rows + 1)}
    cpu = 0.0
    with one_thread():
        for number, instant in enumerate(traffic(settings, frames), start=1):
            begin = time.thread_time()
            _take(smoother, instant)
            moments = smoother.final()
            cpu += time.thread_time() - begin
            score.truth(smoother.time, instant)
            score.count(moments)
            if number in marks:
                rows.append(StreamingRow(smoother.time, resident_memory(), score.waiting, cpu))
            if progress is not None and number % 10 == 0:
                progress("streaming", number, frames)
        score.count(smoother.finish())
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        difference = _largest_difference(settings, window)
    half = rows[len(rows) // 2 :]
    growth = half[-1].memory - half[0].memory
    recorded = frames / settings.rate
    return StreamingBench(tuple(rows), score.moments, peak, growth, cpu / recorded, score.rmse, score.anees, difference)


def traffic(settings: StreamingBenchSettings, frames: int) -> Iterator[Instant]:
    """Frames of the platoons."""
    rng = np.random.default_rng(settings.seed)
    dt, n = 1 / settings.rate, settings.objects // PLATOON * PLATOON
    nodes, next_id = np.empty(0, dtype=np.int64), 0
    truth, hidden = np.empty((0, 4)), np.empty(0)
    for _ in range(frames):
        leaving = np.repeat(rng.random(len(nodes) // PLATOON) < dt / STAY, PLATOON)
        gone, nodes, truth, hidden = nodes[leaving], nodes[~leaving], truth[~leaving], hidden[~leaving]
        count = n - len(nodes)
        born = np.arange(next_id, next_id + count)
        next_id += count
        fresh = _platoons(rng, count // PLATOON)
        means = fresh + rng.normal(size=(count, 4)) * np.sqrt(np.diag(PRIOR))
        nodes, truth = np.concatenate([nodes, born]), np.concatenate([truth, fresh])
        hidden = np.concatenate([hidden, np.zeros(count)])
        transition = discretise(_platoon_graph(nodes, truth), dt)
        truth = (transition.F_matrix @ truth.ravel() + transition.b).reshape(-1, 4)
        for blocks in transition.Q:
            root = np.linalg.cholesky(blocks.values)
            truth[blocks.target] += (root @ rng.normal(size=(len(blocks.target), 4, 1)))[:, :, 0]
        hides = (hidden <= 0) & (rng.random(n) < HIDING * dt)
        hidden = np.where(hides, rng.exponential(HIDDEN, n), hidden - dt)
        seen = np.flatnonzero(hidden <= 0)
        z = truth[seen, :2] + NOISE * rng.normal(size=(len(seen), 2))
        measurements = Measurements(nodes[seen], z, np.eye(2, 4), NOISE**2 * np.eye(2))
        yield Instant(gone, born, means, transition, measurements, truth)


def _platoons(rng: np.random.Generator, count: int) -> FloatArray:
    """States (5 count, 4) of new platoons."""
    states = np.zeros((count, PLATOON, 4))
    states[:, :, 0] = rng.uniform(0, 1000, (count, 1)) - GAP * np.arange(PLATOON)
    states[:, :, 1] = rng.uniform(-100, 100, (count, 1))
    states[:, :, 2] = rng.normal(15, 3, (count, 1))
    return states.reshape(-1, 4)


def _platoon_graph(nodes: IntArray, truth: FloatArray) -> SceneGraph:
    """Every car but the first listens to the one ahead."""
    rows = np.arange(len(nodes))
    target = rows[rows % PLATOON > 0]
    gap = np.hypot(*(truth[target - 1, :2] - truth[target, :2]).T)
    S = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(target), 1, 1))
    rate = RATE * np.exp(-gap / (4 * GAP))
    edges = Edges("following", target, target - 1, rate, -S, S, np.zeros((len(target), 4)))
    return SceneGraph.of(nodes, CAR, [edges])


def _take(smoother: WindowedSmoother | BatchSmoother, instant: Instant) -> None:
    smoother.marginalise(instant.gone)
    smoother.add(instant.born, instant.means, np.tile(PRIOR, (len(instant.born), 1, 1)))
    smoother.predict(instant.transition)
    smoother.update(instant.measurements)


class _Score:
    """Errors of the moments that have become final against the truth, which waits for them."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[float, IntArray, FloatArray]] = deque()
        self.moments = 0
        self._squares = self._nees = 0.0
        self._states = 0

    @property
    def waiting(self) -> int:
        """Moments that are not final yet."""
        return len(self._waiting)

    @property
    def rmse(self) -> float:
        """Of positions, m."""
        return float(np.sqrt(self._squares / max(self._states, 1)))

    @property
    def anees(self) -> float:
        """Mean of e^T P^-1 e / d."""
        return self._nees / max(self._states, 1)

    def truth(self, at: float, instant: Instant) -> None:
        """Of a frame."""
        self._waiting.append((at, instant.transition.nodes, instant.truth))

    def count(self, moments: tuple[SmoothedState, ...]) -> None:
        """Compare moments with the truth, and forget it."""
        for moment in moments:
            if not self._waiting or moment.time < self._waiting[0][0] - 1e-6:
                continue  # the moment before the first frame
            _, nodes, truth = self._waiting.popleft()
            error = moment.mean(nodes) - truth
            self.moments += 1
            self._squares += float((error[:, :2] ** 2).sum())
            P = moment.covariance(nodes)
            self._nees += float((error[:, None] @ np.linalg.solve(P, error[:, :, None])).sum()) / 4
            self._states += len(error)


def _largest_difference(settings: StreamingBenchSettings, window: WindowSettings | None) -> float:
    """Of any component of any mean from that of the batch smoother, on the first seconds of the traffic."""
    smoother, batch = WindowedSmoother(window), BatchSmoother(likelihoods=False, order="time")
    moments: list[SmoothedState] = []
    for instant in traffic(settings, round(settings.compared * settings.rate)):
        _take(smoother, instant)
        _take(batch, instant)
        moments += smoother.final()
    pairs = zip(moments, batch.smoothed(covariances=False), strict=False)  # those that were final before the end
    return max((float(np.abs(mine.state - theirs.state).max(initial=0.0)) for mine, theirs in pairs), default=np.nan)
