"""The running graph at work: what nonlinear interactions cost, what a lag costs in accuracy, and whether it stays flat.

Cost: vehicles in rows, each behind the next, all seen in every frame; with linear interactions (velocities approach the
leader's) and with those of the intelligent driver, in turn. Accuracy: scenes drawn from a nonlinear model, by a window
and by the whole graph in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.estimator_figures import Row
from benchmarks.flocks import Kind
from benchmarks.measuring import timed
from benchmarks.sampled_traffic import SampledFrame, process_noise, providers, sample_traffic
from data_tools.metrics import nees_band
from factors import gaussian_factors, prior_factors
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import EGO_POSE, OBJECT, Additions, GraphView, NewVariable
from saga_fg.graph.factor_checks import Factor
from saga_fg.model.nonlinear_interactions import SmoothDriver, interaction
from saga_fg.numerics.arrays import FloatArray, IntArray

KeyArray = NDArray[np.uint64]

DT, ROW, SPEED, GAP = 0.1, 5, 8.0, 14.0  # s, vehicles in a row, m/s, m
LAG, WARM_UP = 2.0, 5  # s, frames
F = np.eye(4) + DT * np.eye(4, k=2)
OWN, LEADER = F.copy(), np.zeros((4, 4))
OWN[2:, 2:] *= 0.95
LEADER[2:, 2:] = 0.05 * np.eye(2)


class Vehicles:
    """Rows of vehicles at 8 m/s, 14 m apart. life: frames after which another takes one's place; 0: they stay."""

    name = "vehicles"

    def __init__(self, count: int, row: int, linear: bool = False, life: int = 0) -> None:
        self.slots, self.row, self.linear, self.life = np.arange(count), row, linear, life
        self.start = np.zeros((count, 4))
        self.start[:, 0], self.start[:, 1] = -GAP * (self.slots % row), 5.0 * (self.slots // row)
        self.start[:, 2] = SPEED

    def ids(self, frame: int) -> IntArray:
        """Return the id of the vehicle in each place."""
        count = len(self.slots)
        return self.slots + count * ((frame + self.slots * self.life // count) // self.life if self.life else 0)

    def factors(self, view: GraphView) -> Additions:
        """Positions, new objects, and interactions of those that were there before."""
        ids, old, Q = self.ids(view.epoch), self.ids(view.epoch - 1), process_noise(DT)
        there = self.start + view.time * np.array([SPEED, 0.0, 0.0, 0.0])
        noise = 0.3 * np.random.default_rng(view.epoch).normal(size=(len(ids), 2))
        now = np.array([view.key(OBJECT, i) for i in ids.tolist()], dtype=np.uint64)
        H = np.tile(np.eye(2, 4), (len(ids), 1, 1))
        factors: list[Factor] = [
            *gaussian_factors(now[:, None], [H], there[:, :2] + noise, 0.09 * np.eye(2)),
        ]
        stay = (ids == old) & (view.epoch > 0)
        if not stay.all():
            factors += prior_factors(now[~stay], there[~stay], 0.5 * np.eye(4))
        if stay.any():
            before = view.before(OBJECT)
            last = np.array([before[i].key for i in old.tolist()], dtype=np.uint64)
            x = np.stack([view.state(key) for key in last.tolist()])
            there[stay] = x[stay] @ F.T
            head = stay & (self.slots % self.row == 0)
            first, behind = np.flatnonzero(head), np.flatnonzero(stay & ~head)
            factors += _linear(now, last, first, [F], Q)
            if self.linear:
                factors += _linear(now, last, behind, [OWN, LEADER], Q)
            elif len(behind):
                motion = interaction(SmoothDriver())
                there[behind] = motion.predict(x[behind], [x[behind - 1]], DT)
                factors.append(motion.factors(now[behind], last[behind], last[behind - 1, None], 4, DT, Q))
        return Additions(self._new(ids, there), factors)

    def _new(self, ids: IntArray, states: FloatArray) -> list[NewVariable]:
        return [NewVariable(OBJECT, i, x) for i, x in zip(ids.tolist(), states, strict=True)]


def _linear(now: KeyArray, last: KeyArray, rows: IntArray, blocks: Sequence[FloatArray], Q: FloatArray) -> list[Factor]:
    """x' = F x, plus a leader's share if there are two blocks, of the vehicles in some places."""
    keys = np.stack([now[rows], last[rows], last[rows - 1]][: 1 + len(blocks)], axis=1)
    J = [np.tile(M, (len(rows), 1, 1)) for M in (np.eye(4), *(-block for block in blocks))]
    return [*gaussian_factors(keys, J, np.zeros((len(rows), 4)), Q)] if len(rows) else []


def drivers(kind: Kind, n: int, frames: int) -> list[Row]:
    """Milliseconds a frame with linear interactions and with intelligent drivers, in turn."""
    contenders = {
        name: IncrementalSmoother([Vehicles(n, ROW if kind == "components" else n, name == "linear")])
        for name in ("linear", "intelligent driver")
    }
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for k in range(WARM_UP + frames):
        for name, smoother in contenders.items():
            times[name].append(timed(lambda smoother=smoother, k=k: smoother.step(DT * k)))  # type: ignore[misc]
    medians = {name: float(np.median(taken[WARM_UP:])) for name, taken in times.items()}
    return [Row("running graph", kind, n, name, ms, ms / medians["linear"]) for name, ms in medians.items()]


def endless_drivers(n: int) -> Callable[[int], None]:
    """Intelligent drivers in rows, each there for ten seconds, frame by frame."""
    smoother = IncrementalSmoother([Vehicles(n, ROW, life=100)])
    return lambda k: smoother.step(DT * k)


def windows(scenes: int, frames: int, seed: int) -> list[Row]:
    """A window of `LAG` s against the whole graph, on scenes drawn from the model.

    Errors are differences to the whole graph, in its standard deviations; the NEES is that of all newest variables
    together at the end of each scene, which are independent of each other from scene to scene.
    """
    times: dict[str, list[float]] = {"whole graph": [], f"lag {LAG:g} s": []}
    off: list[FloatArray] = []
    squares: dict[str, float] = dict.fromkeys(times, 0.0)
    degrees = nodes = 0
    for k in range(scenes):
        scene = sample_traffic(np.random.default_rng([seed, k]), frames)
        nodes = max(nodes, max(1 + len(frame.states) for frame in scene.frames))
        lags = dict(zip(times, (None, LAG), strict=True))
        both = {name: IncrementalSmoother(providers(scene), lag) for name, lag in lags.items()}
        whole, window = both.values()
        for frame in scene.frames:
            for name, smoother in both.items():
                times[name].append(timed(lambda smoother=smoother, t=frame.time: smoother.step(t)))  # type: ignore[misc]
            off += [_difference(whole, window, key) for key in _newest(whole)]
        for name, smoother in both.items():
            error = np.concatenate([_error(smoother, key, scene.frames[-1]) for key in _newest(smoother)])
            squares[name] += float(error @ np.linalg.solve(smoother.joint_covariance(_newest(smoother)), error))
        degrees += len(error)
    difference, band = np.concatenate(off), nees_band(degrees, 1, 0.99)
    errors = ((float("nan"),) * 2, (float(difference.max()), float(difference.mean())))
    milliseconds = {name: float(np.median(taken)) for name, taken in times.items()}
    baseline = milliseconds["whole graph"]
    return [
        Row("nonlinear", "connected", nodes, name, ms, ms / baseline, *error, anees=squares[name] / degrees, band=band)
        for (name, ms), error in zip(milliseconds.items(), errors, strict=True)
    ]


def _newest(smoother: IncrementalSmoother) -> list[int]:
    graph = smoother.graph()
    return [one.key for kind in (EGO_POSE, OBJECT) for one in graph.of(kind, graph.epoch).values()]


def _difference(whole: IncrementalSmoother, window: IncrementalSmoother, key: int) -> FloatArray:
    way = whole.graph().variable(key).type.local(whole.state(key), window.state(key))
    return np.asarray(np.abs(way) / np.sqrt(np.diag(whole.covariance(key))))


def _error(smoother: IncrementalSmoother, key: int, frame: SampledFrame) -> FloatArray:
    variable = smoother.graph().variable(key)
    truth = frame.pose if variable.kind == EGO_POSE else frame.states[variable.id]
    return variable.type.local(smoother.state(key), truth)
