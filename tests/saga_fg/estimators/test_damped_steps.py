"""Graphs on which full steps overshoot, and graphs that nothing settles: damped steps, and results that say so."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from factors import ResidualFactors, Vector, gaussian_factor, residual_factor
from pipelines.explaining import story
from pipelines.serving.messages import tracks_message
from saga_fg import ConstantVelocity, NodeType, SceneGraph, Tracker, TrackerSettings
from saga_fg.estimators import GraphFilter, IncrementalSmoother, Measurements
from saga_fg.graph import OBJECT, Additions, GraphView, NewVariable
from saga_fg.model.discretisation import discretise
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking.journal import Event, Journal
from saga_fg.types.track import Tracks
from tests.saga_fg.traffic_frames import run, seen, straight

CAR = NodeType("car", ConstantVelocity(0.5))
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
        estimator.predict(discretise(SceneGraph.of([1, 2], CAR, []), 0.1))
        estimator.update(Measurements([1, 2], [[0.1 * k, 0.0], [20 + 0.1 * k, 0.0]], H, R))
        estimator.set_frame(None, np.zeros(2))
        estimator.ask_providers()
    return estimator


def test_damped_steps_settle_what_full_steps_jump_over() -> None:
    smoother = IncrementalSmoother([Squares()], lag=None)
    smoother.step(0.0)
    assert smoother.unsettled == frozenset()
    assert smoother.solution().converged
    a, b = (smoother.state(key)[0] for key in sorted(smoother.graph().variables))  # type: ignore[index]
    assert 2 * a * (a**2 + 1) + (a - 0.3) / 4 == pytest.approx(0.0, abs=1e-3)
    assert b == pytest.approx(7.5, abs=1e-6)


def test_only_the_variables_that_still_move_have_not_settled(caplog: pytest.LogCaptureFixture) -> None:
    estimator = filtered(Uphill([1]))
    assert estimator.unsettled.tolist() == [1]
    smoother = estimator._smoother
    assert {smoother.graph().variables[key].id for key in smoother.unsettled} == {1}
    assert not smoother.solution().converged
    assert "has not settled" in caplog.text
    assert estimator.mean([2])[0, 0] == pytest.approx(20.3, abs=0.1)
    assert abs(estimator.mean([1])[0, 0]) < 1  # at the best point, not where another step led


@pytest.mark.parametrize("lag", [0.0, 0.25])
def test_what_has_not_settled_is_not_better_known_than_predicted(lag: float) -> None:
    provider = Uphill([1])
    estimator = filtered(provider, lag=lag)
    later = discretise(SceneGraph.of([1, 2], CAR, []), 0.1)
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


@pytest.mark.parametrize("lag", [0.0, 0.25])
def test_the_graph_has_what_has_not_settled_where_the_filter_has_it(lag: float) -> None:
    estimator = filtered(Uphill([1]), lag=lag)
    graph = estimator.graph()
    newest = graph.of(OBJECT, graph.epoch)
    assert len(estimator._independent.layout.nodes) == 1
    for node in (1, 2):
        np.testing.assert_allclose(graph.state(newest[node].key), estimator.mean([node])[0], atol=1e-9)
    latest = estimator.smoothed()[-1]
    np.testing.assert_allclose(latest.x.mean, estimator.mean([1, 2]).ravel(), atol=1e-9)


def test_a_restored_filter_says_the_same() -> None:
    estimator = filtered(Uphill([1]))
    state = pickle.loads(pickle.dumps(estimator.snapshot()))
    other = GraphFilter([Uphill([1])])
    other.restore(state)
    assert other.unsettled.tolist() == estimator.unsettled.tolist() == [1]
    np.testing.assert_allclose(other.covariance([1, 2]), estimator.covariance([1, 2]), rtol=1e-9)


def test_a_track_that_has_settled_again_says_so() -> None:
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
    return run(tracker, seen(np.random.default_rng(0), truth, 0.1 * np.arange(6)))


def test_tracks_and_journal_say_which_have_not_settled() -> None:
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
