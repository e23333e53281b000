"""A scene as a factor graph, and parts of the model that one file adds."""

import gtsam
import numpy as np
import pytest

from factors import (
    SolverSettings,
    gaussian_factor,
    pose_prior_factor,
    prior_factor,
)
from saga_fg.estimators import (
    IncrementalSmoother,
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
