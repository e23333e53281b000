"""Mixtures of motion: moments, mode probabilities, and that all back ends agree on what was recorded."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantVelocity, Edges, InputError, NodeType, SceneGraph
from saga_fg.conformance.programs import TextbookEstimator
from saga_fg.estimators import GraphFilter, JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.manoeuvres import CoordinatedTurn, Mixture, ModeTable, Stationary, mode_dynamics
from tests.saga_fg.model.test_motion import BACK_ENDS

LINEAR = Mixture((Stationary(), ConstantVelocity(2.0)), dwell_time=3.0)
TURNING = Mixture((Stationary(), ConstantVelocity(0.5), CoordinatedTurn(0.5)), dwell_time=3.0)
H = np.eye(2, 5)


def table(mixture, n=3, seed=0):
    """Modes of different means, covariances and weights."""
    rng = np.random.default_rng(seed)
    d, M = len(mixture.components), len(mixture.motions)
    root = rng.normal(size=(n, M, d, d)) / 3 + np.eye(d)
    weight = rng.uniform(0.1, 1, (n, M))
    P = root @ np.swapaxes(root, -1, -2)
    new = ModeTable.new(mixture, np.arange(n), np.zeros((n, d)), np.tile(np.eye(d), (n, 1, 1)))
    return replace(new, weight=weight / weight.sum(axis=1)[:, None], mean=rng.normal(size=(n, M, d)), P=P)


def tracked(estimator, mixture, path, dt=0.1, seed=0):
    """The modes of one node on a path, as the tracker does it."""
    rng, node_type = np.random.default_rng(seed), NodeType("node", mixture)
    d = node_type.dim
    mean, P = np.zeros((1, d)), np.diag([1.0, 1.0, 9.0, 9.0, 0.09][:d])[None]
    estimator.add([0], mean, P)
    modes = ModeTable.new(mixture, np.array([0]), mean, P)
    for place in path:
        modes = modes.anchored(estimator.mean([0]), estimator.covariance([0]))
        estimator.predict(discretise(SceneGraph(np.array([0]), (node_type,), motions=(modes,)), dt))
        modes = modes.predicted(dt)[0].anchored(estimator.mean([0]), estimator.covariance([0]))
        z = (place + rng.normal(0, 0.1, 2))[None]
        modes, said, directions = modes.updated(np.array([0]), z, H[None, :, :d], 0.01 * np.eye(2)[None])
        estimator.update(Measurements([0], said, directions, np.eye(d)))
    return modes


@pytest.mark.parametrize("mixture", [LINEAR, TURNING], ids=["linear", "turning"])
def test_the_matched_motion_has_the_moments_of_the_mixture_of_all_pairs_of_modes(mixture):
    modes = table(mixture)
    later, own = modes.predicted(0.4)
    w = modes.weight[:, :, None] * mixture.transition(0.4)
    P0 = [(w[:, :, r] / w.sum(axis=1)[:, r, None]) for r in range(w.shape[2])]
    start = np.stack([(share[..., None] * modes.mean).sum(axis=1) for share in P0], axis=1)
    F, c, Q = mode_dynamics(mixture, start, 0.4)
    for i in range(3):
        mean, second = np.zeros(2 * len(mixture.components)), 0.0
        for s in range(w.shape[1]):
            for r in range(w.shape[2]):  # of (x, x'), given both modes
                both = np.concatenate([np.eye(len(c[i, r])), F[i, r]])
                m = both @ modes.mean[i, s] + np.concatenate([0 * c[i, r], c[i, r]])
                P = both @ modes.P[i, s] @ both.T
                P[len(c[i, r]) :, len(c[i, r]) :] += Q[i, r]
                mean += w[i, s, r] * m
                second += w[i, s, r] * (P + np.outer(m, m))
        P = second - np.outer(mean, mean)
        d = len(mixture.components)
        m, P_x = modes.moments[0][i], modes.moments[1][i]
        np.testing.assert_allclose(own.F[i] @ m + own.b[i], mean[d:], atol=1e-12)
        np.testing.assert_allclose(own.F[i] @ P_x, P[d:, :d], atol=1e-12)
        np.testing.assert_allclose(own.F[i] @ P_x @ own.F[i].T + own.Q[i], P[d:, d:], atol=1e-12)
        np.testing.assert_allclose(later.moments[0][i], mean[d:], atol=1e-12)
        if mixture is LINEAR:  # where the linearisation does not depend on the mode before
            np.testing.assert_allclose(later.moments[1][i], P[d:, d:], atol=1e-12)


def test_anchoring_gives_the_moments_of_the_joint_state_and_keeps_what_they_are_already():
    modes = table(TURNING)
    mean, P = modes.moments
    same = modes.anchored(mean, P)
    np.testing.assert_allclose(same.mean, modes.mean, atol=1e-12)
    np.testing.assert_allclose(same.P, modes.P, atol=1e-12)
    moved = modes.anchored(mean + 1.0, 0.3 * P + 0.1 * np.eye(5))
    np.testing.assert_allclose(moved.moments[0], mean + 1.0, atol=1e-12)
    np.testing.assert_allclose(moved.moments[1], 0.3 * P + 0.1 * np.eye(5), atol=1e-12)


def textbook_imm(path, dt, seed):
    """Blom and Bar-Shalom's filter for one node of the linear mixture; prediction before every measurement."""
    rng, change = np.random.default_rng(seed), LINEAR.transition(dt)
    alone = [discretise(SceneGraph.of([0], NodeType("mode", motion)), dt) for motion in LINEAR.motions]
    F, Q = ([getattr(t, name).toarray() for t in alone] for name in ("F_matrix", "Q_matrix"))
    mu, m, P = np.full(2, 0.5), [np.zeros(4)] * 2, [np.diag([1.0, 1.0, 9.0, 9.0])] * 2
    predictions = []
    for place in path:
        prior = mu @ change
        share = mu[:, None] * change / prior
        m0 = [sum(share[s, r] * m[s] for s in range(2)) for r in range(2)]
        P0 = [sum(share[s, r] * (P[s] + np.outer(m[s] - m0[r], m[s] - m0[r])) for s in range(2)) for r in range(2)]
        m, P = [F[r] @ m0[r] for r in range(2)], [F[r] @ P0[r] @ F[r].T + Q[r] for r in range(2)]
        mean = prior @ m
        predictions.append((mean, sum(prior[r] * (P[r] + np.outer(m[r] - mean, m[r] - mean)) for r in range(2))))
        z, likelihood = place + rng.normal(0, 0.1, 2), np.zeros(2)
        for r in range(2):
            S, v = P[r][:2, :2] + 0.01 * np.eye(2), z - m[r][:2]
            K = P[r][:, :2] @ np.linalg.inv(S)
            likelihood[r] = np.exp(-0.5 * v @ np.linalg.solve(S, v)) / np.sqrt(np.linalg.det(S))
            m[r], P[r] = m[r] + K @ v, P[r] - K @ S @ K.T
        mu = prior * likelihood / (prior @ likelihood)
    return mu, predictions


