"""A scene as a factor graph, and parts of the model that one file adds."""

import importlib
import pickle
import sys
import textwrap

import gtsam
import numpy as np
import pytest

from factors import (
    SolverSettings,
    Vector,
    gaussian_factor,
    interaction_factor,
    marginal_moments,
    pose_prior_factor,
    prior_factor,
    relative_factors,
)
from factors.manifolds import central_differences
from saga_fg import ConstantVelocity, Detection, Detections, Frame, NodeType, SceneGraph, Tracker, TrackerSettings
from saga_fg.estimators import (
    BatchSolver,
    GraphFilter,
    IncrementalSmoother,
    JointKalmanFilter,
    Observations,
    RelinearisationSettings,
)
from saga_fg.graph import (
    EGO_POSE,
    LANDMARK,
    OBJECT,
    Additions,
    GraphError,
    NewVariable,
    SceneFactorGraph,
    VariableKind,
    key_of,
)
from saga_fg.graph.variables import KINDS, LARGEST, described
from saga_fg.model.discretisation import discretise
from tests.saga_fg.sampled_traffic import providers, sample_traffic


class Once:
    """Adds something in the first frame, and nothing later."""

    def __init__(self, additions, name="once"):
        self.additions, self.name, self.asked = additions, name, []

    def factors(self, view):
        self.asked.append(view)
        return self.additions if len(self.asked) == 1 else Additions()


def test_keys_in_words_and_those_that_are_none():
    assert described(key_of(OBJECT, 12, 34)) == "object 12 of epoch 34"
    assert described(key_of(LANDMARK, 3, None)) == "landmark 3"
    assert described(17) == "variable 17"
    assert described(key_of(VariableKind("beacon", "B"), 0, LARGEST)) == f"variable B 0 of epoch {LARGEST}"
    numbers, epochs = (0, 1, LARGEST), (0, 1, LARGEST, None)
    every = {key_of(kind, number, epoch) for kind in KINDS for number in numbers for epoch in epochs}
    assert len(every) == len({described(key) for key in every}) == len(KINDS) * 12
    for number in (-1, LARGEST + 1, 1.5, True):
        with pytest.raises(GraphError, match="object: expected id to be a whole number"):
            key_of(OBJECT, number, 0)
    with pytest.raises(GraphError, match="expected one letter"):
        VariableKind("wall", "wa")


def driven(lag=None, frames=6, seed=2):
    scene = sample_traffic(np.random.default_rng(seed), frames=frames, cars=3, pedestrians=2)
    smoother = IncrementalSmoother(providers(scene), lag=lag)
    for moment in scene.frames[:-1]:
        smoother.step(moment.time)
    return scene, smoother


@pytest.mark.parametrize("lag", [None, 0.3])
def test_a_pickled_graph_goes_on_as_the_smoother_itself(lag):
    scene, smoother = driven(lag)
    again = IncrementalSmoother(providers(scene), lag=lag)
    again.restore(pickle.loads(pickle.dumps(smoother.snapshot())))
    for one in (smoother, again):
        one.step(scene.frames[-1].time)
    assert again.graph().variables.keys() == smoother.graph().variables.keys()
    for key, variable in smoother.graph().variables.items():
        P = smoother.covariance(key)
        way = variable.type.local(smoother.state(key), again.state(key))
        assert np.abs(way / np.sqrt(np.diag(P))).max() < 2e-3
        np.testing.assert_allclose(again.covariance(key), P, rtol=0.02, atol=1e-3 * np.abs(P).max())


def test_relinearisation_of_a_large_component_has_the_marginals_that_one_by_one_has(monkeypatch):
    def informations(large):
        monkeypatch.setattr("saga_fg.estimators.isam2_engine._LARGE", large)
        _, smoother = driven(lag=0.3)
        points = smoother._engine.points
        return {key: R.T @ R for key, R in zip(points._keys, points._root, strict=False)}

    together, one_by_one = informations(1), informations(10**6)
    assert together.keys() == one_by_one.keys()
    assert len(together) > 5
    for key, information in together.items():
        assert information.any()
        np.testing.assert_allclose(information, one_by_one[key], rtol=1e-3, atol=1e-3 * np.abs(information).max())


