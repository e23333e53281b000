"""A long random drive of the running graph beside the joint Kalman filter, run again for what is late.

python -m tests.saga_fg.estimators.soak SECONDS [SEED]      each lag; every second seed has late measurements
"""

import sys
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from saga_fg import Edges, SceneGraph
from saga_fg.conformance.programs import CAR, CONE
from saga_fg.estimators import GraphFilter, JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise

LAGS = (0.0, 0.3, 1.0)
INTERVALS = (1e-3, 0.05, 0.1, 0.1, 0.1, 0.2, 0.5, 2.0)
TYPES = {4: CAR, 2: CONE}


@dataclass
class Step:
    """The filter at the begin of an epoch, what it was told then, and the transition to the next."""

    time: float
    state: Any
    calls: list = field(default_factory=list)
    transition: Any = None


class ReplayedKalman:
    """The joint Kalman filter, which takes measurements of the last three seconds."""

    def __init__(self):
        self.filter = JointKalmanFilter()
        self.steps = [Step(0.0, self.filter.snapshot())]

    def tell(self, name, *arguments):
        self.steps[-1].calls.append((name, arguments))
        getattr(self.filter, name)(*arguments)

    def predict(self, transition):
        self.steps[-1].transition = transition
        self.filter.predict(transition)
        self.steps.append(Step(self.steps[-1].time + transition.dt, self.filter.snapshot()))
        self.steps = [step for step in self.steps if step.time >= self.steps[-1].time - 3.0]

    def update_late(self, measurements, moment):
        k = max(k for k, step in enumerate(self.steps) if step.time <= moment + 1e-9)
        before, step = self.steps[:k], self.steps[k]
        again = [(step.calls, step.transition), *((one.calls, one.transition) for one in self.steps[k + 1 :])]
        if moment > step.time + 1e-9:
            graph, first = step.transition.graph, moment - step.time
            rest = discretise(graph, step.transition.dt - first)
            again[0:1] = [(step.calls, discretise(graph, first)), ([("update", (measurements,))], rest)]
        else:
            again[0] = ([*step.calls, ("update", (measurements,))], step.transition)
        self.filter.restore(step.state)
        self.steps = [*before, Step(step.time, step.state)]
        for calls, transition in again:
            for name, arguments in calls:
                if not (name == "update" and not set(arguments[0].nodes.tolist()) <= set(self.filter.nodes.tolist())):
                    self.tell(name, *arguments)
            if transition is not None:
                self.predict(transition)


def random_edges(rng, ids, dims, pairs):
    """Of the pairs that are there, damped, between nodes of any two types."""
    row, made = {node: k for k, node in enumerate(ids)}, []
    for target, source in pairs:
        if target in row and source in row:
            a, b = dims[target], dims[source]
            A_self, A_other = -np.eye(a), 0.5 * rng.normal(size=(a, b))
            made.append(
                Edges("any", [row[target]], [row[source]], [rng.uniform(0.2, 1.0)], [A_self], [A_other], [np.zeros(a)])
            )
    return made


def drive(seed, lag, frames, late=0.3, until=np.inf):
    """Raise AssertionError at the first difference; returns the largest: of means in sigma, of covariances relative."""
    rng, estimator, exact = np.random.default_rng(seed), GraphFilter(lag=lag), ReplayedKalman()
    dims, born, pairs, worst, late_ones, sizes = {}, {}, set(), np.zeros(2), 0, []

    def both(name, *arguments):
        exact.tell(name, *arguments)
        getattr(estimator, name)(*arguments)

    def compare(what):
        nodes = estimator.nodes
        assert sorted(nodes.tolist()) == sorted(exact.filter.nodes.tolist())
        P = exact.filter.joint_covariance(nodes)
        sigma = np.sqrt(np.diag(P))
        off = np.abs((estimator.joint_mean(nodes) - exact.filter.joint_mean(nodes)) / sigma).max(initial=0.0)
        apart = np.abs((estimator.joint_covariance(nodes) - P) / np.outer(sigma, sigma)).max(initial=0.0)
        worst[:] = np.maximum(worst, [off, apart])
        assert worst.max() < 1e-8, f"seed {seed}, lag {lag}, frame {frame}, after {what}: {worst}"

    for frame in range(frames):
        if time.monotonic() > until:
            break
        ids = list(dims)
        for node in [n for n in ids if rng.random() < 0.06]:
            both("marginalise", [node])
            del dims[node]
        for _ in range(rng.poisson(0.8 if len(dims) < 10 else 0.2)):
            node = int(rng.integers(0, 30))
            if node not in dims:  # an id that has been there before, now and then at the very time at which it left
                dims[node] = d = int(rng.choice([4, 4, 2]))
                root = rng.normal(size=(d, d))
                both("add", [node], 5 * rng.normal(size=(1, d)), (root @ root.T + 0.3 * np.eye(d))[None])
                born[node] = estimator.time
        ids = [int(node) for node in rng.permutation(list(dims))]
        pairs = {pair for pair in pairs if rng.random() < 0.85}
        if frame % 120 > 60:
            pairs = set()  # everybody alone for a while
        elif len(ids) > 1 and rng.random() < 0.5:
            pairs.add(tuple(int(n) for n in rng.choice(ids, 2, replace=False)))
        graph = SceneGraph(
            np.array(ids, dtype=np.int64),
            tuple(TYPES[dims[n]] for n in ids),
            tuple(random_edges(rng, ids, dims, pairs)),
        )
        interval = discretise(graph, float(rng.choice(INTERVALS)))
        exact.predict(interval)
        estimator.predict(interval)
        compare("predict")
        for d in (4, 2):
            seen = [n for n in ids if dims[n] == d and rng.random() < 0.6]
            if not seen:
                continue
            measured = Measurements(seen, 5 * rng.normal(size=(len(seen), 2)), np.eye(2, d), 0.1 * np.eye(2))
            step = exact.steps[rng.integers(max(0, len(exact.steps) - 6), len(exact.steps))]
            moment = step.time
            if step.transition is not None and step.transition.dt >= 0.1:
                moment += step.transition.dt / 2
            known = np.array([born[n] <= moment + 1e-9 for n in seen])
            if moment >= estimator.start and moment < estimator.time and rng.random() < late:
                known &= estimator.remembered(seen, moment)
                if known.any():
                    measured = Measurements(
                        measured.nodes[known], measured.z[known], measured.H[known], measured.R[known]
                    )
                    exact.update_late(measured, moment)
                    estimator.update(measured, moment)
                    late_ones += 1
                    compare("late update")
            else:
                both("update", measured)
                compare("update")
        if rng.random() < 0.05:
            estimator.restore(estimator.snapshot())
        sizes.append(len(estimator._smoother.graph().variables))
    return worst, late_ones, max(sizes, default=0)


if __name__ == "__main__":
    until, seed = time.monotonic() + float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    while time.monotonic() < until:
        for lag in LAGS:
            try:
                print(seed, lag, *drive(seed, lag, 300, 0.3 * (seed % 2), until), flush=True)
            except Exception as error:  # every difference is to be seen, with its seed
                print(seed, lag, type(error).__name__, str(error)[:160], flush=True)
        seed += 1
