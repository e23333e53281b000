"""One engine behind all estimators: the same answers, its tolerances and its steps."""

import copy
import pickle
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
import pytest

from factors import ResidualFactors, Vector, gaussian_factor, residual_factor
from factors.gaussian import native_factor
from pipelines.explaining import story
from pipelines.serving.messages import tracks_message
from saga_fg import Edges, InputError, NodeType, SceneGraph, Tracker, TrackerSettings
from saga_fg.conformance.programs import CAR, random_graph, random_program, run
from saga_fg.estimators import GraphFilter, IncrementalSmoother, JointKalmanFilter, Measurements, filtering
from saga_fg.graph import OBJECT, Additions, GraphView, NewVariable
from saga_fg.model.discretisation import discretise
from saga_fg.model.motion import ConstantVelocity
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking.journal import Event, Journal
from saga_fg.types.track import Tracks
from tests.saga_fg.estimator_scenario import Textbook, assert_newest, random_covariance, tell
from tests.saga_fg.traffic_frames import run as damped_run
from tests.saga_fg.traffic_frames import seen as damped_seen
from tests.saga_fg.traffic_frames import straight

JOINT_STEPS = (filtering.predict, filtering.corrected)


def replace_everywhere(monkeypatch, functions, by):
    """Put `by(function)` in the place of functions, wherever saga_fg has imported them."""
    for module in [module for name, module in sys.modules.items() if name.startswith("saga_fg")]:
        for name, value in list(vars(module).items()):
            if any(value is function for function in functions):
                monkeypatch.setattr(module, name, by(value))


def seen(rng, nodes):
    return Measurements(nodes, rng.normal(size=(len(nodes), 2)), np.eye(2, 4), 0.1 * np.eye(2))


@pytest.mark.parametrize("lag", [0.0, 1.0])
def test_objects_alone_take_the_steps_of_the_kalman_filter(lag, monkeypatch):
    """The same functions, as often, to the same bits; iSAM2 holds nothing."""
    calls, apart = Counter(), []
    program = random_program(np.random.default_rng(4), density=0.0)

    def count(function):
        def counted(*arguments):
            calls[function.__name__] += 1
            return function(*arguments)

        return counted

    replace_everywhere(monkeypatch, JOINT_STEPS, count)
    for estimator in (JointKalmanFilter(), GraphFilter(lag=lag)):
        calls.clear()
        apart.append((run(program, estimator)[0], dict(calls)))
    (kalman, its), (graph, mine) = apart
    assert its == mine
    assert min(its.values()) > 3
    np.testing.assert_array_equal(graph.joint_mean(kalman.nodes), kalman.joint_mean(kalman.nodes))
    np.testing.assert_array_equal(graph.joint_covariance(kalman.nodes), kalman.joint_covariance(kalman.nodes))
    assert len(graph._smoother.graph().variables) == 0


@pytest.mark.parametrize(("lag", "late"), [(0.0, False), (1.0, False), (1.0, True)])
def test_an_object_passes_to_isam2_and_back(lag, late):
    """An edge comes and goes, the correlation that it leaves decays, and it comes again: the textbook's all along."""
    rng, textbook, estimator, held = np.random.default_rng(8), Textbook(), GraphFilter(lag=lag), []
    nodes, eye = [1, 2, 3], np.eye(4)[None]
    apart = SceneGraph.of(nodes, CAR)
    tied = SceneGraph.of(nodes, CAR, [Edges("tie", [0], [1], [0.5], -eye, eye, np.zeros((1, 4)))])
    prior = [("add", nodes, rng.normal(size=(3, 4)), random_covariance(rng, 3, 4))]
    tell(textbook, prior), tell(estimator, prior)
    for graph, frames in ((apart, 3), (tied, 4), (apart, 45), (tied, 2)):
        for frame in range(frames):
            exact = Measurements(nodes, rng.normal(size=(3, 4)), np.eye(4), 0.01 * np.eye(4))
            calls = [("predict", discretise(graph, 0.2)), ("update", exact, None)]
            if late and frame % 3 == 1:
                calls.append(("update", seen(rng, [int(rng.choice(nodes))]), textbook.steps[-1].time + 0.1))
            for call in calls:
                tell(textbook, [call]), tell(estimator, [call])
            assert_newest(estimator, textbook)
        held.append(len(estimator._keys))
    assert held == [0, 2, 0, 2]


