"""Turning objects, and known courses. Coordinated turn: exact discretisation, smooth where it goes straight."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import scipy.integrate

from factors import Vector
from factors.manifolds import central_differences
from saga_fg import ConstantAcceleration, ConstantVelocity, Curvilinear, NodeType, SceneGraph
from saga_fg.conformance.programs import node_table
from saga_fg.model.discretisation import discretise, linear_motions
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.manoeuvres import RATE_CORRELATION, CoordinatedTurn, KnownCourses, Unseen, turning_time
from saga_fg.model.scene_graph import Edges

TURN = CoordinatedTurn()
SMALL = (0.0, 0.0099, 0.0101, -2.0)


def states(last, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=(6, 4)) * [50, 50, 9, 9], np.full((6, 1), last)], axis=1)


@pytest.mark.parametrize("last", [0.0, 0.001, -0.4, 0.9])
def test_the_flow_solves_its_differential_equation(last):
    x = states(last)[0]
    solved = scipy.integrate.solve_ivp(
        lambda t, y: [*y[2:4], *(y[4] * np.array([-y[3], y[2]])), 0.0], (0.0, 0.7), x, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(TURN.flow(x, 0.7), solved.y[:, -1], atol=1e-9)


@pytest.mark.parametrize("last", SMALL)
def test_jacobians_are_the_derivatives(last):
    x = states(last)
    (expected,) = central_differences(lambda y: TURN.flow(y, 0.3), [x], [Vector(x.shape[-1])])
    np.testing.assert_allclose(TURN.flow_jacobian(x, 0.3), expected, atol=2e-8)
    np.testing.assert_allclose(TURN.flow(TURN.flow(x, 0.1), 0.2), TURN.flow(x, 0.3), atol=1e-12)
    np.testing.assert_allclose(TURN.flow(TURN.flow(x, 0.3), -0.3), x, atol=1e-12)


def test_turns_are_coordinated_or_straight_and_keep_their_speed(subtests):
    turning, straight = NodeType("turning", TURN), NodeType("straight", ConstantVelocity(2.0))
    x = states(0.0)[0]
    (F,), (Q,) = ([b.values[0] for b in blocks] for blocks in _linear(straight))
    np.testing.assert_allclose(TURN.flow(x, 0.4)[:4], F @ x[:4], atol=1e-12)
    np.testing.assert_allclose(_linear(turning)[1][0].values[0][:4, :4], Q, atol=1e-12)
    assert turning.initial_deviation[4] < 1
    for rate, dt in product([0.0, 1e-9, 0.3, -0.8], [0.1, 0.5, 2.0]):
        with subtests.test(rate=rate, dt=dt):
            x = np.array([3.0, -1.0, 8.0, 2.0])
            car = NodeType("car", Curvilinear(turn_time=LONG))
            F, b, _ = own(course(car, rate=rate), dt, car)
            assert F[:4, :4] @ x + b[:4] == pytest.approx(CoordinatedTurn().flow(np.append(x, rate), dt)[:4], abs=1e-6)
    v = own(course(CAR, rate=0.2), 60.0)[0][V, V] @ [10.0, 0.0]
    assert v == pytest.approx(10 * np.array([np.cos(0.3), np.sin(0.3)]))


def _linear(node_type):
    transition = discretise(SceneGraph.of([0], node_type), 0.4)
    return transition.F, transition.Q


# Curvilinear motion along known courses: linear motion along an arc, recorded with the interval

LONG = 1e9  # s, as good as no fading
MOTION = Curvilinear(turn_time=1.5, fading_time=2.0, jerk_noise=0.7, lateral_acceleration_noise=0.2)
CAR = NodeType("car", MOTION)
P, V, A = slice(0, 2), slice(2, 4), slice(4, 6)


def course(node_type, heading=0.0, rate=0.0, rate_variance=0.0, mean=(0, 0, 8, 0, 0, 0), dt=0.4):
    angle, turn, variance = (np.array([float(value)]) for value in (heading, rate, rate_variance))
    return KnownCourses.from_turn_rates(
        node_type, np.array([7]), angle, turn, variance, np.array([mean], dtype=float), dt
    )


def along(record, node_type=CAR):
    graph = SceneGraph.of([7], node_type)
    return replace(graph, motions=(record,))


def own(record, dt, node_type=CAR):
    """F, b and Q of the node."""
    step = discretise(along(record, node_type), dt)
    return step.F[0].values[0], step.b, step.Q[0].values[0]


def noise_of(generator, diffusion, dt):
    """Q of one axis."""
    return linear_motions(generator[None], diffusion[None], dt)[1][0]


def test_the_turn_of_a_path_is_made_however_turns_fade(subtests):
    for turn_time, dt in product([0.0, 1.5, LONG], [0.1, 0.5]):
        with subtests.test(turn_time=turn_time, dt=dt):
            motion = Curvilinear(turn_time=turn_time)
            F, _, _ = own(course(car := NodeType("car", motion), rate=0.3 / turning_time(motion, dt), dt=dt), dt, car)
            assert F[V, V] @ [8.0, 0.0] == pytest.approx([8 * np.cos(0.3), 8 * np.sin(0.3)], abs=1e-6)


def test_the_acceleration_acts_along_the_heading_alone(subtests):
    for heading in [0.0, 0.7, -2.5]:
        with subtests.test(heading=heading):
            u = np.array([np.cos(heading), np.sin(heading)])
            F, _, _ = own(course(CAR, heading), 0.4)
            straight = discretise(SceneGraph.of([7], CAR), 0.4).F[0].values[0]
            x = np.concatenate([np.zeros(2), 8 * u, 2 * u])
            assert F @ x == pytest.approx(straight @ x), "along it, as a fading acceleration does"
            gone = F[:, A] @ [-u[1], u[0]]
            assert np.abs(gone) == pytest.approx(np.zeros(6), abs=0.1), "across it, hardly for 0.1 s"
            assert gone[A] == pytest.approx(np.zeros(2), abs=0.02)


@pytest.mark.parametrize("heading", [0.0, 1.1])
def test_the_noise_differs_along_and_across_the_heading(heading):
    dt, variance, speed = 0.4, 0.01, 8.0
    c, s = np.cos(heading), np.sin(heading)
    mean = np.concatenate([np.zeros(2), [speed * c, speed * s], np.zeros(2)])
    _, _, Q = own(course(CAR, heading, rate_variance=variance, mean=mean), dt)
    turn = np.kron(np.eye(3), [[c, -s], [s, c]])
    in_frame = turn.T @ Q @ turn
    generator, diffusion = MOTION.across
    diffusion[1, 1] += 2 * RATE_CORRELATION * variance * speed**2
    assert in_frame[::2, ::2] == pytest.approx(noise_of(*MOTION.along, dt))
    assert in_frame[1::2, 1::2] == pytest.approx(noise_of(generator, diffusion, dt))
    assert in_frame[::2, 1::2] == pytest.approx(np.zeros((3, 3)), abs=1e-12)


def test_along_the_heading_it_is_singers_model_with_white_acceleration():
    fading = NodeType("car", ConstantAcceleration(MOTION.jerk_noise, MOTION.fading_time))
    F, _, Q = own(course(CAR), 0.4)
    singer = discretise(SceneGraph.of([7], fading), 0.4)
    assert F[::2, ::2] == pytest.approx(singer.F[0].values[0][::2, ::2])
    white = Q[::2, ::2] - singer.Q[0].values[0][::2, ::2]
    assert white[:2, :2] == pytest.approx(
        MOTION.acceleration_noise * np.array([[0.4**3 / 3, 0.4**2 / 2], [0.4**2 / 2, 0.4]])
    )
    assert white[2] == pytest.approx(np.zeros(3))


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_braking_ends_at_standstill(heading):
    """A vehicle that would reverse within the interval keeps its speed; one that is faster brakes on."""
    u, dt = np.array([np.cos(heading), np.sin(heading)]), 0.5
    for speed, brakes_on in ((0.4, False), (4.0, True)):
        x = np.concatenate([np.zeros(2), speed * u, -2 * u])
        F, b, _ = own(course(CAR, heading, mean=x, dt=dt), dt)
        after = (F @ x + b)[V] @ u
        assert (after < speed - 0.5) if brakes_on else after == pytest.approx(speed)
        assert (F @ x + b)[A] @ u == pytest.approx((F @ x)[A] @ u if brakes_on else 0.0)


def test_edges_act_on_the_velocity_of_turning_nodes():
    """An edge that takes over the neighbour's velocity at once leaves nothing of the node's own."""
    nodes = node_table(np.random.default_rng(0), (CAR, CAR), ids=[7, 8])
    one = np.array([0]), np.array([1])
    edges = Edges("shared_velocity", *one, np.array([200.0]), *SharedVelocity().triples(nodes, *one))
    graph = SceneGraph(np.array([7, 8]), (CAR, CAR), (edges,), motions=(course(CAR, rate=0.5),))
    F = discretise(graph, 0.5).F_matrix.toarray()
    assert F[V, V] == pytest.approx(np.zeros((2, 2)), abs=1e-9)
    assert F[V, 8:10] == pytest.approx(np.eye(2), abs=1e-9)
    assert F[P, P] == pytest.approx(np.eye(2))


def test_some_nodes_are_selected():
    heading, rate, variance = np.arange(9.0).reshape(3, 3)
    record = KnownCourses.from_turn_rates(CAR, np.array([1, 2, 3]), heading, rate, variance, np.zeros((3, 6)), 0.1)
    chosen = record.select(np.array([2, 0]))
    assert chosen.ids.tolist() == [3, 1]
    assert chosen.rate.tolist() == [5.0, 3.0]
    assert chosen.node_type is CAR


def settled(record, k):
    return replace(record, settling=np.full(1, k))


def test_what_is_across_the_course_fades_the_same_in_one_step_or_two():
    """On a straight course the velocity across fades like exp(-k t), and moves the vehicle by its integral."""
    F = own(settled(course(CAR), 2.0), 0.5)[0]
    after = F @ [0, 0, 10.0, 1.0, 0, 0]
    assert after[P] == pytest.approx([5.0, (1 - np.exp(-1.0)) / 2])
    assert after[V] == pytest.approx([10.0, np.exp(-1.0)])
    graph, dt = along(settled(course(CAR, rate=0.4), 1.5)), 0.2
    halves = discretise(graph.after(dt / 2), dt / 2).F_matrix @ discretise(graph, dt / 2).F_matrix
    whole = discretise(graph, dt).F_matrix.toarray()
    assert whole[V, V] == pytest.approx(halves.toarray()[V, V], abs=1e-9)
    assert whole == pytest.approx(halves.toarray(), abs=1e-2)


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_along_the_course_of_a_bend_settling_changes_nothing(heading):
    x = np.concatenate([[1.0, 2.0], 8 * np.array([np.cos(heading), np.sin(heading)]), np.zeros(2)])
    plain = course(CAR, heading, rate=0.4)
    expected = own(plain, 0.4)[0] @ x
    assert own(settled(plain, 2.0), 0.4)[0] @ x == pytest.approx(expected)
    assert own(settled(plain, 0.0), 0.4)[0] == pytest.approx(own(plain, 0.4)[0], abs=1e-7)


def test_an_uncertain_course_keeps_its_variance_across():
    """At last the velocity across has the variance s^2, besides that of the lateral acceleration."""
    speed, k, variance, dt = 8.0, 1.5, 0.64, 0.01
    quiet = NodeType("car", Curvilinear(acceleration_noise=0.0, lateral_acceleration_noise=0.0, jerk_noise=0.0))
    none, mean = np.zeros(1), np.array([[0, 0, speed, 0, 0, 0]])
    unseen = Unseen(np.array([k]), np.array([variance]), none)
    record = KnownCourses.from_turn_rates(quiet, np.array([7]), none, none, none, mean, dt, unseen)
    F, _, Q = own(record, dt, quiet)
    P_across = 0.0
    for _ in range(1000):
        P_across = F[3, 3] ** 2 * P_across + Q[3, 3]
    assert P_across == pytest.approx(variance, rel=0.05)


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_an_acceleration_to_the_speed_of_traffic_acts_along_the_course(rate):
    """The mean gains pull dt of speed and pull dt^2 / 2 of way; the covariance is that without it."""
    dt, pull = 0.1, np.array([-1.5])
    quiet = NodeType("car", Curvilinear())
    none, mean = np.zeros(1), np.array([[0, 0, 8.0, 0, 0, 0]])
    with_it, without = (
        own(
            KnownCourses.from_turn_rates(
                quiet, np.array([7]), none, none + rate, none, mean, dt, Unseen(none, none, p)
            ),
            dt,
            quiet,
        )
        for p in (pull, none)
    )
    for a, b in ((with_it[0], without[0]), (with_it[2], without[2])):
        assert np.array_equal(a, b)
    change = with_it[1] - without[1]
    assert np.hypot(*change[2:4]) == pytest.approx(1.5 * dt)
    assert np.hypot(*change[:2]) == pytest.approx(1.5 * dt**2 / 2, rel=0.01)
    assert change[2:4] @ [np.cos(rate * dt), np.sin(rate * dt)] == pytest.approx(-1.5 * dt, rel=1e-3)
