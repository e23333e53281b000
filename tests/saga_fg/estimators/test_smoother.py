"""The smoothers: over all times and over a lag."""

import gtsam
import numpy as np
import pytest

from factors import RangeBearing
from saga_fg import ConstantVelocity, Edges, InputError, NodeType, SceneGraph, UnknownNodeError
from saga_fg.conformance.programs import BUS, CAR, CONE, POLE, Update, random_program
from saga_fg.estimators import GraphFilter, Measurements, Observations, RecordingSmoother, smoother
from saga_fg.graph import OBJECT, key_of
from saga_fg.model.discretisation import discretise
from saga_fg.model.nonlinear_interactions import SocialForce
from saga_fg.model.scene_graph import NonlinearEdges
from tests.saga_fg.estimator_scenario import (
    EXACT,
    Textbook,
    covariance_error,
    mean_error,
    part,
    random_measurements,
    random_scenario,
)
from tests.saga_fg.graph_keys import keys_of

NODES = np.arange(12)


def told(estimator, calls):
    """The estimator after calls, their measurements made in time."""
    for name, *arguments in calls:
        getattr(estimator, name)(*arguments[:1] if name == "update" else arguments)
    return estimator


def assert_textbook(states, textbook):
    steps, _ = textbook.solve()
    assert len(states) == len(steps)
    for state, (time, places, _, reference) in zip(states, steps, strict=True):
        assert state.time == pytest.approx(time, abs=1e-12)
        assert set(state.nodes.tolist()) == set(places)
        for node in state.nodes:
            own = part(reference, places, [node])
            assert mean_error(state.mean([node])[0], own) < EXACT
            assert covariance_error(state.covariance([node])[0], own.covariance) < EXACT


@pytest.mark.parametrize("kinds", [(CAR, BUS), (CAR, POLE, CONE)])
@pytest.mark.parametrize("seed", range(3))
def test_every_state_is_the_textbooks(kinds, seed):
    """New and leaving nodes, which are told of by their neighbours, misses, sensors of several kinds."""
    rng = np.random.default_rng(seed)
    calls = random_scenario(rng, 12, kinds, density=0.15, intervals=(0.02, 0.1, 0.5, 1.2)).calls
    assert_textbook(told(RecordingSmoother(), calls).finish(), told(Textbook(), calls))