def test_a_node_without_edges_is_predicted_as_by_the_textbooks_interacting_multiple_model_filter():
    """Through a halt and a departure, where variances grow and the mean shifts as modes change."""
    speed = np.concatenate([np.full(12, 4.0), np.zeros(12), np.linspace(0, 5, 12)])
    path = np.stack([np.cumsum(0.2 * speed), 0 * speed], axis=1)

    class Recorder(JointKalmanFilter):
        predictions = ()

        def predict(self, transition):
            super().predict(transition)
            self.predictions += ((self.mean([0])[0], self.covariance([0])[0]),)

    filtered = Recorder()
    modes = tracked(filtered, LINEAR, path, dt=0.2)
    weight, expected = textbook_imm(path, 0.2, 0)
    np.testing.assert_allclose(modes.weight[0], weight, atol=1e-8)
    for (mean, P), (m, C) in zip(filtered.predictions, expected, strict=True):
        assert np.abs((mean - m) / np.sqrt(np.diag(C))).max() < 1e-8
        assert np.linalg.norm(P - C) < 1e-8 * np.linalg.norm(C)


def test_modes_are_told_apart_by_what_is_seen_and_their_settings_checked():
    t = 0.1 * np.arange(60)
    stands, straight = np.zeros((60, 2)), np.stack([8 * t, 0 * t], axis=1)
    turns = 16 * np.stack([np.sin(0.5 * t), 1 - np.cos(0.5 * t)], axis=1)
    weights = [tracked(JointKalmanFilter(), TURNING, path).weight[0] for path in (stands, straight, turns)]
    assert np.argmax(weights, axis=1).tolist() == [0, 1, 2]
    with pytest.raises(InputError, match="at least two"):
        Mixture((Stationary(),))
    with pytest.raises(InputError, match="dwell_time"):
        Mixture(dwell_time=0.0)