def test_a_snapshot_does_not_change_when_the_smoother_goes_on():
    scene, smoother = driven(0.3)
    snapshot, solution = smoother.snapshot(), smoother.solution()
    key = next(key for key, one in snapshot.variables.items() if one.kind == EGO_POSE)
    names, pose = [str(factor) for factor in snapshot.factors()], snapshot.state(key)
    P = solution.covariance([key])
    smoother.step(scene.frames[-1].time)
    assert [str(factor) for factor in snapshot.factors()] == names
    assert snapshot.state(key).equals(pose, 0.0)
    np.testing.assert_array_equal(solution.covariance([key]), P)
    np.testing.assert_allclose(solution.marginal(key), P, rtol=1e-6)


def test_the_graph_is_the_one_that_runs():
    """Factor for factor what iSAM2 holds, by name; and its minimum is the estimate."""
    _, smoother = driven()
    graph = smoother.graph()
    assert sum(1 for _ in graph.factors()) == sum((slots >= 0).sum() for slots in smoother._engine.slots.values())
    text = [str(factor) for factor in graph.factors()]
    assert "PriorFactorPose2 on vehicle 0 at 0.00 s (provider odometry)" in text
    assert any(text.startswith("SmoothDriver interactions on car 1 at ") for text in text)
    before = graph.values
    solution = graph.copy().solve(SolverSettings(tolerance=1e-8))
    for key, variable in graph.variables.items():
        sigma = np.sqrt(np.diag(smoother.covariance(key)))
        way = variable.type.local(variable.type.read(before, key), variable.type.read(solution.values, key))
        assert np.abs(way / sigma).max() < 1e-3


def test_covariances_are_those_of_levenberg_marquardt_in_gtsams_coordinates():
    """Poses among them, which have moved away from their base."""
    _, smoother = driven()
    solution = smoother.graph().copy().solve(SolverSettings(tolerance=1e-8))
    keys = list(smoother.graph().variables)[-6:]
    expected = marginal_moments(solution.linear, keys, "qr")[1]
    np.testing.assert_allclose(smoother.joint_covariance(keys), expected, rtol=1e-2, atol=1e-4 * np.abs(expected).max())
    for key in keys:
        (start,) = (sum(smoother.graph().variable(k).dim for k in keys[: keys.index(key)]),)
        own = expected[start : start + smoother.graph().variable(key).dim][
            :, start : start + smoother.graph().variable(key).dim
        ]
        np.testing.assert_allclose(smoother.covariance(key), own, rtol=1e-2, atol=1e-4 * np.abs(own).max())
        np.testing.assert_allclose(solution.marginal(key), own, rtol=1e-6, atol=1e-9)


def test_a_pose_far_from_its_base_is_where_its_factors_say():
    """Half a turn and metres off its first value: the increments' coordinates are bent there."""
    far = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, -0.3, 2.0), np.array([3.0, -2.0, 1.0]))
    P = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]) ** 2
    key = key_of(EGO_POSE, 0, 0)
    new = NewVariable(EGO_POSE, 0, gtsam.Pose3())
    smoother = IncrementalSmoother([Once(Additions([new], [pose_prior_factor(key, far.matrix(), P)]))])
    smoother.step(0.0)
    assert smoother.state(key).equals(far, 1e-9)  # type: ignore[attr-defined]
    np.testing.assert_allclose(smoother.covariance(key), P, atol=1e-8)


def test_a_filter_knows_its_interval_when_it_is_extended():
    """The epoch before has left by then."""
    smoother, later = IncrementalSmoother(lag=0.0), Once(Additions())
    for time in (1.0, 1.5):
        smoother.step(time)
    smoother.extend([later])
    assert later.asked[0].dt == 0.5