def test_marginals_of_nodes_that_part_and_meet_again():
    """A component falls apart when its correlations have decayed; what comes later still tells of before."""
    truth, S = np.array([[0.0, 0, 10, 0], [12.0, 0, 10, 0], [25.0, 0, 10, 0]]), np.diag([0.0, 0.0, 1.0, 1.0])[None]
    calls = [("add", NODES[:3], truth.copy(), np.tile(np.diag([1.0, 1.0, 4.0, 4.0]), (3, 1, 1)))]
    for k in range(100):
        pair = {0: (0, 1), 4: (1, 2)}.get(k // 20)  # 1 follows 2, later 2 follows 3
        edges = [] if pair is None else [Edges("with", [pair[0]], [pair[1]], [0.5], -S, S, np.zeros((1, 4)))]
        truth[:, :2] += 0.5 * truth[:, 2:]
        seen = np.arange(3) if k >= 20 else np.array([0, 2])
        calls.append(("predict", discretise(SceneGraph.of(NODES[:3], CAR, edges), 0.5)))
        calls.append(("update", Measurements(seen, truth[seen, :2], np.eye(2, 4), 0.01 * np.eye(2))))
    assert_textbook(told(RecordingSmoother(), calls).finish(), told(Textbook(), calls))


def run(program, smoother, each=lambda: None):
    for operation in program:
        if isinstance(operation, Update):
            smoother.update(operation.measurements)
        else:
            operation.run(smoother)
        each()
    return smoother


def test_a_long_recording_is_smoothed_in_stretches_to_the_last_digit(monkeypatch):
    program = random_program(np.random.default_rng(5), 60, kinds=(CAR, CONE), intervals=(0.1, 0.2), density=0.2)
    expected = run(program, RecordingSmoother()).finish()
    monkeypatch.setattr(smoother, "MOST_KEPT", 20_000)
    for one, other in zip(run(program, RecordingSmoother()).finish(), expected, strict=True):
        np.testing.assert_array_equal(one.nodes, other.nodes)
        np.testing.assert_array_equal(one.x.mean, other.x.mean)
        np.testing.assert_array_equal(one.x.flat, other.x.flat)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_what_is_final_is_what_the_whole_recording_says(tolerance, monkeypatch):
    monkeypatch.setattr(smoother, "STEP", 1.0)
    monkeypatch.setattr(smoother, "TOLERANCE", tolerance)
    program = random_program(np.random.default_rng(0), 100, kinds=(CAR, CONE), intervals=(0.02, 0.1, 0.2), density=0.2)
    expected, out, held = run(program, RecordingSmoother()).finish(), [], [0]
    windowed = RecordingSmoother(windowed=True)

    def give_out():
        out.extend(windowed.final())
        held.append(len(windowed._epochs))

    run(program, windowed, give_out)
    assert len(out) > 30
    assert max(held) < 90
    assert 0 < windowed.bound <= tolerance
    out += windowed.finish()
    for mine, theirs in zip(out, expected, strict=True):
        assert mine.time == pytest.approx(theirs.time, abs=1e-9)
        assert mine.nodes.tolist() == theirs.nodes.tolist()
        np.testing.assert_allclose(mine.x.mean, theirs.x.mean, rtol=0, atol=tolerance)
        np.testing.assert_allclose(mine.x.flat, theirs.x.flat, rtol=0, atol=tolerance**2)


def row(n, rate, noise=0.5):
    """Cars that each follow the next, in a row."""
    car, S = NodeType("car", ConstantVelocity(acceleration_noise=noise)), np.diag([0.0, 0.0, 1.0, 1.0])
    S = np.tile(S, (n - 1, 1, 1))
    edges = Edges("following", NODES[1:n], NODES[: n - 1], np.full(n - 1, rate), -S, S, np.zeros((n - 1, 4)))
    return SceneGraph.of(NODES[:n], car, [edges])


def platoon(length, hidden=()):
    """Predict and update calls over three cars that follow one another; car 2 is hidden in the frames `hidden`."""
    rng, transition = np.random.default_rng(0), discretise(row(3, 0.5), 0.1)
    yield "add", NODES[:3], [[-12.0 * k, 0, 10, 0] for k in range(3)], np.tile(np.eye(4), (3, 1, 1))
    for k in range(length):
        seen = np.array([0, 1] if k in hidden else [0, 1, 2])
        z = np.column_stack([k - 12 * seen, np.zeros(len(seen))]) + 0.1 * rng.normal(size=(len(seen), 2))
        yield "predict", transition
        yield "update", Measurements(seen, z, np.eye(2, 4), 0.01 * np.eye(2))


def waiting(windowed, calls):
    """The largest number of epochs between the newest one and the last that came out."""
    most = 0
    for call in calls:
        told(windowed, [call]).final()
        most = max(most, len(windowed._epochs))
    return most


def test_what_is_held_waits_for_hidden_objects_but_does_not_grow(monkeypatch):
    monkeypatch.setattr(smoother, "STEP", 1.0)
    seen, long = (waiting(RecordingSmoother(windowed=True), platoon(length)) for length in (200, 600))
    assert seen == long
    hidden = waiting(RecordingSmoother(windowed=True), platoon(200, hidden=range(60, 120)))
    assert hidden > seen + 40
    monkeypatch.setattr(smoother, "LONGEST", 4.0)
    impatient = RecordingSmoother(windowed=True)
    assert waiting(impatient, platoon(200, hidden=range(60, 120))) <= 40 + 10 + 1
    assert impatient.bound > 1e-3


def test_the_influence_of_the_future_is_what_knowing_the_present_would_change():
    calls = list(platoon(30, hidden=range(10, 20)))
    exactly = Measurements(NODES[:3], np.zeros((3, 4)), np.eye(4), 1e-12 * np.eye(4))
    asked, plain, knowing = (told(RecordingSmoother(), some) for some in (calls, calls, [*calls, ("update", exactly)]))
    influence = [np.diag(C.joint(np.arange(3))) for C in smoother._influence(asked._steps_backwards())][::-1]
    for state, better, variance in zip(plain.finish(), knowing.finish(), influence, strict=True):
        change = state.x.variances() - better.x.variances()
        np.testing.assert_allclose(variance, change, rtol=1e-4, atol=1e-11)


def test_no_more_nodes_than_asked_for_are_smoothed_jointly_and_the_answer_stays_near():
    """Twelve cars in a row, each tied to the next, of which every third is not seen for some seconds."""
    rng, truth = np.random.default_rng(2), np.stack([-12.0 * NODES, 0.0 * NODES, 10.0 + 0 * NODES, 0.0 * NODES], -1)
    calls = [("add", NODES, truth.copy(), np.tile(np.diag([1.0, 1.0, 4.0, 4.0]), (12, 1, 1)))]
    for k in range(40):
        truth[:, 2] += 0.1 * rng.normal(size=12)
        truth[:, :2] += 0.2 * truth[:, 2:]
        seen = np.flatnonzero((NODES % 3 > 0) | (k < 10) | (k > 25))
        z = truth[seen, :2] + 0.2 * rng.normal(size=(len(seen), 2))
        calls.append(("predict", discretise(row(12, 0.3, 1.5), 0.2)))
        calls.append(("update", Measurements(seen, z, np.eye(2, 4), 0.04 * np.eye(2))))
    every = {most: told(RecordingSmoother(max_component=most), calls) for most in (None, 12, 4)}
    largest = {
        m: max(np.bincount(s.x.uncorrelated(0.0).label).max() for s in one._steps_backwards())
        for m, one in every.items()
    }
    assert largest == {None: 12, 12: 12, 4: 4}
    exact, wide, bounded = (one.finish() for one in every.values())
    for one, other, near in zip(exact, wide, bounded, strict=True):
        np.testing.assert_array_equal(one.x.mean, other.x.mean)
        sigma = np.sqrt(one.x.variances())
        assert np.abs((near.x.mean - one.x.mean) / sigma).mean() < 0.25
        assert (np.linalg.eigvalsh(near.covariance(NODES)) > 0).all()
        assert (np.sqrt(near.x.variances()) / sigma < 2).all()


def test_what_is_nonlinear_is_linearised_at_the_smoothed_states():
    """As by the graph with an endless window: radar, and pedestrians who avoid each other."""
    recording, window = RecordingSmoother(), GraphFilter(lag=1e6)
    rng, truth, model = (
        np.random.default_rng(0),
        np.array([[30.0, 5, 1, 0], [33.0, 5, -1, 0]]),
        RangeBearing(state_dim=4),
    )
    away = NonlinearEdges(SocialForce(), [0, 1], [1, 0], np.ones(2), np.zeros((2, 1, 4)))
    for estimator in (recording, window):
        estimator.add([1, 2], truth + 0.5, np.tile(np.eye(4), (2, 1, 1)))
    for _ in range(8):
        truth[:, :2] += 0.2 * truth[:, 2:]
        z = model.predict(truth) + rng.normal(size=(2, 2)) * [0.2, 0.01]
        for estimator in (recording, window):
            estimator.predict(discretise(SceneGraph(np.array([1, 2]), (CAR, CAR), nonlinear=(away,)), 0.2))
            estimator.update(Observations([1, 2], z, model, np.diag([0.04, 1e-4])))
    for a, b in zip(recording.finish(), window.smoothed(), strict=True):
        sigma = np.sqrt(np.diagonal(b.covariance([1, 2]), axis1=1, axis2=2))
        assert np.abs((a.mean([1, 2]) - b.mean([1, 2])) / sigma).max() < 2e-3  # of the window's relinearisation


BAD = {
    "add: known": (lambda s: s.add([1], np.zeros((1, 4)), np.eye(4)[None]), "node 1 is in the estimator already"),
    "add: has just left": (lambda s: s.add([9], np.zeros((1, 4)), np.eye(4)[None]), "node 9 leaves at this time"),
    "add: NaN": (lambda s: s.add([5], np.full((1, 4), np.nan), np.eye(4)[None]), "finite"),
    "predict: a node missing": (
        lambda s: s.predict(discretise(SceneGraph.of([1], CAR), 0.1)),
        "expected 2 nodes, got 1",
    ),
    "update: unknown": (lambda s: s.update(Measurements([9], [[0.0]], np.eye(1, 4), [[1.0]])), "node 9 is not in"),
    "update: size": (lambda s: s.update(Measurements([1], [[0.0]], np.eye(1, 6), [[1.0]])), "H: expected 4 columns"),
    "marginalise: unknown": (lambda s: s.marginalise([1, 99]), "node 99 is not in the estimator"),
    "marginalise: twice": (lambda s: s.marginalise([1, 1]), "expected each node once"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_error_and_changes_nothing(name):
    call, message = BAD[name]
    expected, spoilt = (RecordingSmoother() for _ in range(2))
    for one in (expected, spoilt):
        one.add([1, 2, 9], np.zeros((3, 4)), np.tile(np.eye(4), (3, 1, 1)))
        one.marginalise([9])
    with pytest.raises((InputError, UnknownNodeError), match=message):
        call(spoilt)
    for one in (expected, spoilt):
        one.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    for a, b in zip(spoilt.finish(), expected.finish(), strict=True):
        np.testing.assert_array_equal(a.x.flat, b.x.flat)


@pytest.mark.parametrize("most", [0, -1, True])
def test_a_bound_that_is_no_number_of_nodes_is_refused(most):
    with pytest.raises(InputError, match="max_component"):
        RecordingSmoother(max_component=most)


# The fixed-lag smoother equals the textbook smoother, late measurements included; GTSAM finds the same answer


def test_a_node_that_comes_back_at_the_time_at_which_it_went_is_a_new_one():
    smoother, rng = GraphFilter(lag=5.0), np.random.default_rng(0)
    smoother.add([1, 2], rng.normal(size=(2, 4)), np.tile(np.eye(4), (2, 1, 1)))
    smoother.predict(discretise(SceneGraph.of([1, 2], CAR), 0.1))
    smoother.marginalise([2])
    smoother.add([2], rng.normal(size=(1, 4)), 3 * np.eye(4)[None])
    smoother.predict(discretise(SceneGraph.of([2, 1], CAR), 0.2))
    assert [sorted(epoch.nodes.tolist()) for epoch in smoother.smoothed()] == [[1], [1, 2], [1, 2]]
    assert smoother.remembered([1, 2], 0.05).tolist() == [True, False]
    with pytest.raises(UnknownNodeError):
        smoother.update(random_measurements(rng, [1, 2], 4), 0.05)


@pytest.mark.parametrize("tied", [False, True])
def test_a_state_that_nothing_disturbs_keeps_its_variable(tied):
    """Alone, and when a car follows it."""
    smoother = GraphFilter(lag=1.0)
    smoother.add([5], [[1.0, 2.0]], [np.diag([4.0, 1.0])])
    smoother.add([6], [[1.0, 2.0, 0.0, 0.0]], [np.eye(4)])
    pull = Edges("pull", [1], [0], [0.5], [-np.eye(4)], [np.eye(4, 2)], [np.zeros(4)])
    smoother.predict(discretise(SceneGraph([5, 6], (POLE, CAR), (pull,) if tied else ()), 0.5))
    smoother.update(Measurements([5], [[3.0]], [[1.0, 0.0]], [[1.0]]))
    graph = smoother.graph()
    assert [str(one) for one in graph.variables.values() if one.id == 5] == ["object 5 at 0.00 s"]
    solved = gtsam.GaussNewtonOptimizer(graph.native(), graph.values).optimize()
    np.testing.assert_allclose(solved.atVector(key_of(OBJECT, 5, 0)), [2.6, 2.0], atol=1e-12)
    np.testing.assert_allclose(smoother.smoothed()[0].mean([5]), [[2.6, 2.0]], atol=1e-12)


def test_the_window_forgets_what_is_older_than_its_lag():
    smoother = GraphFilter(lag=0.5)
    smoother.add([1], np.zeros((1, 4)), np.eye(4)[None])
    for _ in range(40):
        smoother.predict(discretise(SceneGraph.of([1], CAR), 0.1))
    assert len(smoother.smoothed()) == 6
    assert smoother.start == pytest.approx(smoother.time - 0.5)
    for time in (float("nan"), "now"):
        with pytest.raises(InputError, match="time"):
            smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=time)
    with pytest.raises(InputError, match="before what is remembered"):
        smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=smoother.start - 0.01)
    with pytest.raises(InputError, match="predict first"):
        smoother.update(Measurements([1], [[0.0]], np.eye(1, 4), [[1.0]]), time=smoother.time + 0.01)


def radar_window():
    """A queue of three cars seen by a radar at the origin, by ranges and bearings, for two seconds."""
    rng = np.random.default_rng(5)
    smoother = GraphFilter(lag=10.0)
    truth = np.array([[20.0, 5.0, 8.0, 1.0], [35.0, 8.0, 8.0, 1.0], [-30.0, 0.5, 2.0, -0.5]])
    smoother.add([1, 2, 3], truth + rng.normal(size=(3, 4)), np.tile(np.diag([4.0, 4.0, 4.0, 4.0]), (3, 1, 1)))
    model = RangeBearing(state_dim=4)
    for _ in range(10):
        smoother.predict(discretise(SceneGraph.of([1, 2, 3], CAR), 0.2))
        truth[:, :2] += 0.2 * truth[:, 2:]
        z = model.predict(truth) + rng.normal(size=(3, 2)) * [0.3, 0.01]
        z[:, 1] = (z[:, 1] + np.pi) % (2 * np.pi) - np.pi
        smoother.update(Observations([1, 2, 3], z, model, np.diag([0.09, 1e-4])))
    return smoother


def assert_minimum(smoother):
    """GTSAM's optimiser, started at the smoother's answer, stays there but for the threshold of relinearisation."""
    equivalent = smoother.graph()
    settings = gtsam.GaussNewtonParams()
    settings.setLinearSolverType("MULTIFRONTAL_QR")
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), equivalent.values, settings).optimize()
    epochs = {epoch.time: epoch for epoch in smoother.smoothed()}
    for key, variable in equivalent.variables.items():
        epoch, node = epochs[variable.time], [variable.id]
        sigma = np.sqrt(np.diag(epoch.covariance(node)[0]))
        assert np.abs((solved.atVector(key) - epoch.mean(node)[0]) / sigma).max() < 1e-3
    return equivalent, solved


def test_nonlinear_measurements_are_solved_by_gauss_newton_even_if_late():
    smoother = radar_window()
    equivalent, solved = assert_minimum(smoother)
    marginals = gtsam.Marginals(equivalent.native(), solved)
    newest = keys_of(equivalent, equivalent.epoch)
    for node in (1, 2, 3):
        assert covariance_error(smoother.covariance([node])[0], marginals.marginalCovariance(newest[node])) < 1e-4
    last = smoother.smoothed()[-1]
    np.testing.assert_array_equal(last.mean([1, 2, 3]), smoother.mean([1, 2, 3]))
    punctual, late = radar_window(), radar_window()
    extra = Observations([2], [[40.0, 0.2]], RangeBearing(state_dim=4), np.diag([0.09, 1e-4]))
    late.update(extra, time=1.0)
    assert_minimum(late)
    assert np.abs(late.mean([2]) - punctual.mean([2])).max() > 1e-3
