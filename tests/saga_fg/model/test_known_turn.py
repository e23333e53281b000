"""Turns of known rate: linear motion along an arc, recorded with the interval."""

import numpy as np
import pytest

from saga_fg import ConstantAcceleration, ConstantVelocity, NodeType, SceneGraph
from saga_fg.model.discretisation import discretise
from saga_fg.model.interactions import POSITION, VELOCITY, SharedVelocity
from saga_fg.model.known_turn import KnownTurns, turns_as_known
from saga_fg.model.modes import Mixture
from saga_fg.model.scene_graph import Edges
from saga_fg.model.turning import CoordinatedTurn
from tests.saga_fg.random_graphs import node_table

CAR = NodeType("car", ConstantVelocity(acceleration_noise=1.5))
TRAM = NodeType("tram", ConstantAcceleration(jerk_noise=0.7, fading_time=2.0))
LONG = 1e9  # s, as good as no fading


def turning(node_type, rate, fading_time=LONG):
    graph = SceneGraph.of([7], node_type)
    return SceneGraph(graph.nodes, graph.types, modes=(KnownTurns(node_type, graph.nodes, rate, fading_time),))


@pytest.mark.parametrize("rate", [0.0, 1e-9, 0.3, -0.8])
@pytest.mark.parametrize("dt", [0.1, 0.5, 2.0])
def test_without_fading_it_is_the_coordinated_turn(rate, dt):
    x = np.array([3.0, -1.0, 8.0, 2.0])
    step = discretise(turning(CAR, np.array([rate])), dt)
    expected = CoordinatedTurn().flow(np.append(x, rate), dt)[:4]
    assert step.F[0].values[0] @ x == pytest.approx(expected, abs=1e-6)
    assert step.Q[0].values == pytest.approx(discretise(SceneGraph.of([7], CAR), dt).Q[0].values)


@pytest.mark.parametrize("node_type", [CAR, TRAM])
def test_rate_zero_is_the_motion_of_the_type(node_type):
    step, plain = (discretise(g, 0.4) for g in (turning(node_type, np.zeros(1)), SceneGraph.of([7], node_type)))
    assert step.F_matrix.toarray() == pytest.approx(plain.F_matrix.toarray(), abs=1e-12)
    assert step.Q[0].values == pytest.approx(plain.Q[0].values, abs=1e-12)


def test_the_speed_is_kept_and_the_whole_turn_is_rate_times_time_constant():
    step = discretise(turning(CAR, np.array([0.2]), fading_time=1.5), 60.0)
    v = step.F[0].values[0][2:, 2:] @ [10.0, 0.0]
    assert v == pytest.approx(10 * np.array([np.cos(0.3), np.sin(0.3)]))


@pytest.mark.parametrize("node_type", [CAR, TRAM])
def test_two_half_steps_turn_as_one(node_type):
    graph, dt = turning(node_type, np.array([0.4]), fading_time=1.5), 0.4
    halves = discretise(graph.after(dt / 2), dt / 2).F_matrix @ discretise(graph, dt / 2).F_matrix
    whole = discretise(graph, dt).F_matrix.toarray()
    assert whole[2:4, 2:4] == pytest.approx(halves.toarray()[2:4, 2:4], abs=1e-12)
    assert whole == pytest.approx(halves.toarray(), abs=2e-3)


def test_edges_act_on_the_velocity_of_turning_nodes():
    """An edge that takes over the neighbour's velocity at once leaves nothing of the node's own."""
    nodes = node_table(np.random.default_rng(0), (CAR, CAR), ids=[7, 8])
    one = np.array([0]), np.array([1])
    edges = Edges("shared_velocity", *one, np.array([200.0]), *SharedVelocity().triples(nodes, *one))
    modes = (KnownTurns(CAR, np.array([7]), np.array([0.5]), 1.5),)
    F = discretise(SceneGraph(np.array([7, 8]), (CAR, CAR), (edges,), modes=modes), 0.5).F_matrix.toarray()
    at = CAR.index(VELOCITY)
    assert F[at][:, at] == pytest.approx(np.zeros((2, 2)), abs=1e-12)
    assert F[at][:, 4 + at] == pytest.approx(np.eye(2), abs=1e-9)
    assert F[CAR.index(POSITION)][:, CAR.index(POSITION)] == pytest.approx(np.eye(2))


def test_motions_that_turn_by_themselves_do_not_turn_twice():
    assert turns_as_known(CAR)
    assert turns_as_known(TRAM)
    assert not turns_as_known(NodeType("car", CoordinatedTurn()))
    assert not turns_as_known(NodeType("car", Mixture()))


def on_course(node_type, rate, course, course_rate):
    graph = SceneGraph.of([7], node_type)
    one = (np.array([each], dtype=float) for each in (rate, course, course_rate))
    turn, course, fades = one
    return SceneGraph(graph.nodes, graph.types, modes=(KnownTurns(node_type, graph.nodes, turn, LONG, course, fades),))


def test_what_is_across_the_course_fades_and_what_is_along_stays():
    """On a straight course: the velocity across fades like exp(-k t), and moves the object by its integral."""
    F = discretise(on_course(CAR, 0.0, 0.0, 2.0), 0.5).F[0].values[0]
    left = (1 - np.exp(-1.0)) / 2.0
    assert pytest.approx([5.0, left, 10.0, np.exp(-1.0)]) == F @ [0, 0, 10.0, 1.0]


def test_on_a_bend_the_course_turns_with_the_velocity():
    """Who moves along the course has the motion of the turn alone, and keeps the speed."""
    course = 0.7
    x = np.array([1.0, 2.0, 8 * np.cos(course), 8 * np.sin(course)])
    plain, led = (
        discretise(g, 0.5).F[0].values[0] for g in (turning(CAR, np.array([0.4])), on_course(CAR, 0.4, course, 2))
    )
    assert led @ x == pytest.approx(plain @ x)
    assert np.hypot(*(led @ x)[2:]) == pytest.approx(8.0)


@pytest.mark.parametrize("node_type", [CAR, TRAM])
def test_two_half_steps_along_a_course_are_as_one(node_type):
    graph, dt = on_course(node_type, 0.4, -0.3, 1.5), 0.2
    halves = discretise(graph.after(dt / 2), dt / 2).F_matrix @ discretise(graph, dt / 2).F_matrix
    whole = discretise(graph, dt).F_matrix.toarray()
    at = node_type.index(VELOCITY)
    assert whole[at][:, at] == pytest.approx(halves.toarray()[at][:, at], abs=1e-12)
    assert whole == pytest.approx(halves.toarray(), abs=2e-3)


def test_a_course_that_nothing_fades_on_changes_nothing():
    plain, led = (
        discretise(g, 0.5).F_matrix.toarray() for g in (turning(CAR, np.array([0.4])), on_course(CAR, 0.4, 1, 0))
    )
    assert led == pytest.approx(plain, abs=1e-8)