def test_factors_under_a_name_take_each_others_place():
    key = key_of(OBJECT, 1, 0)
    near, far = (prior_factor(key, [x], [[1.0]]) for x in (1.0, 5.0))
    smoother = IncrementalSmoother(lag=None)
    smoother.step(0.0, [Once(Additions([NewVariable(OBJECT, 1, np.zeros(1))], [near], {"more": [near]}), "a")])
    assert smoother.state(key) == pytest.approx([1.0])
    smoother.extend([Once(Additions(named={"more": [far]}), "b")])  # another provider's name is another name
    assert smoother.state(key) == pytest.approx([7 / 3])
    smoother.extend([Once(Additions(named={"more": [far]}), "a")])
    assert smoother.state(key) == pytest.approx([11 / 3])
    smoother.extend([Once(Additions(named={"more": []}), "a"), Once(Additions(named={"more": []}), "b")])
    assert smoother.state(key) == pytest.approx([1.0])
    assert sum(1 for _ in smoother.graph().factors()) == 1


def test_what_leaves_stays_in_what_it_told_of_others():
    graph = SceneFactorGraph()
    graph.advance(0.0)
    a, b = graph.add_variables("test", [NewVariable(OBJECT, n, np.zeros(2)) for n in (1, 2)])
    factors = [prior_factor(a, [1.0, 2.0], np.eye(2)), gaussian_factor([a, b], [np.eye(2), -np.eye(2)], [3.0, 0.0])]
    graph.add_factors("test", [*factors, prior_factor(b, np.zeros(2), np.eye(2))])
    expected = graph.copy().solve()
    graph.marginalise([a])
    assert list(graph.variables) == [b]
    found = graph.solve()
    np.testing.assert_allclose(found.values.atVector(b), expected.values.atVector(b), atol=1e-9)
    np.testing.assert_allclose(found.covariance([b]), expected.covariance([b]), atol=1e-9)
    assert [factor.kind for factor in graph.factors()] == ["linear factor", "marginal"]
    with pytest.raises(GraphError, match="object 1 of epoch 0 is not in the graph"):
        graph.marginalise([a])


def test_providers_see_what_is_there():
    new = NewVariable(OBJECT, 1, np.ones(2), label="car")
    static = NewVariable(LANDMARK, 4, np.zeros(2), static=True)
    keys = key_of(OBJECT, 1, 0), key_of(LANDMARK, 4, None)
    first = Once(Additions([new, static], [prior_factor(key, np.ones(2), 4 * np.eye(2)) for key in keys]))
    smoother, later = IncrementalSmoother([first], lag=None), Once(Additions())
    smoother.step(1.0)
    smoother.step(1.5)
    smoother.extend([later])
    (view,) = later.asked
    assert (view.epoch, view.time, view.dt) == (1, 1.5, 0.5)
    assert view.now(OBJECT) == {}
    assert [str(one) for one in (*view.before(OBJECT).values(), *view.static(LANDMARK).values())] == [
        "car 1 at 1.00 s",
        "landmark 4",
    ]
    assert set(view.variables) == set(keys)
    assert view.state(keys[0]).tolist() == [1.0, 1.0]
    np.testing.assert_allclose(view.covariance(keys[0]), 4 * np.eye(2))


def test_a_threshold_of_nothing_is_a_filter_that_never_linearises_anew():
    """Relinearisation is therefore needed for the equality with Levenberg-Marquardt."""
    scene = sample_traffic(np.random.default_rng(2), frames=6, cars=3, pedestrians=2)
    once = IncrementalSmoother(providers(scene), None, RelinearisationSettings(threshold=1e9))
    _, smoother = driven()
    for moment in scene.frames[:-1]:
        once.step(moment.time)
    off = [
        np.abs(one.type.local(smoother.state(key), once.state(key)) / np.sqrt(np.diag(smoother.covariance(key)))).max()
        for key, one in smoother.graph().variables.items()
    ]
    assert max(off) > 0.01


# A factor, a sensor model and an interaction of one's own are one new file each, which nothing else has to know

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
    "make", [JointKalmanFilter, GraphFilter, lambda: GraphFilter(lag=1.0)], ids=["kalman", "isam2", "fixed-lag"]
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
        tracker = Tracker(TrackerSettings(estimator=estimator, edges=rules))
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
