"""Random scenarios for estimators, and the textbook's answer to them on dense joint states.

A scenario is a list of calls: nodes of several types appear and go, graphs change at every step, sensors of different
kinds speak or are silent, some of them late.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from saga_fg.conformance.programs import BUS, CAR, CONE, TRAM, random_graph
from saga_fg.estimators import Gaussian, GraphFilter, Measurements, kalman_predict, kalman_update, rts_smooth
from saga_fg.model.discretisation import discretise

EXACT = 1e-9  # standard deviations of means, relative difference of covariances
INTERVALS = (0.05, 0.1, 0.31, 0.7)  # s


def random_covariance(rng, count, dim, scale=1.0):
    root = rng.normal(size=(count, dim, dim))
    return scale * (root @ np.swapaxes(root, 1, 2) + 0.3 * np.eye(dim))


def random_measurements(rng, nodes, dim, rows=2):
    """Measurements of random linear combinations of the states, each with its own noise."""
    count = len(nodes)
    H = rng.normal(size=(count, rows, dim))
    return Measurements(nodes, rng.normal(size=(count, rows)) * 5, H, random_covariance(rng, count, rows, 0.2))


@dataclass
class Scenario:
    """calls: (name, arguments) in order; types: node types by id."""

    calls: list = field(default_factory=list)
    types: dict = field(default_factory=dict)


def random_scenario(
    rng, frames=8, kinds=(CAR, BUS, TRAM, CONE), late=0.0, density=0.3, first=4, intervals=INTERVALS, grid=0.0
):
    """At most a dozen nodes over `frames` intervals; `late`: share of measurements that are of an earlier time.

    grid: those are multiples of it, s; 0: any
    """
    scenario = Scenario()
    present, next_id, now = [], 100, 0.0

    def bear(count):
        nonlocal next_id
        for _ in range(count):
            kind = kinds[rng.integers(len(kinds))]
            scenario.types[next_id] = kind
            mean, covariance = rng.normal(size=(1, kind.dim)) * 10, random_covariance(rng, 1, kind.dim)
            scenario.calls.append(("add", [next_id], mean, covariance))
            present.append(next_id)
            next_id += 1

    bear(first)
    for _ in range(frames):
        for dim in sorted({scenario.types[i].dim for i in present}):
            same = [i for i in present if scenario.types[i].dim == dim]
            for sensor in range(2):
                seen = [i for i in same if rng.random() < 0.6]
                if not seen:
                    continue
                measured = random_measurements(rng, seen, dim, rows=1 + sensor)
                time = now - rng.uniform(0, 0.4) if now > 0.5 and rng.random() < late else None
                time = grid * round(time / grid) if grid and time is not None else time
                scenario.calls.append(("update", measured, time))
        if len(present) > 2 and rng.random() < 0.4:
            gone = present.pop(rng.integers(len(present)))
            scenario.calls.append(("marginalise", [gone]))
        if len(present) < 10 and rng.random() < 0.5:
            bear(1 + rng.integers(2))
        order = rng.permutation(present)
        graph = random_graph(rng, tuple(scenario.types[i] for i in order), ids=order, density=density)
        dt = float(rng.choice(intervals))
        scenario.calls.append(("predict", discretise(graph, dt)))
        now += dt
    return scenario


@dataclass
class Step:
    """A moment of the textbook's record."""

    time: float
    new_nodes: list = field(default_factory=list)
    seen: list = field(default_factory=list)
    gone: list = field(default_factory=list)
    transition: Any = None


class Textbook:
    """Filter and Rauch-Tung-Striebel smoother over everything told, done anew for every question."""

    def __init__(self):
        self.steps = [Step(0.0)]

    def add(self, nodes, means, covariances):
        self.steps[-1].new_nodes.append((list(nodes), np.asarray(means), np.asarray(covariances)))

    def predict(self, transition):
        self.steps[-1].transition = transition
        self.steps.append(Step(self.steps[-1].time + transition.dt))

    def update(self, measurements, time=None):
        if time is None:
            self.steps[-1].seen.append(measurements)
            return
        k = max(k for k, step in enumerate(self.steps) if step.time <= time + 1e-9)
        if self.steps[k].time < time - 1e-9:
            whole = self.steps[k].transition
            self.steps[k].transition = discretise(whole.graph, time - self.steps[k].time)
            rest = discretise(whole.graph, whole.dt - (time - self.steps[k].time))
            k += 1
            self.steps.insert(k, Step(time, transition=rest))
        self.steps[k].seen.append(measurements)

    def marginalise(self, nodes):
        self.steps[-1].gone += list(nodes)

    def appearances(self):
        """Time at which each node appeared, the last time if it has come back, s."""
        return {node: step.time for step in self.steps for nodes, _, _ in step.new_nodes for node in nodes}

    def solve(self):
        """Per step: time, places of each node, filtered and smoothed `Gaussian`; and the log-likelihood of it all."""
        x, live, total = Gaussian(np.empty(0), np.empty((0, 0))), {}, 0.0
        filtered, predicted, transitions, places = [], [], [], []
        for k, step in enumerate(self.steps):
            for nodes, means, covariances in step.new_nodes:
                for node, mean, covariance in zip(nodes, means, covariances, strict=True):
                    live[node] = np.arange(len(x.mean), len(x.mean) + len(mean))
                    x = Gaussian(
                        np.concatenate([x.mean, mean]),
                        scipy.linalg.block_diag(x.covariance, covariance)[-len(x.mean) - len(mean) :],
                    )
            if k > 0:
                F = np.zeros((len(x.mean), transitions[-1].shape[1]))
                F[: len(transitions[-1])] = transitions[-1]
                transitions[-1] = F
                predicted.append(x)
            for measured in step.seen:
                rows, D = measured.H.shape[1], len(x.mean)
                H = np.zeros((len(measured) * rows, D))
                for m, node in enumerate(measured.nodes.tolist()):
                    H[m * rows : (m + 1) * rows, live[node]] = measured.H[m]
                x, likelihood = kalman_update(x, measured.z.ravel(), H, scipy.linalg.block_diag(*measured.R))
                total += likelihood
            filtered.append(x)
            places.append(dict(live))
            if step.transition is None:
                continue
            stay = [int(node) for node in step.transition.nodes]
            assert set(stay) == set(live) - set(step.gone)
            chosen = np.concatenate([np.empty(0, dtype=int), *(live[node] for node in stay)])
            S = np.eye(len(x.mean))[chosen]
            F = step.transition.F_matrix.toarray() @ S
            x = kalman_predict(x, F, step.transition.b, step.transition.Q_matrix.toarray())
            transitions.append(F)
            offsets = step.transition.offsets
            live = {node: np.arange(offsets[i], offsets[i + 1]) for i, node in enumerate(stay)}
        smoothed = rts_smooth(filtered, predicted, transitions)
        times = [step.time for step in self.steps]
        return list(zip(times, places, filtered, smoothed, strict=True)), total


