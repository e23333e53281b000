"""A factor, a sensor model and an interaction of one's own are one new file each, which nothing else has to know."""

import importlib
import sys
import textwrap

import gtsam
import numpy as np
import pytest

from factors import Vector, interaction_factor, prior_factor, relative_factors
from factors.manifolds import central_differences
from saga_fg import ConstantVelocity, Detection, Detections, Frame, NodeType, SceneGraph, Tracker, TrackerSettings
from saga_fg.estimators import (
    BatchSolver,
    GraphFilter,
    IncrementalSmoother,
    JointKalmanFilter,
    Observations,
)
from saga_fg.graph import OBJECT, Additions, NewVariable
from saga_fg.model.discretisation import discretise

FACTOR = '''
"""A wall at y = 4 that objects keep off, r = exp(y - 4), and the provider that adds it."""

from dataclasses import dataclass

import numpy as np

from factors import ResidualFactors
from saga_fg.graph import OBJECT, Additions


def wall_factors(rows, state_dim, variance):
    def residual(x):
        return np.exp(x[:, 1:2] - 4.0)

    def jacobians(x):
        J = np.zeros((len(x), 1, state_dim))
        J[:, :, 1] = residual(x)
        return [J]

    return ResidualFactors(rows, (state_dim,), residual, variance * np.eye(1), jacobians, name="keeps off the wall")


@dataclass(frozen=True)
class Wall:
    name: str = "wall"

    def factors(self, view):
        objects = list(view.now(OBJECT).values())
        return Additions(factors=[wall_factors([[one.key]], one.dim, 0.01) for one in objects])
'''

SENSOR = '''
"""A sonar that measures the logarithm of the range."""

import numpy as np


class LogRange:
    name, dim, angles = "log range", 1, ()

    def __init__(self, state_dim):
        self.state_dim = state_dim

    def predict(self, x):
        return np.log(np.hypot(x[..., 0], x[..., 1]))[..., None]

    def jacobian(self, x):
        J = np.zeros((*x.shape[:-1], 1, self.state_dim))
        J[..., 0, :2] = x[..., :2] / (x[..., :2] ** 2).sum(axis=-1, keepdims=True)
        return J
'''

INTERACTION = '''
"""Trailers that are towed by trucks: the velocity of the one pulls the other's; and the rule that draws the edges."""

from dataclasses import dataclass

import numpy as np

from saga_fg.model.edge_rules import Pairs
from saga_fg.model.interactions import SharedVelocity


@dataclass(frozen=True)
class Towed(SharedVelocity):
    """Shared velocity, of any classes."""


@dataclass(frozen=True)
class Towing:
    interaction: Towed = Towed()

    def pairs(self, nodes):
        trailers, trucks = np.flatnonzero(nodes.label == "trailer"), np.flatnonzero(nodes.label == "truck")
        if not len(trailers) * len(trucks):
            return Pairs(trailers[:0], trucks[:0], np.empty(0))
        return Pairs(trailers[:1], trucks[:1], np.array([5.0]))
'''


