"""The batch smoother equals the textbook smoother over a whole recording, and finds outliers."""

import pickle

import gtsam
import numpy as np
import pytest

from factors import RangeBearing, Robust
from saga_fg import Edges, InputError, SceneGraph
from saga_fg.estimators import (
    BatchSmoother,
    GraduatedNonConvexity,
    GraphFilter,
    Measurements,
    Observations,
    recording,
)
from saga_fg.model.discretisation import discretise
from saga_fg.model.nonlinear_interactions import SocialForce
from saga_fg.model.scene_graph import NonlinearEdges
from tests.saga_fg.estimator_programs import random_program
from tests.saga_fg.estimator_scenario import EXACT, Textbook, covariance_error, mean_error, part, random_scenario, tell
from tests.saga_fg.graph_keys import keys_of
from tests.saga_fg.random_graphs import BUS, CAR, CONE, POLE


def punctual(scenario):
    return [call if call[0] != "update" else (*call[:2], None) for call in scenario.calls]


@pytest.mark.parametrize("likelihoods", [True, False])
@pytest.mark.parametrize("kinds", [(CAR, BUS), (CAR, POLE, CONE)])
@pytest.mark.parametrize("seed", range(3))
def test_every_state_is_the_textbooks(likelihoods, kinds, seed):
    calls = punctual(random_scenario(np.random.default_rng(seed), frames=12, kinds=kinds, density=0.15))
    textbook, smoother = tell(Textbook(), calls), tell(BatchSmoother(likelihoods=likelihoods), calls)
    steps, _ = textbook.solve()
    marginal, joint = smoother.smoothed(), smoother.smoothed(joint=True)
    assert len(marginal) == len(joint) == len(steps)
    for alone, together, (time, places, _, reference) in zip(marginal, joint, steps, strict=True):
        assert alone.time == pytest.approx(time, abs=1e-12)
        assert set(alone.nodes.tolist()) == set(places)
        expected = part(reference, places, together.nodes)
        assert mean_error(together.joint_mean(together.nodes), expected) < EXACT
        assert covariance_error(together.joint_covariance(together.nodes), expected.covariance) < EXACT
        for node in alone.nodes:
            own = part(reference, places, [node])
            assert mean_error(alone.mean([node])[0], own) < EXACT
            assert covariance_error(alone.covariance([node])[0], own.covariance) < EXACT