def mean_error(mean, reference):
    """Largest difference of a mean in standard deviations."""
    return float(np.max(np.abs(mean - reference.mean) / np.sqrt(np.diag(reference.covariance)), initial=0.0))


def covariance_error(covariance, reference):
    """Relative difference in the Frobenius norm."""
    return float(np.linalg.norm(covariance - reference) / max(np.linalg.norm(reference), 1e-300))


def part(x, places, nodes):
    """The marginal of some nodes."""
    chosen = np.concatenate([np.empty(0, dtype=int), *(places[int(node)] for node in nodes)])
    return Gaussian(x.mean[chosen], x.covariance[np.ix_(chosen, chosen)])


def tell(estimator, calls):
    """The estimator, told of all that."""
    for name, *arguments in calls:
        getattr(estimator, name)(*arguments)
    return estimator


def admissible(textbook, call, estimator):
    """The call, of late measurements those parts that the estimator takes; None where it takes nothing."""
    name, *arguments = call
    if name != "update" or arguments[1] is None:
        return call
    measured, time = arguments
    nodes = measured.nodes
    born = textbook.appearances()
    in_time = np.array([born.get(node, np.inf) <= time + 1e-9 for node in nodes.tolist()])
    if not isinstance(estimator, GraphFilter):
        return call if in_time.all() else None
    kept = np.isin(nodes, estimator.nodes)
    kept[kept] = estimator.remembered(nodes[kept], time)
    assert in_time[kept].all(), "nothing is remembered from before it appeared"
    if time < estimator.start:
        assert not kept.any()
    if not kept.any():
        return None
    return name, Measurements(nodes[kept], measured.z[kept], measured.H[kept], measured.R[kept]), time


def assert_smoothed(estimator, textbook, joint=True, everything=False):
    """Epochs of the window, which are the last ones, as the textbook has them; `joint`: joint covariances, too.

    It has the nodes that are there now, each of them in all epochs from one on; `everything`: from that on in which it
    appeared.
    """
    steps, _ = textbook.solve()
    epochs, born = estimator.smoothed(), textbook.appearances()
    assert epochs[-1].time == estimator.time
    possible = set(estimator.nodes.tolist())
    for k, (epoch, (time, places, _, reference)) in enumerate(zip(epochs[::-1], steps[::-1], strict=False)):
        assert epoch.time == pytest.approx(time, abs=1e-12)
        nodes = set(epoch.nodes.tolist())
        if everything or k == 0:
            assert nodes == {node for node in possible if born[node] <= time + 1e-9}
        else:
            assert nodes <= possible
            assert estimator.remembered(epoch.nodes, time).all()
            possible = nodes
        expected = part(reference, places, epoch.nodes)
        assert mean_error(epoch.x.mean, expected) < EXACT
        if joint:
            P = epoch.x.joint(np.arange(len(epoch.nodes)))
            assert covariance_error(P, expected.covariance) < EXACT
        for node in epoch.nodes:
            own = part(reference, places, [node])
            assert mean_error(epoch.mean([node])[0], own) < EXACT
            assert covariance_error(epoch.covariance([node])[0], own.covariance) < EXACT


def assert_newest(estimator, textbook, tolerance=EXACT):
    """The newest states and their joint covariance are the textbook's."""
    (time, places, filtered, _), gone = textbook.solve()[0][-1], textbook.steps[-1].gone
    nodes = [node for node in places if node not in gone]
    expected = part(filtered, places, nodes)
    assert estimator.time == pytest.approx(time, abs=1e-12)
    assert sorted(estimator.nodes.tolist()) == sorted(nodes)
    assert mean_error(estimator.joint_mean(nodes), expected) < tolerance
    assert covariance_error(estimator.joint_covariance(nodes), expected.covariance) < tolerance