def test_little_noise_beside_large_variances_costs_no_digits():
    """Acceleration noise of 1e-10 m^2/s^3 over 10 ms: information matrices have nothing left, moments all."""
    quiet = NodeType("quiet", ConstantVelocity(acceleration_noise=1e-10))
    eye, rng = np.eye(4)[None], np.random.default_rng(5)
    tie = Edges("tie", [0], [1], [0.5], -eye, eye, np.zeros((1, 4)))
    textbook, estimator = Textbook(), GraphFilter(lag=1.0)
    calls = [("add", [1, 2], 1e3 * rng.normal(size=(2, 4)), np.tile(100 * np.eye(4), (2, 1, 1)))]
    for _ in range(20):
        calls.append(("predict", discretise(SceneGraph.of([1, 2], quiet, [tie]), 0.01)))
        calls.append(("update", Measurements([1, 2], 1e3 + rng.normal(size=(2, 2)), np.eye(2, 4), 0.01 * np.eye(2))))
    tell(textbook, calls), tell(estimator, calls)
    assert_newest(estimator, textbook)


def running(rng, leaving=()):
    """After two intervals with measurements; some nodes leave at the end."""
    estimator = GraphFilter()
    estimator.add(range(4), rng.normal(size=(4, 4)), random_covariance(rng, 4, 4))
    for _ in range(2):
        estimator.predict(discretise(random_graph(rng, (CAR,) * 4, range(4), density=0.7), 0.3))
        estimator.update(seen(rng, [0, 1, 3]))
    estimator.marginalise(leaving)
    return estimator


def content(graph):
    """Epoch and time, and every factor with its variables."""
    every = [(one.provider, one.kind, [str(variable) for variable in one.variables]) for one in graph.factors()]
    return graph.epoch, graph.time, sorted(every)


def test_a_snapshot_leaves_the_graph_as_it_is(subtests):
    for stored in [lambda one: None, pickle.dumps, copy.deepcopy]:
        with subtests.test(stored=stored):
            estimator, resumed = running(np.random.default_rng(0), leaving=[2]), GraphFilter()
            before = content(estimator.graph())
            resumed.restore(estimator.snapshot())
            stored(estimator)
            assert content(estimator.graph()) == content(resumed.graph()) == before
            estimator.predict(discretise(SceneGraph.of([0, 1, 3], CAR), 0.0))  # no time at all
            assert content(estimator.graph()) == before


class TreeWithoutDigits:
    """An iSAM2 whose query fails, or whose clique has pivots that have rounded to zero."""

    def __init__(self, isam, failure):
        self.isam, self.failure, self.asked = isam, failure, 0

    def __getattr__(self, name):
        return getattr(self.isam, name)

    def jointBayesNet(self, keys, take):
        self.asked += 1
        if self.failure == "error":
            raise RuntimeError("indeterminate")
        clique = gtsam.GaussianFactorGraph()
        n = 4 * len(keys)
        clique.push_back(native_factor(keys, [4] * len(keys), np.zeros((n, n + 1), order="F")))
        take(clique, gtsam.Ordering())


@pytest.mark.parametrize("failure", ["error", "zero"])
def test_where_the_tree_has_too_few_digits_the_posterior_is_eliminated_anew(failure):
    expected = running(np.random.default_rng(4)).joint_covariance(range(4))
    twin = running(np.random.default_rng(4))
    engine = twin._smoother._ready()
    engine.isam, twin._posterior, twin._tied = TreeWithoutDigits(engine.isam, failure), None, None
    np.testing.assert_allclose(twin.joint_covariance(range(4)), expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert engine.isam.asked == 1


# The joint filter with a tolerance: weak ties are inputs, what hardly correlates is apart, strong ties stay


def chain(rates):
    """Node k + 1 takes over the velocity of node k at rates[k], 1/s."""
    n, m = len(rates) + 1, len(rates)
    A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (m, 1, 1))
    edges = Edges("shared velocity", np.arange(1, n), np.arange(m), np.array(rates), -A, A, np.zeros((m, 4)))
    return SceneGraph.of(np.arange(n), CAR, [edges])


def filters(n, tolerance):
    rng = np.random.default_rng(n)
    means = rng.normal(scale=5.0, size=(n, 4))
    found = JointKalmanFilter(), JointKalmanFilter(tolerance=tolerance)
    for estimator in found:
        estimator.add(np.arange(n), means, np.tile(np.diag([0.3, 0.3, 1.0, 1.0]), (n, 1, 1)))
    return found


def size_of_components(estimator):
    return np.bincount(estimator.posterior().partition.label).tolist()


def test_weak_ties_are_inputs_and_strong_ones_kept_whole():
    exact, close = filters(2, 0.02)
    transition = discretise(chain([0.05]), 0.1)
    for estimator in (exact, close):
        estimator.predict(transition)
    assert size_of_components(exact) == [2]
    assert size_of_components(close) == [1, 1]
    np.testing.assert_allclose(close.mean([0, 1]), exact.mean([0, 1]), atol=1e-12)
    np.testing.assert_allclose(close.covariance([0, 1]), exact.covariance([0, 1]), atol=1e-12)
    exact, close = filters(2, 0.02)
    for estimator in (exact, close):
        estimator.predict(discretise(chain([2.0]), 0.5))
    np.testing.assert_allclose(close.joint_covariance([0, 1]), exact.joint_covariance([0, 1]), atol=1e-12)


