"""Every estimator against its baseline: the textbook on dense matrices, or GTSAM's own fixed-lag smoother.

Filters read all means and all per-node covariances after every frame; the fixed-lag smoothers all means of their window
and (ours only) the newest covariances; the batch smoothers all means and all per-node covariances of a recording. The
running graph takes vehicles with linear interactions and with those of intelligent drivers.

    ratio            of the times to the baseline's
    largest, mean    difference of a mean from the reference's, standard deviations
    covariance       largest relative difference of a node's covariance, Frobenius
    ANEES            mean normalised squared error of the estimates: 1 if covariances are right
    MB               of the estimator's state
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.filters import Filter, GtsamWindow, Ours, OurWindow, Read, Textbook, blocks, dense
from benchmarks.flocks import DT, Flock, FlockFrame, Kind, flock
from benchmarks.runner import Row, Rows, Seed, counts, each, growth, in_turn
from benchmarks.sampled_traffic import Interaction
from factors import gaussian_factors, prior_factors
from saga_fg.estimators import (
    Gaussian,
    GraphFilter,
    IncrementalSmoother,
    JointKalmanFilter,
    RecordingSmoother,
    kalman_predict,
    kalman_update,
    rts_smooth,
)
from saga_fg.graph import OBJECT, Additions, GraphView, NewVariable
from saga_fg.model import SmoothDriver
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.tracking import TrackerSettings

KINDS: tuple[Kind, ...] = ("connected", "components")
LAG, WARM_UP = 5, 3  # frames; those that are not counted
DENSE, WHOLE = 300, 100  # more nodes in one graph are hopeless for the textbook and iSAM2; for windows and the graph
GROWTH_FROM = 50  # nodes: below, calls cost more than numbers
ROW = 5  # vehicles
F = np.eye(4) + DT * np.eye(4, k=2)
Q: FloatArray = np.asarray(0.3 * np.kron([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]], np.eye(2)), dtype=np.float64)
OWN, LEADER = np.diag([1.0, 1.0, 0.95, 0.95]) @ F, np.diag([0.0, 0.0, 0.05, 0.05])
COST, GROWTH = "cost, and error in standard deviations", "growth of the cost"


def estimators(
    sizes: Annotated[
        str, typer.Option("--sizes", help="Numbers of nodes, with commas between.")
    ] = "10,50,100,300,1000",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of each case that are counted.")] = 20,
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, help="No more frames of a case after that.")] = 30.0,
    batch: Annotated[
        int, typer.Option("--batch-frames", min=0, help="Length of the batch smoothers' recording; 0: none.")
    ] = 200,
    nodes: Annotated[int, typer.Option("--nodes", min=2, help="Nodes of it.")] = 100,
    seed: Seed = 0,
) -> Rows:
    """Measure time, memory and exactness of the estimators.

    Filters are compared with the textbook's on dense matrices, fixed-lag smoothers with GTSAM's, batch smoothers with
    Rauch, Tung and Striebel's, a running graph of intelligent drivers with a linear one.

    \b
    Examples:
      python -m benchmarks estimators
      python -m benchmarks estimators --sizes 10,100 --frames 5 --json figures.json
    """
    numbers = counts("--sizes", sizes, least=2)
    cases: list[Callable[[], Iterator[Row]]] = []
    for n in numbers:
        for kind in KINDS:
            cases.append(partial(_filters, kind, n, frames, seconds, seed))
            if kind == "components" or n <= WHOLE:
                cases.append(partial(_windows, kind, n, frames, seconds, seed))
            if n <= WHOLE:
                cases.append(partial(_running_graph, kind, n, frames, seconds))
    if batch:
        cases += [partial(_batch, kind, nodes, batch, seed) for kind in KINDS]
    costs: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for case in each(cases, "cases"):
        for title, row in case():
            if row["nodes"] >= GROWTH_FROM and row["case"] != "batch":
                costs.setdefault((row["estimator"], row["graph"]), []).append((row["nodes"], row["ms"]))
            yield title, row
    for (name, graph), points in costs.items():
        if len(points) > 2:
            yield GROWTH, {"estimator": name, "graph": graph, "nodes^": growth(*zip(*points, strict=True))}


def _filters(kind: Kind, n: int, frames: int, seconds: float, seed: int) -> Iterator[Row]:
    scene, tracker = flock(kind, n, frames + WARM_UP, seed), TrackerSettings()
    filters: dict[str, Filter] = {"textbook": Textbook(scene)} if n <= DENSE else {}
    filters["kalman"] = Ours(JointKalmanFilter(), scene)
    if kind == "connected":
        bounds = tracker.tolerance, tracker.max_component
        filters["kalman, as in the tracker"] = Ours(JointKalmanFilter((), *bounds), scene)
    if kind == "components" or n <= DENSE:
        filters["isam2"] = Ours(GraphFilter(), scene)
    anees: dict[str, list[float]] = {name: [] for name in filters}

    def judged() -> Iterator[FlockFrame]:
        for frame in scene.frames:
            yield frame
            for name, one in filters.items():
                anees[name].append(_anees(frame.truth, *one.read()))

    times = in_turn({name: one.prepare for name, one in filters.items()}, judged(), WARM_UP, seconds)
    reference, base = next(iter(filters)), float(np.median(times[next(iter(filters))]))
    for name, one in filters.items():
        ms = float(np.median(times[name]))
        errors = _errors(one.read(), filters[reference].read())
        memory = len(pickle.dumps(one.estimator.snapshot())) / 1e6 if isinstance(one, Ours) else None
        about = {"case": "filter", "graph": kind, "nodes": n, "estimator": name, "ms": ms, "ratio": ms / base}
        yield COST, {**about, **errors, "ANEES": float(np.mean(anees[name][WARM_UP:] or math.nan)), "MB": memory}


def _windows(kind: Kind, n: int, frames: int, seconds: float, seed: int) -> Iterator[Row]:
    scene = flock(kind, n, frames + WARM_UP + LAG, seed)
    ours, theirs = OurWindow(LAG, scene), GtsamWindow(LAG, scene)
    times = in_turn({"GTSAM's": theirs.prepare, "fixed-lag": ours.prepare}, scene.frames, WARM_UP + LAG, seconds)
    sigma = np.sqrt(np.diagonal(ours.read()[1], axis1=1, axis2=2)).ravel()
    off = np.array([np.abs((a - b) / sigma) for a, b in zip(ours.window, theirs.window, strict=True)])
    for name, spent in times.items():
        ms = float(np.median(spent))
        about = {"case": "fixed lag", "graph": kind, "nodes": n, "estimator": name, "ms": ms}
        errors = {"largest": off.max(), "mean": off.mean()} if name == "fixed-lag" else {}
        yield COST, {**about, "ratio": ms / float(np.median(times["GTSAM's"])), **errors}


def _batch(kind: Kind, n: int, frames: int, seed: int) -> Iterator[Row]:
    scene, found = flock(kind, n, frames, seed), dict[str, list[Read]]()
    runs = {"textbook": _textbook_smoother, "batch": _batch_smoother}
    contenders = {
        name: partial(lambda run, _, name: lambda: found.update({name: run(scene)}), run, name=name)
        for name, run in runs.items()
    }
    times = in_turn(contenders, (scene,))
    pairs = zip(found["batch"], found["textbook"], strict=True)
    errors = [_errors(mine, reference) for mine, reference in pairs]
    worst = {key: max(error[key] for error in errors) for key in errors[0]}
    for name in runs:
        ms = float(times[name][0])
        about = {"case": "batch", "graph": kind, "nodes": n, "estimator": name, "ms": ms}
        yield COST, {**about, "ratio": ms / float(times["textbook"][0]), **(worst if name == "batch" else {})}


def _batch_smoother(scene: Flock) -> list[Read]:
    smoother = RecordingSmoother()
    smoother.add(scene.nodes, scene.means, scene.covariances)
    for frame in scene.frames:
        smoother.predict(frame.transition)
        smoother.update(frame.measurements)
    return [(now.mean(scene.nodes), now.covariance(scene.nodes)) for now in smoother.finish()]


def _textbook_smoother(scene: Flock) -> list[Read]:
    n, d = scene.means.shape
    P = np.zeros((n, d, n, d))
    P[np.arange(n), :, np.arange(n)] = scene.covariances
    filtered, predicted, transitions = [Gaussian(scene.means.ravel(), P.reshape(n * d, -1))], [], []
    for frame in scene.frames:
        F, b, Q, z, H, R = dense(frame)
        predicted.append(kalman_predict(filtered[-1], F, b, Q))
        filtered.append(kalman_update(predicted[-1], z, H, R)[0])
        transitions.append(F)
    return [blocks(now.mean, now.covariance, n) for now in rts_smooth(filtered, predicted, transitions)]


def _running_graph(kind: Kind, n: int, frames: int, seconds: float) -> Iterator[Row]:
    row = ROW if kind == "components" else n
    graphs = {"linear": True, "intelligent driver": False}
    smoothers = {name: IncrementalSmoother([Vehicles(n, row, linear)]) for name, linear in graphs.items()}
    contenders = {name: partial(partial, smoother.step) for name, smoother in smoothers.items()}
    times = in_turn(contenders, [DT * k for k in range(WARM_UP + frames)], WARM_UP, seconds)
    for name, spent in times.items():
        about = {"case": "running graph", "graph": kind, "nodes": n, "estimator": name, "ms": float(np.median(spent))}
        yield COST, {**about, "ratio": float(np.median(spent) / np.median(times["linear"]))}


def _anees(truth: FloatArray, means: FloatArray, covariances: FloatArray) -> float:
    """Mean over nodes of e^T P^-1 e / d."""
    error = (truth - means)[:, :, None]
    square = np.swapaxes(error, 1, 2) @ np.linalg.solve(covariances, error)
    return float(square.mean() / truth.shape[1])


def _errors(read: Read, reference: Read) -> dict[str, float]:
    """Differences of means, in standard deviations, and of covariances."""
    off = np.abs((read[0] - reference[0]) / np.sqrt(np.diagonal(reference[1], axis1=1, axis2=2)))
    relative = np.linalg.norm(read[1] - reference[1], axis=(1, 2)) / np.linalg.norm(reference[1], axis=(1, 2))
    return {"largest": float(off.max()), "mean": float(off.mean()), "covariance": float(relative.max())}


class Vehicles:
    """Provider of rows of vehicles at 8 m/s, 14 m apart, each behind the next, all seen in every frame.

    With linear interactions velocities approach the leader's; others are those of the intelligent driver.
    """

    name = "vehicles"

    def __init__(self, count: int, row: int, linear: bool) -> None:
        self.linear, self.slots = linear, np.arange(count)
        self.start = np.zeros((count, 4))
        self.start[:, 0], self.start[:, 1] = -14.0 * (self.slots % row), 5.0 * (self.slots // row)
        self.start[:, 2] = 8.0
        self.first, self.behind = np.flatnonzero(self.slots % row == 0), np.flatnonzero(self.slots % row)

    def factors(self, view: GraphView) -> Additions:
        """Positions, priors in the first frame, then interactions."""
        there = self.start + view.time * np.array([8.0, 0.0, 0.0, 0.0])
        z = there[:, :2] + 0.3 * np.random.default_rng(view.epoch).normal(size=(len(there), 2))
        now = np.array([view.key(OBJECT, i) for i in self.slots.tolist()], dtype=np.uint64)
        H = np.tile(np.eye(2, 4), (len(there), 1, 1))
        factors: list[Any] = [gaussian_factors(now[:, None], [H], z, 0.09 * np.eye(2))]
        if view.epoch == 0:
            factors.append(prior_factors(now, there, 0.5 * np.eye(4)))
        else:
            before, behind = view.before(OBJECT), self.behind
            last = np.array([before[i].key for i in self.slots.tolist()], dtype=np.uint64)
            x = np.stack([view.state(key) for key in last.tolist()])
            there = x @ F.T
            factors += _linear(now, last, self.first, [F])
            if self.linear:
                factors += _linear(now, last, behind, [OWN, LEADER])
            elif len(behind):
                motion = Interaction(SmoothDriver())
                there[behind] = motion.predict(x[behind], [x[behind - 1]], DT)
                factors.append(motion.factors(np.stack([now[behind], last[behind], last[behind - 1]], axis=1), DT, Q))
        return Additions([NewVariable(OBJECT, i, x) for i, x in zip(self.slots.tolist(), there, strict=True)], factors)


def _linear(now: Any, last: Any, rows: IntArray, parts: Sequence[FloatArray]) -> list[Any]:
    """x' = F x, plus a leader's share if there are two parts, of the vehicles in some places."""
    keys = np.stack([now[rows], last[rows], last[rows - 1]][: 1 + len(parts)], axis=1)
    J = [np.tile(M, (len(rows), 1, 1)) for M in (np.eye(4), *(-part for part in parts))]
    return [gaussian_factors(keys, J, np.zeros((len(rows), 4)), Q)] if len(rows) else []