def test_marginals_of_nodes_that_part_and_meet_again():
    """A component falls apart when its correlations have decayed; what comes later still tells of before."""
    smoother, nodes = BatchSmoother(likelihoods=False, order="time"), [1, 2, 3]
    truth = np.array([[0.0, 0, 10, 0], [12.0, 0, 10, 0], [25.0, 0, 10, 0]])
    smoother.add(nodes, truth, np.tile(np.diag([1.0, 1.0, 4.0, 4.0]), (3, 1, 1)))
    S = np.diag([0.0, 0.0, 1.0, 1.0])[None]
    for k in range(160):
        pair = {0: (0, 1), 7: (1, 2)}.get(k // 20)  # 1 follows 2, later 2 follows 3
        zeros = np.zeros((1, 4))
        edges = [] if pair is None else [Edges("with", [pair[0]], [pair[1]], [0.5], -S, S, zeros)]
        smoother.predict(discretise(SceneGraph.of(nodes, CAR, edges), 0.5))
        truth[:, :2] += 0.5 * truth[:, 2:]
        seen = np.arange(3) if k >= 20 else np.array([0, 2])
        smoother.update(Measurements(np.array(nodes)[seen], truth[seen, :2], np.eye(2, 4), 0.01 * np.eye(2)))
    marginal, joint = smoother.smoothed(), smoother.smoothed(joint=True)
    for alone, together in zip(marginal, joint, strict=True):
        np.testing.assert_allclose(alone.covariance(nodes), together.covariance(nodes), rtol=1e-9, atol=1e-12)


def test_a_long_recording_is_smoothed_in_stretches_to_the_last_digit(monkeypatch):
    program = random_program(np.random.default_rng(5), 60, kinds=(CAR, CONE), intervals=(0.1, 0.2), density=0.2)
    whole, stretched = (BatchSmoother(likelihoods=False, order="time") for _ in range(2))
    for smoother in (whole, stretched):
        for operation in program:
            operation.run(smoother)
    expected = whole.smoothed()
    monkeypatch.setattr(recording, "MOST_KEPT", sum(step.size for step in whole.snapshot().recording.steps) // 7)
    found = stretched.smoothed()
    assert len(whole.snapshot().recording.steps) == 60
    assert len(stretched.snapshot().recording.steps) < 60
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.nodes, other.nodes)
        np.testing.assert_array_equal(one.state, other.state)
        for node in one.nodes:
            np.testing.assert_array_equal(one.covariance([node]), other.covariance([node]))
    node = found[-1].nodes[:1]
    np.testing.assert_array_equal(stretched.covariance(node), whole.covariance(node))  # the pass is done when asked for


def test_a_smoother_that_waits_says_the_same_and_no_likelihoods():
    calls = punctual(random_scenario(np.random.default_rng(5)))
    eager, waiting = tell(BatchSmoother(), calls), BatchSmoother(likelihoods=False)
    for name, *arguments in calls:
        answer = getattr(waiting, name)(*arguments)
        if name == "update":
            assert np.isnan(answer)
    np.testing.assert_array_equal(waiting.joint_mean(eager.nodes), eager.joint_mean(eager.nodes))
    np.testing.assert_array_equal(waiting.joint_covariance(eager.nodes), eager.joint_covariance(eager.nodes))


def platoon(estimator, frames=30, outliers=0.0, seed=0, robust=None, only_inliers=False):
    """Three cars in a row, positions measured; some measurements are anywhere."""
    rng = np.random.default_rng(seed)
    nodes = [1, 2, 3]
    truth = np.array([[0.0, 0, 10, 0], [12.0, 0, 10, 0], [25.0, 0, 10, 0]])
    estimator.add(nodes, truth, np.tile(np.diag([1.0, 1.0, 4.0, 4.0]), (3, 1, 1)))
    wrong = []
    for _ in range(frames):
        estimator.predict(discretise(SceneGraph.of(nodes, CAR), 0.1))
        truth[:, :2] += 0.1 * truth[:, 2:]
        z = truth[:, :2] + 0.1 * rng.normal(size=(3, 2))
        bad = rng.random(3) < outliers
        z[bad] += rng.uniform(5, 30, (int(bad.sum()), 2)) * rng.choice([-1, 1], (int(bad.sum()), 2))
        wrong.append(bad)
        kept = ~bad if only_inliers else np.ones(3, dtype=bool)
        measured = Measurements(np.array(nodes)[kept], z[kept], np.eye(2, 4), 0.01 * np.eye(2))
        if only_inliers:
            estimator.update(measured)
        else:
            estimator.update(measured, robust=robust)
    return wrong


@pytest.mark.parametrize("likelihoods", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_graduated_non_convexity_finds_the_outliers(seed, likelihoods):
    graduated, clean = BatchSmoother(likelihoods=likelihoods), BatchSmoother()
    wrong = platoon(graduated, outliers=0.3, seed=seed, robust=GraduatedNonConvexity(scale=5.0))
    platoon(clean, outliers=0.3, seed=seed, only_inliers=True)
    weights = graduated.weights()
    assert weights[0] == []
    for (found,), bad in zip(weights[1:], wrong, strict=True):
        np.testing.assert_array_equal(found, (~bad).astype(float))
    for moment, expected in zip(graduated.smoothed(), clean.smoothed(), strict=True):
        np.testing.assert_allclose(moment.state, expected.state, atol=1e-9)
        np.testing.assert_allclose(moment.covariance([1, 2, 3]), expected.covariance([1, 2, 3]), rtol=1e-9, atol=1e-12)


def test_the_other_graduated_loss_comes_close_to_it():
    graduated, clean = BatchSmoother(likelihoods=False), BatchSmoother()
    platoon(graduated, outliers=0.3, robust=GraduatedNonConvexity(scale=5.0, loss="geman-mcclure"))
    platoon(clean, outliers=0.3, only_inliers=True)
    sigma = np.sqrt(np.diagonal(clean.covariance([1, 2, 3]), axis1=1, axis2=2))
    assert np.abs((graduated.mean([1, 2, 3]) - clean.mean([1, 2, 3])) / sigma).max() < 0.5


def test_without_outliers_every_measurement_counts():
    graduated, plain = BatchSmoother(), BatchSmoother()
    platoon(graduated, robust=GraduatedNonConvexity(scale=50.0))
    platoon(plain)
    assert all((counted == 1).all() for moment in graduated.weights() for counted in moment)
    np.testing.assert_allclose(graduated.joint_mean([1, 2, 3]), plain.joint_mean([1, 2, 3]), atol=1e-12)


def test_weights_follow_what_comes_later():
    smoother = BatchSmoother()
    platoon(smoother, outliers=0.3, robust=GraduatedNonConvexity(scale=5.0))
    first = smoother.weights()
    smoother.predict(discretise(SceneGraph.of([1, 2, 3], CAR), 0.1))
    far = Measurements([1], [[1e4, 0.0]], np.eye(2, 4), 0.01 * np.eye(2))
    smoother.update(far, robust=GraduatedNonConvexity(scale=5.0))
    later = smoother.weights()
    assert later[-1][0].tolist() == [0.0]
    for before, after in zip(first, later[:-1], strict=True):
        for a, b in zip(before, after, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("robust", [None, Robust("huber", 1.345), GraduatedNonConvexity(scale=6.0)])
def test_gtsam_solves_the_same_graph_to_the_same_answer(robust):
    smoother = BatchSmoother(likelihoods=False)
    platoon(smoother, frames=12, outliers=0.2, robust=robust)
    equivalent = smoother.graph()
    solved = gtsam.LevenbergMarquardtOptimizer(equivalent.native(), equivalent.values).optimize()
    for epoch, moment in enumerate(smoother.smoothed()):
        for node, key in keys_of(equivalent, epoch).items():
            sigma = np.sqrt(np.diag(moment.covariance([node])[0]))
            assert np.abs((solved.atVector(key) - moment.mean([node])[0]) / sigma).max() < 1e-6


def test_nonlinear_measurements_over_a_whole_recording_equal_the_smoother_with_an_endless_window():
    batch, window = BatchSmoother(likelihoods=False), GraphFilter(lag=1e6)
    rng = np.random.default_rng(0)
    truth = np.array([[30.0, 5, 5, 2], [-20.0, 1, 3, -3]])
    for estimator in (batch, window):
        estimator.add([1, 2], truth + 0.5, np.tile(4 * np.eye(4), (2, 1, 1)))
    model = RangeBearing(state_dim=4)
    for _ in range(8):
        truth[:, :2] += 0.2 * truth[:, 2:]
        z = model.predict(truth) + rng.normal(size=(2, 2)) * [0.2, 0.01]
        for estimator in (batch, window):
            estimator.predict(discretise(SceneGraph.of([1, 2], CAR), 0.2))
            estimator.update(Observations([1, 2], z, model, np.diag([0.04, 1e-4])))
    for a, b in zip(batch.smoothed(), window.smoothed(), strict=True):
        sigma = np.sqrt(np.diagonal(b.covariance([1, 2]), axis1=1, axis2=2))
        assert np.abs((a.mean([1, 2]) - b.mean([1, 2])) / sigma).max() < 1e-3  # of the window's relinearisation


def test_a_snapshot_can_be_stored():
    calls = punctual(random_scenario(np.random.default_rng(8)))
    half = len(calls) // 2
    straight, resumed = tell(BatchSmoother(), calls), BatchSmoother()
    resumed.restore(pickle.loads(pickle.dumps(tell(BatchSmoother(), calls[:half]).snapshot())))
    tell(resumed, calls[half:])
    for a, b in zip(straight.smoothed(), resumed.smoothed(), strict=True):
        np.testing.assert_array_equal(a.state, b.state)
        for node in a.nodes:
            np.testing.assert_array_equal(a.covariance([node]), b.covariance([node]))


@pytest.mark.parametrize("likelihoods", [True, False])
def test_functions_that_fail_are_refused_at_once(likelihoods):
    """Also by a smoother that waits: found later, there would be no way to get rid of them."""

    class Refusal(SocialForce):
        def accelerations(self, own, other, given):
            raise ZeroDivisionError("no idea")

    edges = NonlinearEdges(Refusal(), [0], [1], [1.0], np.zeros((1, 1, 4)))
    refusing = SceneGraph(np.array([1, 2]), (CAR, CAR), nonlinear=(edges,))

    def told(wrong):
        smoother = BatchSmoother(likelihoods=likelihoods)
        smoother.add([1, 2], np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
        apart = discretise(SceneGraph.of([1, 2], CAR), 0.1)
        smoother.predict(apart)
        if wrong:
            with pytest.raises(InputError, match=r"law Refusal: ZeroDivisionError\('no idea'\)"):
                smoother.predict(discretise(refusing, 0.1))
            with pytest.raises(InputError, match="the object is at the sensor itself"):
                smoother.update(Observations([1], [[1.0, 0.0]], RangeBearing(state_dim=4), np.eye(2)))
        smoother.update(Measurements([1], [[1.0, 0.0]], np.eye(2, 4), np.eye(2)))
        return smoother.smoothed()

    for moment, expected in zip(told(True), told(False), strict=True):
        np.testing.assert_array_equal(moment.mean([1, 2]), expected.mean([1, 2]))


def test_what_was_not_kept_is_said():
    smoother = BatchSmoother()
    platoon(smoother, frames=2)
    with pytest.raises(InputError, match="ask for joint"):
        smoother.smoothed()[0].joint_covariance([1, 2])
    with pytest.raises(InputError, match="only means"):
        smoother.smoothed(covariances=False)[0].covariance([1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"scale": 0.0}, "scale"), ({"scale": np.nan}, "scale"), ({"loss": "huber"}, "loss: expected one of")],
)
def test_settings_of_graduated_non_convexity_are_checked(settings, message):
    with pytest.raises(InputError, match=message):
        GraduatedNonConvexity(**settings)


@pytest.mark.parametrize("loss", ["truncated", "geman-mcclure"])
def test_the_surrogate_turns_from_convex_to_the_loss_itself(loss):
    graduated = GraduatedNonConvexity(scale=2.0, loss=loss)
    distances = np.array([0.0, 1.0, 1.9, 2.1, 10.0])
    mu = graduated.first(distances)
    at_first = graduated.weights(mu, distances)
    assert at_first.min() > 0  # nothing is rejected yet
    seen, weights = 0, at_first
    while mu is not None:
        weights, seen = graduated.weights(mu, distances), seen + 1
        mu = graduated.next(mu, weights)
        assert seen < 100
    assert (np.diff(weights) <= 1e-12).all()
    if loss == "truncated":
        assert weights.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]
    else:
        np.testing.assert_allclose(weights, (1 / (1 + (distances / 2) ** 2)) ** 2)


def test_no_more_nodes_than_asked_for_are_smoothed_jointly_and_the_answer_stays_near():
    """Twelve cars in a row, each tied to the next, of which every third is not seen for some seconds."""
    rng, nodes, S = np.random.default_rng(2), np.arange(12), np.diag([0.0, 0.0, 1.0, 1.0])
    exact, wide = (BatchSmoother(likelihoods=False, order="time", max_component=most) for most in (None, 12))
    bounded = BatchSmoother(likelihoods=False, max_component=4)
    truth = np.stack([-12.0 * nodes, 0.0 * nodes, 10.0 + 0.0 * nodes, 0.0 * nodes], axis=-1)
    pairs = np.tile(-S, (11, 1, 1)), np.tile(S, (11, 1, 1)), np.zeros((11, 4))
    graph = SceneGraph.of(nodes, CAR, [Edges("row", nodes[1:], nodes[:-1], np.full(11, 0.3), *pairs)])
    for smoother in (exact, wide, bounded):
        smoother.add(nodes, truth, np.tile(np.diag([1.0, 1.0, 4.0, 4.0]), (12, 1, 1)))
    for k in range(40):
        truth[:, 2] += 0.1 * rng.normal()
        truth[:, :2] += 0.2 * truth[:, 2:]
        seen = np.flatnonzero((nodes % 3 > 0) | (k < 10) | (k > 25))
        z = truth[seen, :2] + 0.2 * rng.normal(size=(len(seen), 2))
        for smoother in (exact, wide, bounded):
            smoother.predict(discretise(graph, 0.2))
            smoother.update(Measurements(seen, z, np.eye(2, 4), 0.04 * np.eye(2)))
    for one, other, near in zip(exact.smoothed(), wide.smoothed(), bounded.smoothed(), strict=True):
        np.testing.assert_array_equal(one.state, other.state)
        P, Q = one.covariance(nodes), near.covariance(nodes)
        sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        assert np.abs((near.mean(nodes) - one.mean(nodes)) / sigma).mean() < 0.25
        assert (np.linalg.eigvalsh(Q) > 0).all()
        assert (np.sqrt(np.diagonal(Q, axis1=1, axis2=2)) / sigma < 2).all()
    for smoother, most in ((exact, 12), (bounded, 4)):
        parts = [step.filtered.uncorrelated(0.0).label for step in smoother.snapshot().recording.steps]
        assert max(np.bincount(label).max() for label in parts) == most
    with pytest.raises(InputError, match="max_component"):
        BatchSmoother(max_component=0)
