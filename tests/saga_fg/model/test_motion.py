"""Motion models. Node types: named components, and own motions that are what the books say."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

from saga_fg import (
    ConstantAcceleration,
    ConstantVelocity,
    Edges,
    InputError,
    NodeType,
    RandomWalk,
    SagaError,
    SceneGraph,
)
from saga_fg.estimators import GraphFilter, JointKalmanFilter, Measurements
from saga_fg.estimators.interval_dynamics import nonlinear_dynamics
from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.manoeuvres import CoordinatedTurn
from saga_fg.model.nonlinear_interactions import SmoothDriver, SocialForce
from saga_fg.model.scene_graph import NonlinearEdges


@dataclass(frozen=True)
class Custom:
    """A motion made of whatever the test wants."""

    components: tuple
    generator: object
    diffusion: object


def test_constant_velocities_go_straight_and_a_random_walk_stays():
    car = NodeType("car", ConstantVelocity())
    assert car.components == ("x", "y", "vx", "vy")
    assert car.dim == 4
    moved = scipy.linalg.expm(car.generator * 2.0) @ [1.0, 2.0, 3.0, -1.0]
    assert moved == pytest.approx([7.0, 0.0, 3.0, -1.0])
    assert np.diag(NodeType("car", ConstantVelocity(2.5)).diffusion).tolist() == [0, 0, 2.5, 2.5]
    pole = NodeType("pole", RandomWalk())
    assert pole.dim == 2
    assert not pole.generator.any()
    assert not pole.diffusion.any()
    assert NodeType("cone", RandomWalk(drift=0.2)).diffusion.tolist() == (0.2 * np.eye(2)).tolist()


def test_accelerations_move_on_a_parabola_and_fade():
    car = NodeType("car", ConstantAcceleration(jerk_noise=0.3))
    moved = scipy.linalg.expm(car.generator * 2.0) @ [0.0, 0.0, 1.0, 0.0, 0.5, -1.0]
    assert moved == pytest.approx([3.0, -2.0, 2.0, -2.0, 0.5, -1.0])
    assert np.diag(car.diffusion).tolist() == [0, 0, 0, 0, 0.3, 0.3]
    car = NodeType("car", ConstantAcceleration(fading_time=0.5))
    moved = scipy.linalg.expm(car.generator * 0.5) @ [0, 0, 0, 0, 1.0, 2.0]
    assert moved[4:] == pytest.approx([np.exp(-1), 2 * np.exp(-1)])
    assert moved[2:4] == pytest.approx([0.5 * (1 - np.exp(-1)), 1.0 * (1 - np.exp(-1))])


def test_components_are_found_by_name():
    car = NodeType("car", ConstantAcceleration())
    assert car.index(("vy", "x")).tolist() == [3, 0]
    assert car.has(("x", "ax"))
    assert not car.has(("x", "z"))
    assert car.selector(("vx", "vy")) @ np.arange(6) == pytest.approx([2, 3])
    assert car.selector(()).shape == (0, 6)
    with pytest.raises(InputError, match="node type car has no component 'z'; it has x, y, vx, vy, ax, ay"):
        car.index(("x", "z"))


def test_a_motion_that_makes_no_sense_is_refused(subtests):
    for motion, message in [
        (Custom((), np.empty((0, 0)), np.empty((0, 0))), "node type odd: expected distinct component names"),
        (Custom(("x", "x"), np.eye(2), np.eye(2)), "node type odd: expected distinct component names"),
        (Custom(("x",), np.eye(2), np.eye(1)), r"node type odd: generator: expected shape \(1, 1\), got \(2, 2\)"),
        (Custom(("x",), [[np.nan]], np.eye(1)), r"node type odd: generator\[0, 0\]: expected a finite number"),
        (Custom(("x",), np.eye(1), np.eye(2)), r"node type odd: diffusion: expected shape \(1, 1\)"),
        (Custom(("x", "y"), np.eye(2), [[1, 0.5], [0, 1]]), "node type odd: diffusion: expected a symmetric positive"),
        (Custom(("x", "y"), np.eye(2), [[1, 2], [2, 1]]), "node type odd: diffusion: expected a symmetric positive"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            NodeType("odd", motion)


# Nonlinear motion and interactions in every back end: turning cars behind each other, pedestrians, a wall

CAR, VAN = NodeType("car", CoordinatedTurn(0.5)), NodeType("van", CoordinatedTurn(1.0))
WALKER, WALL = NodeType("walker", ConstantVelocity(0.3)), NodeType("wall", RandomWalk(drift=0.01))
TYPES = (CAR, CAR, VAN, WALKER, WALKER, WALL, CAR)
NODES = np.arange(10, 17)
START = [
    [0.0, 0.0, 8.0, 0.5, 0.1],
    [-11.0, -1.0, 9.0, 0.0, 0.2],
    [-24.0, -2.0, 9.5, 0.5, 0.03],
    [5.0, 9.0, 0.3, 0.1],
    [5.5, 9.6, -0.4, 0.2],
    [5.0, 8.0],
    [-40.0, -3.0, 8.0, 0.0, 0.0],
]
BACK_ENDS = {"kalman": JointKalmanFilter, "isam2": GraphFilter, "fixed-lag": lambda: GraphFilter(lag=0.5)}


def scene():
    """A car follows a car and shares its velocity, a van follows it, pedestrians and a wall push each other."""
    eye = np.zeros((1, 5, 5))
    eye[0, [2, 3], [2, 3]] = 1.0
    shared = Edges(SharedVelocity.__name__, [1], [0], [0.4], -eye, eye, np.zeros((1, 5)))
    driver, force = SmoothDriver(), SocialForce()
    followers = NonlinearEdges(driver, np.array([1, 2]), np.array([0, 1]), np.array([0.8, 1.0]), np.array([4.5, 3.5]))
    apart = NonlinearEdges(force, np.array([3, 4]), np.array([4, 3]), np.ones(2), np.zeros((2, 1, 4)))
    wall = NonlinearEdges(force, np.array([3]), np.array([5]), np.ones(1), np.array([[[-9.0, -0.2, 9.0, 0.3]]]))
    return SceneGraph(NODES, TYPES, (shared,), nonlinear=(followers, apart, wall))


def difference(a, b):
    """Largest of means, in sigmas, and of covariances, relative."""
    P = b.joint_covariance(NODES)
    apart = (a.joint_mean(NODES) - b.joint_mean(NODES)) / np.sqrt(np.diag(P))
    return max(np.abs(apart).max(), np.linalg.norm(a.joint_covariance(NODES) - P) / np.linalg.norm(P))


@pytest.mark.parametrize("name", ["isam2", "fixed-lag"])
def test_the_first_linearisation_of_smoothers_is_the_filters(name):
    """Before anything is measured nothing moves."""
    estimators = [make() for make in (BACK_ENDS[name], JointKalmanFilter)]
    for estimator in estimators:
        for node, x in zip(NODES.tolist(), START, strict=True):
            estimator.add([node], [x], [np.diag([1.0, 1.0, 1.0, 1.0, 0.04][: len(x)])])
        estimator.predict(discretise(scene(), 0.3))
    assert difference(*estimators) < 1e-9


def test_late_measurements_split_the_interval_with_its_laws():
    whole, parted = GraphFilter(lag=5.0), GraphFilter(lag=5.0)
    for smoother, steps in ((whole, (0.2, 0.2)), (parted, (0.4,))):
        for node, x in zip(NODES.tolist(), START, strict=True):
            smoother.add([node], [x], [np.diag([1.0, 1.0, 1.0, 1.0, 0.04][: len(x)])])
        for dt in steps:
            smoother.predict(discretise(scene(), dt))
        smoother.update(Measurements([11], [[-9.0, -1.0]], np.eye(2, 5), 0.04 * np.eye(2)), time=0.2)
    assert difference(parted, whole) < 1e-9


def test_a_flow_is_the_motion_the_law_and_the_linear_edges():
    """The bicycle: motion and law; the first car: motion alone; going straight, the second one: the transition."""
    graph = scene()
    moved, dt = {}, 0.2
    for flow in nonlinear_dynamics(discretise(graph, dt)):
        columns = [np.stack([START[r] for r in rows]) for rows in flow.rows.T]
        moved.update(zip(flow.rows[:, 0].tolist(), flow.predict(columns), strict=True))
    assert sorted(moved) == [0, 1, 2, 3, 4, 6]
    np.testing.assert_allclose(moved[0], CAR.motion.flow(np.array(START[0]), dt), atol=1e-12)  # type: ignore[attr-defined]
    van, leader = np.array(START[2]), np.array(START[1])
    a = SmoothDriver().accelerations(van[:4], leader[:4], np.array(3.5)).value
    pushed = np.concatenate([dt * dt / 2 * a, dt * a, [0.0]])
    np.testing.assert_allclose(moved[2], VAN.motion.flow(van, dt) + pushed, atol=1e-12)  # type: ignore[attr-defined]
    straight = [*START[1][:4], 0.0]
    linear = discretise(SceneGraph(graph.nodes, graph.types, graph.edges), dt)
    (flow,) = (f for f in nonlinear_dynamics(linear) if f.rows.shape[1] == 2)
    x = flow.predict([np.array([straight]), np.array([START[0]])])[0]
    joint = np.concatenate([START[0], straight, *START[2:]])
    np.testing.assert_allclose(x, (linear.F_matrix @ joint + linear.b)[5:10], atol=1e-12)


@pytest.mark.parametrize("name", BACK_ENDS)
@pytest.mark.parametrize("what", ["nan", "shape", "raises"])
def test_a_law_that_fails_is_one_clear_error_after_which_all_goes_on(name, what):
    class Broken(SmoothDriver):
        def accelerations(self, own, other, given):
            good = super().accelerations(own, other, given)
            if what == "raises":
                raise ZeroDivisionError("by me")
            return good._replace(value=good.value * np.nan) if what == "nan" else good._replace(by_own=good.value)

    estimator = BACK_ENDS[name]()
    estimator.add([0, 1], [[0.0, 0.0, 8.0, 0.0], [12.0, 0.0, 8.0, 0.0]], [np.eye(4)] * 2)
    edges = NonlinearEdges(Broken(), [0], [1], [1.0], [4.0])
    broken = discretise(SceneGraph(np.arange(2), (WALKER,) * 2, nonlinear=(edges,)), 0.1)
    with pytest.raises(SagaError, match="law Broken"):
        estimator.predict(broken)
    estimator.predict(discretise(SceneGraph.of([0, 1], WALKER), 0.1))
    assert estimator.mean([0])[0, 0] == pytest.approx(0.8)


def test_bad_edges_are_refused(subtests):
    for change, message in [
        ({"rate": [-1.0]}, "a rate >= 0"),
        ({"rate": [np.nan]}, "finite"),
        ({"source": [0]}, "itself"),
        ({"given": [np.inf]}, "finite"),
        ({"given": [1.0, 2.0]}, "shape"),
        ({"source": [9]}, "row 9 is outside 2 nodes"),
    ]:
        with subtests.test(message):
            good = {"target": [0], "source": [1], "rate": [1.0], "given": [4.0]}
            with pytest.raises(InputError, match=message):
                SceneGraph(
                    np.arange(2), (WALKER,) * 2, nonlinear=(NonlinearEdges(SmoothDriver(), **{**good, **change}),)
                )