def recording(seed=0):
    """Four coupled nodes, of two mixtures and none: what a filter was told, with the transitions as recorded."""
    rng = np.random.default_rng(seed)
    linear, turning, plain = (NodeType("n", m) for m in (LINEAR, TURNING, ConstantVelocity(1.0)))
    types, nodes = (linear, turning, plain, linear), np.array([3, 5, 7, 9])
    eye = np.zeros((1, 4, 4))
    eye[0, [2, 3], [2, 3]] = 1.0
    wide = np.zeros((1, 5, 5))
    wide[0, [2, 3], [2, 3]] = 1.0
    three, none = np.repeat(eye, 3, axis=0), np.zeros((3, 4))
    edges = (
        Edges(SharedVelocity.__name__, [0, 2, 3], [2, 0, 2], [0.5, 0.3, 1.0], -three, three, none),
        Edges(SharedVelocity.__name__, [1], [0], [0.7], -wide, wide[:, :, :4], np.zeros((1, 5))),
    )
    filtered, program, tables = JointKalmanFilter(), [], {}
    starts = {}
    for node, node_type in zip(nodes.tolist(), types, strict=True):
        mean, P = rng.normal(size=(1, node_type.dim)), np.diag([1.0, 1.0, 4.0, 4.0, 0.09][: node_type.dim])[None]
        starts[node] = mean, P
        program.append(("add", [node], mean, P))
        filtered.add([node], mean, P)
    for mixture, ids in ((LINEAR, [3, 9]), (TURNING, [5])):
        mean, P = (np.concatenate([starts[i][k] for i in ids]) for k in range(2))
        tables[mixture] = ModeTable.new(mixture, np.array(ids), mean, P)
    for _ in range(8):
        dt = float(rng.choice([0.001, 0.1, 0.5]))
        tables = {m: t.anchored(filtered.mean(t.ids), filtered.covariance(t.ids)) for m, t in tables.items()}
        graph = SceneGraph(nodes, types, edges, rng.uniform(0.3, 1.0, 4), motions=tuple(tables.values()))
        transition = discretise(graph, dt)
        filtered.predict(transition)
        program.append(("predict", transition))
        tables = dict(zip(tables, graph.after(dt).motions, strict=True))
        for ids, mixture, d in (([3, 9], LINEAR, 4), ([5], TURNING, 5)):
            if rng.random() < 0.8:
                z, R = rng.normal(0, 0.5, (len(ids), 2)), np.tile(0.04 * np.eye(2), (len(ids), 1, 1))
                modes = tables[mixture].anchored(filtered.mean(ids), filtered.covariance(ids))
                tables[mixture], z, directions = modes.updated(np.array(ids), z, np.tile(H[:, :d], (len(ids), 1, 1)), R)
                seen = Measurements(ids, z, directions, np.eye(d))
                filtered.update(seen)
                program.append(("update", seen))
    return nodes, program


@pytest.mark.parametrize("name", BACK_ENDS)
@pytest.mark.parametrize("seed", range(3))
def test_given_the_record_all_back_ends_equal_the_textbook(name, seed):
    nodes, program = recording(seed)
    estimator, textbook = BACK_ENDS[name](), TextbookEstimator()
    for call, *arguments in program:
        for one in (estimator, textbook):
            getattr(one, call)(*arguments)
    P = textbook.joint_covariance(nodes)
    apart = (estimator.joint_mean(nodes) - textbook.joint_mean(nodes)) / np.sqrt(np.diag(P))
    assert np.abs(apart).max() < 1e-9
    assert np.linalg.norm(estimator.joint_covariance(nodes) - P) < 1e-9 * np.linalg.norm(P)


def test_late_measurements_split_the_interval_of_a_mixture():
    """Both parts are matched anew, the second one with the modes as they are then."""
    node_type, modes = NodeType("n", LINEAR), table(LINEAR, n=1)
    graph = SceneGraph(np.array([0]), (node_type,), motions=(modes,))
    whole, parted = GraphFilter(lag=5.0), GraphFilter(lag=5.0)
    for smoother in (whole, parted):
        smoother.add([0], *modes.moments)
    whole.predict(discretise(graph, 0.2))
    whole.predict(discretise(graph.after(0.2), 0.2))
    parted.predict(discretise(graph, 0.4))
    for smoother in (whole, parted):
        smoother.update(Measurements([0], [[0.5, 0.2]], H[:, :4], 0.04 * np.eye(2)), time=0.2)
    np.testing.assert_allclose(parted.mean([0]), whole.mean([0]), atol=1e-10)
    np.testing.assert_allclose(parted.covariance([0]), whole.covariance([0]), atol=1e-10)