@pytest.mark.parametrize(("tolerance", "apart"), [(0.005, False), (0.02, True), (0.05, True)])
def test_long_runs_stay_near_the_exact_filter_and_their_covariances_hold(tolerance, apart):
    """Ties of many strengths come and go; errors are a few times the tolerance, in standard deviations."""
    rng, n = np.random.default_rng(3), 24
    exact, close = filters(n, tolerance)
    errors = []
    for _ in range(40):
        rates = np.where(rng.random(n - 1) < 0.5, rng.uniform(0.0, 0.3, n - 1), 0.0)
        transition = discretise(chain(rates), 0.2)
        seen = np.flatnonzero(rng.random(n) < 0.8)
        z = exact.mean(seen)[:, :2] + rng.normal(scale=0.3, size=(len(seen), 2))
        for estimator in (exact, close):
            estimator.predict(transition)
            estimator.update(Measurements(seen, z, np.eye(2, 4), 0.1 * np.eye(2)))
        P = close.covariance(np.arange(n))
        assert (np.linalg.eigvalsh(P) > 0).all()
        sigma = np.sqrt(np.diagonal(exact.covariance(np.arange(n)), axis1=1, axis2=2))
        errors.append((close.mean(np.arange(n)) - exact.mean(np.arange(n))) / sigma)
    assert np.sqrt(np.mean(np.square(errors))) < 2 * tolerance
    assert (len(size_of_components(close)) > len(size_of_components(exact))) == apart


def test_a_tolerance_that_is_no_correlation_is_refused(subtests):
    for bad in [-0.1, 1.0, np.nan]:
        with subtests.test(bad=bad), pytest.raises(InputError, match="tolerance"):
            JointKalmanFilter(tolerance=bad)


def test_components_keep_to_their_size_and_the_strongest_ties():
    """Of a chain of six every second tie is weaker: pairs go by the others."""
    close = JointKalmanFilter(max_component=2)
    close.add(np.arange(6), np.zeros((6, 4)), np.tile(np.eye(4), (6, 1, 1)))
    close.predict(discretise(chain([2.0, 0.5, 2.0, 0.5, 2.0]), 0.2))
    P = close.joint_covariance(np.arange(6)).reshape(6, 4, 6, 4)
    tied = np.abs(P).max(axis=(1, 3)) > 0
    np.testing.assert_array_equal(tied, np.kron(np.eye(3), np.ones((2, 2))))


# Graphs on which full steps overshoot, and graphs that nothing settles: damped steps, and results that say so

DAMPED_CAR = NodeType("car", ConstantVelocity(0.5))
H, R = np.eye(2, 4), 0.01 * np.eye(2)


@dataclass
class Uphill:
    """x = 5, with a Jacobian of the wrong sign: every step leads away, and the shorter it is, the less."""

    nodes: Sequence[int]
    until: float = np.inf
    name: str = "uphill"
    asked: list[float] = field(default_factory=list)

    def factors(self, view: GraphView) -> Additions:
        self.asked.append(view.time)
        now = view.now(OBJECT)
        mine = [now[node] for node in self.nodes if node in now and view.time <= self.until]
        return Additions(factors=[self._factor(one.key, one.dim) for one in mine])

    def _factor(self, key: int, dim: int) -> ResidualFactors:
        return residual_factor((key,), (Vector(dim),), self._residual, 1e-4 * np.eye(1), self._jacobian)

    def _residual(self, x: FloatArray) -> FloatArray:
        return x[:1] - 5.0

    def _jacobian(self, x: FloatArray) -> list[FloatArray]:
        return [-np.eye(1, len(x))]


class Squares:
    """x^2 = -1 with a weak prior of 0.3, between whose sides full steps jump; and a variable apart from that."""

    name = "squares"

    def factors(self, view: GraphView) -> Additions:
        if view.epoch:
            return Additions()
        a, b = view.key(OBJECT, 1), view.key(OBJECT, 2)
        new = [NewVariable(OBJECT, 1, np.array([1.0])), NewVariable(OBJECT, 2, np.array([7.0]))]
        one = np.eye(1)
        square = residual_factor((a,), (Vector(1),), lambda x: x**2 + 1, one)
        cosine = residual_factor((b,), (Vector(1),), lambda x: np.sin(x - 7.5), one)
        return Additions(new, [square, gaussian_factor([a], [one], [0.3], 4 * one), cosine])