@pytest.fixture
def new_file(tmp_path, monkeypatch):
    """Write a module and import it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    names = []

    def write(name, text):
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(text))
        names.append(name)
        return importlib.import_module(name)

    yield write
    for name in names:
        sys.modules.pop(name, None)


class Track:
    """An object with a prior, which goes on by constant velocity."""

    name = "track"

    def factors(self, view):
        key, before = view.key(OBJECT, 1), view.before(OBJECT)
        if not before:
            start = np.array([0.0, 3.5, 1.0, 1.0])
            return Additions([NewVariable(OBJECT, 1, start)], [prior_factor(key, start, np.eye(4))])
        F, last = np.eye(4) + 0.1 * np.eye(4, k=2), before[1].key
        moved = interaction_factor(key, [last], [F], np.zeros(4), 0.1 * np.eye(4))
        return Additions([NewVariable(OBJECT, 1, F @ view.state(last))], [moved])


def test_a_factor(new_file):
    """Its Jacobians are its derivatives, every back end takes it, GTSAM's optimiser agrees, the tracker by its name."""
    module = new_file("own_wall", FACTOR)
    x = np.array([[1.0, 3.0, 0.5, -0.5], [0.0, 4.5, 1.0, 0.0]])
    made = module.wall_factors([[1], [2]], 4, 0.01)
    numerical = central_differences(made.residual, [x], [Vector(4)])
    np.testing.assert_allclose(made.jacobians(x)[0], numerical[0], atol=1e-7)
    found = []
    for estimator in (IncrementalSmoother([Track(), module.Wall()], lag=None), BatchSolver([Track(), module.Wall()])):
        for k in range(5):
            estimator.step(0.1 * k)
        graph = estimator.graph()
        (newest,) = graph.of(OBJECT, 4)
        key = next(iter(graph.of(OBJECT, 4).values())).key
        assert newest == 1
        solved = gtsam.LevenbergMarquardtOptimizer(graph.native(), graph.values).optimize()
        np.testing.assert_allclose(estimator.state(key), solved.atVector(key), atol=1e-3)
        found.append(estimator.state(key))
    assert found[0][1] < 3.9 - 0.2, "without the wall it would be there"
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)

    def tracked(estimator, providers):
        tracker = Tracker(TrackerSettings(estimator=estimator, providers=providers))
        for k in range(10):
            boxes = Detections.of([Detection("pedestrian", (0.1 * k, 3.0 + 0.15 * k, 0.9), score=0.9)])
            tracks = tracker.step(Frame(0.1 * k, "lidar", boxes))
        return tracks[0].position[1]

    for estimator in ("kalman", "isam2", "fixed-lag"):
        assert tracked(estimator, ("own_wall:Wall",)) < tracked(estimator, ()) - 0.02


@pytest.mark.parametrize(
    "make",
    [JointKalmanFilter, GraphFilter, lambda: GraphFilter(lag=1.0)],
    ids=["kalman", "isam2", "fixed-lag"],
)
def test_a_sensor_model(new_file, make):
    """Each back end takes in its measurements; the same model is measured from a moving vehicle."""
    module = new_file("own_sonar", SENSOR)
    estimator, car = make(), NodeType("car", ConstantVelocity(1.0))
    estimator.add([1], [[10.0, 0.0, 1.0, 0.0]], np.diag([4.0, 0.01, 0.01, 0.01])[None])
    estimator.predict(discretise(SceneGraph.of([1], car), 0.1))
    before = estimator.covariance([1])[0, 0, 0]
    estimator.update(Observations([1], [[np.log(11.0)]], module.LogRange(4), [[1e-4]]))
    assert abs(estimator.mean([1])[0, 0] - 11.0) < 0.1
    assert estimator.covariance([1])[0, 0, 0] < before / 10
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1.0, 2.0, 0.3))
    values.insert(1, np.array([4.0, 6.0, 0.0, 0.0]))
    assert relative_factors([[0, 1]], [[np.log(5.0)]], [[0.01]], 4, model=module.LogRange(2)).error(values) < 1e-20


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_an_interaction(new_file, estimator):
    """A trailer that is not seen any more brakes with its truck."""
    module = new_file("own_towing", INTERACTION)

    def position(rules):
        tracker = Tracker(TrackerSettings(estimator=estimator), rules=rules)
        x, speed = 0.0, 10.0
        for k in range(30):
            speed -= 0.4 if k >= 20 else 0.0
            x += 0.1 * speed
            seen = [Detection("truck", (x, 0.0, 1.5), score=0.9)]
            if k < 20:
                seen.append(Detection("trailer", (x - 9.0, 0.0, 1.5), score=0.9))
            tracks = tracker.step(Frame(k / 10, "lidar", Detections.of(seen)))
        (trailer,) = (track for track in tracks if track.label == "trailer")
        return abs(trailer.position[0] - (x - 9.0))

    assert position((module.Towing(),)) < position(()) / 2