def filtered(provider: Uphill, steps: int = 3, lag: float = 0.0) -> GraphFilter:
    """Two cars apart from each other, 1 at 0 m and 2 at 20 m, both seen in every frame."""
    estimator = GraphFilter([provider], lag)
    estimator.add([1, 2], [[0.0, 0, 1, 0], [20.0, 0, 1, 0]], np.stack([np.diag([1.0, 1.0, 0.5, 0.5])] * 2))
    for k in range(1, steps + 1):
        estimator.predict(discretise(SceneGraph.of([1, 2], DAMPED_CAR, []), 0.1))
        estimator.update(Measurements([1, 2], [[0.1 * k, 0.0], [20 + 0.1 * k, 0.0]], H, R))
        estimator.set_frame(None, np.zeros(2))
        estimator.ask_providers()
    return estimator


def test_damped_steps_settle_what_full_steps_jump_over():
    smoother = IncrementalSmoother([Squares()], lag=None)
    smoother.step(0.0)
    assert smoother.unsettled == frozenset()
    assert smoother.solution().converged
    a, b = (smoother.state(key)[0] for key in sorted(smoother.graph().variables))  # type: ignore[index]
    assert 2 * a * (a**2 + 1) + (a - 0.3) / 4 == pytest.approx(0.0, abs=1e-3)
    assert b == pytest.approx(7.5, abs=1e-6)


def test_only_the_variables_that_still_move_have_not_settled(caplog):
    estimator = filtered(Uphill([1]))
    assert estimator.unsettled.tolist() == [1]
    smoother = estimator._smoother
    assert {smoother.graph().variables[key].id for key in smoother.unsettled} == {1}
    assert not smoother.solution().converged
    assert "has not settled" in caplog.text
    assert estimator.mean([2])[0, 0] == pytest.approx(20.3, abs=0.1)
    assert abs(estimator.mean([1])[0, 0]) < 1  # at the best point, not where another step led


@pytest.mark.parametrize("lag", [0.0, 0.25])
def test_what_has_not_settled_is_not_better_known_than_predicted(lag):
    provider = Uphill([1])
    estimator = filtered(provider, lag=lag)
    later = discretise(SceneGraph.of([1, 2], DAMPED_CAR, []), 0.1)
    estimator.predict(later)
    predicted = estimator.joint_covariance([1, 2])
    estimator.update(Measurements([1, 2], [[0.4, 0.0], [20.4, 0.0]], H, R))
    estimator.ask_providers()
    assert estimator.unsettled.tolist() == [1]
    reported = estimator.joint_covariance([1, 2])
    assert np.linalg.eigvalsh((reported - predicted)[:4, :4])[0] > -1e-9
    assert np.linalg.eigvalsh(reported)[0] > 0
    assert reported[4, 4] < 0.8 * predicted[4, 4]  # the other one is measured as ever
    _, P = estimator.planar_marginals([1], np.array([[0, 1, 2, 3]]))
    np.testing.assert_allclose(P[0], reported[:4, :4])


def test_what_has_settled_is_said_again_and_after_a_restart():
    estimator = filtered(Uphill([1]))
    state = pickle.loads(pickle.dumps(estimator.snapshot()))
    other = GraphFilter([Uphill([1])])
    other.restore(state)
    assert other.unsettled.tolist() == estimator.unsettled.tolist() == [1]
    np.testing.assert_allclose(other.covariance([1, 2]), estimator.covariance([1, 2]), rtol=1e-9)
    estimator = filtered(Uphill([1], until=0.1), steps=1)
    assert estimator.unsettled.tolist() == [1]
    estimator.marginalise([1])
    assert estimator.unsettled.tolist() == []
    assert filtered(Uphill([]), steps=5).unsettled.tolist() == []


def tracked(estimator: str, events: list[Event]) -> list[Tracks]:
    """Two cars; the factor is on the first track."""
    settings = TrackerSettings(estimator=estimator)
    tracker = Tracker(settings, observer=Journal(settings, events.append), providers=[Uphill([1])])
    truth = straight([[10.0, 0.0], [10.0, 30.0]], [[5.0, 0.0], [5.0, 0.0]])
    return damped_run(tracker, damped_seen(np.random.default_rng(0), truth, 0.1 * np.arange(6)))


def test_tracks_and_journal_say_which_have_not_settled():
    events: list[Event] = []
    last = tracked("isam2", events)[-1]
    assert dict(zip(last.id.tolist(), last.settled.tolist(), strict=True))[1] is False
    assert last.settled.sum() == len(last) - 1
    assert [track.settled for track in last] == last.settled.tolist()
    assert last.select(last.settled).settled.all()
    told = [event for event in events if event["event"] == "unsettled"]
    assert told
    assert {event["track"] for event in told} == {1}
    lines = story([event | {"scene": "a"} for event in events if event.get("track") == 1])
    assert any("not settled: the solver found no minimum" in line for line in lines)
    message = tracks_message(last)["tracks"]
    assert [row["id"] for row in message if row.get("settled") is False] == [1]
