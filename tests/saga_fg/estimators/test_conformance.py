"""Every estimator, one suite: equal to the textbook, indifferent to order, and not to be broken by what it is told.

To test an estimator, add it to `ESTIMATORS`. Figures (`docs/model.md`): means agree with the textbook to 1e-9 posterior
standard deviations, covariances to 1e-9 relative in the Frobenius norm. Where a measurement is better than what was
known before by nearly as much as double precision has digits, these are lost, and the test allows for as many.
"""

import dataclasses
import subprocess
import sys
import textwrap

import gtsam
import numpy as np
import pytest

from factors import SolverSettings
from saga_fg import Edges, InputError, SagaError, SceneGraph, UnknownNodeError
from saga_fg.estimators import BatchSolver, GraphFilter, IncrementalFilter, JointKalmanFilter, Measurements
from saga_fg.graph import SceneFactorGraph
from saga_fg.graph.keys import node_key
from saga_fg.model.discretisation import discretise
from saga_fg.model.known_course import KnownCourses
from saga_fg.model.transition import Blocks
from tests.saga_fg.estimator_programs import (
    Add,
    Marginalise,
    Predict,
    TextbookEstimator,
    Update,
    new_nodes,
    random_program,
    run,
)
from tests.saga_fg.estimator_scenario import Textbook, admissible, assert_smoothed, random_scenario, tell
from tests.saga_fg.graph_keys import newest_key
from tests.saga_fg.random_graphs import BUS, CAR, CONE, POLE, TRAM, VAN, random_graph
from tests.saga_fg.road_scenes import road_program

ESTIMATORS = [
    pytest.param("saga_fg.estimators:JointKalmanFilter()", id="kalman"),
    pytest.param("saga_fg.estimators:BoundedKalmanFilter(core=1000)", id="kalman-bounded"),  # by more than there is
    pytest.param("saga_fg.estimators:IncrementalFilter()", id="isam2"),
    pytest.param("saga_fg.estimators:FixedLagSmoother(0.0)", id="fixed-lag-0"),
    pytest.param("saga_fg.estimators:FixedLagSmoother(1.0)", id="fixed-lag"),
    pytest.param("saga_fg.estimators:BatchSmoother()", id="batch"),
    pytest.param("saga_fg.estimators:GraphFilter()", id="graph"),
    pytest.param("saga_fg.estimators:GraphFilter(lag=1.0)", id="graph-lag"),
]
TOLERANCE = 1e-9


@pytest.fixture(params=ESTIMATORS)
def make(request):
    """Makes fresh estimators of the kind under test."""
    return maker(request.param)


@pytest.fixture(params=ESTIMATORS)
def recipe(request):
    """Code that makes an estimator, as text, for another interpreter."""
    return request.param


def maker(recipe):
    module, expression = recipe.split(":")
    return lambda: eval(expression, vars(__import__(module, fromlist=["_"])))


SMOOTHERS = [kind for kind in ESTIMATORS if hasattr(maker(kind.values[0])(), "smoothed")]


@pytest.fixture(params=SMOOTHERS)
def make_smoother(request):
    """Makes fresh estimators of those kinds that tell of earlier moments too."""
    return maker(request.param)


def assert_equal(estimator, textbook, tolerance=TOLERANCE):
    """Means within `tolerance` posterior sigmas, joint covariance within `tolerance` relative."""
    nodes = textbook.nodes
    assert sorted(estimator.nodes.tolist()) == sorted(nodes.tolist())
    if len(nodes) == 0:
        return
    P = textbook.joint_covariance(nodes)
    sigma = np.sqrt(np.diag(P))
    assert np.abs((estimator.joint_mean(nodes) - textbook.joint_mean(nodes)) / sigma).max() <= tolerance
    difference = estimator.joint_covariance(nodes) - P
    assert np.linalg.norm(difference) <= tolerance * np.linalg.norm(P)
    for node in nodes.tolist():
        own = textbook.covariance([node])[0]
        assert np.linalg.norm(estimator.covariance([node])[0] - own) <= tolerance * np.linalg.norm(own)
        assert (
            np.abs(estimator.mean([node])[0] - textbook.mean([node])[0]).max()
            <= tolerance * np.sqrt(np.diag(own)).max()
        )


def in_step(program, estimator, tolerance=TOLERANCE, textbook=None):
    """Run a program on an estimator and the textbook, comparing after every operation."""
    textbook = textbook or TextbookEstimator()
    for operation in program:
        expected = operation.run(textbook)
        result = operation.run(estimator)
        if expected is not None:
            assert result == pytest.approx(expected, rel=tolerance, abs=tolerance * 10)
        assert_equal(estimator, textbook, tolerance)
    return textbook


# equal to the textbook


@pytest.mark.parametrize("seed", range(25))
def test_random_programs_agree_with_the_textbook(make, seed):
    """Changing graphs of nodes of mixed sizes, several sensors, misses, new and leaving nodes, irregular intervals."""
    in_step(random_program(np.random.default_rng(seed), moments=7), make())


@pytest.mark.parametrize("seed", range(4))
def test_a_long_program_does_not_drift_away(make, seed):
    in_step(random_program(np.random.default_rng(100 + seed), moments=40, kinds=(CAR, TRAM), density=0.15), make())


@pytest.mark.parametrize("seed", range(8))
def test_nodes_that_turn_agree_with_the_textbook(make, seed):
    """Courses with known headings and turn rates, recorded with every interval."""
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=7, kinds=(CAR, VAN, CONE))
    in_step([with_courses(rng, operation) for operation in program], make())


def with_courses(rng, operation):
    """A prediction in which some of the vans have a known course, and some of these brake to a stop."""
    if not isinstance(operation, Predict):
        return operation
    graph, dt = operation.transition.graph, operation.transition.dt
    ids = graph.nodes[[k for k, t in enumerate(graph.types) if t is VAN and rng.random() < 0.7]]
    heading, rate, variance = rng.normal(0, (2.0, 0.4, 0.1), (len(ids), 3)).T
    record = KnownCourses.of(VAN, ids, heading, rate, variance**2, rng.normal(0, 2, (len(ids), 6)), dt)
    return Predict(discretise(dataclasses.replace(graph, modes=(record,)), dt))


@pytest.mark.parametrize("dt", [0.0, 1e-6, 1e-3])
def test_tiny_intervals(make, dt):
    """At dt = 0 nothing moves and there is no process noise."""
    rng = np.random.default_rng(3)
    in_step(random_program(rng, moments=6, intervals=(dt, 0.4)), make())


@pytest.mark.parametrize("seed", range(10))
def test_milliseconds_beside_seconds(make, seed):
    """Nodes of all kinds: the noise of constant acceleration falls with the fifth power of the interval."""
    in_step(random_program(np.random.default_rng(seed), moments=9, intervals=(1e-3, 0.05, 1.0)), make())


@pytest.mark.parametrize("seed", range(3))
def test_a_thousand_seconds_without_a_word(make, seed):
    """Nodes that are measured just before and after a long gap.

    The prior is then up to 1e10 times as uncertain as the measurement. Of P - W^T W that loses ten digits; estimators
    are allowed the digits that are lost, and no more.
    """
    rng = np.random.default_rng(seed)
    estimator, textbook = make(), TextbookEstimator()
    program = random_program(rng, moments=3, kinds=(CAR, CONE))
    in_step(program, estimator, textbook=textbook)
    nodes = textbook.nodes
    types = tuple(CAR if textbook.mean([n]).shape[1] == 4 else CONE for n in nodes.tolist())
    gap = Predict(discretise(random_graph(rng, types, nodes, arbitrary=False), 1000.0))
    in_step([gap], estimator, textbook=textbook)
    before = np.diag(textbook.joint_covariance(nodes)).max()
    seen = nodes[[t is CAR for t in types]]
    z = textbook.mean(seen)[:, :2] + rng.normal(size=(len(seen), 2))
    update = Update(Measurements(seen, z, np.eye(2, 4), 0.1 * np.eye(2)))
    after = 0.1
    in_step([update], estimator, max(TOLERANCE, 20 * np.finfo(float).eps * before / after), textbook)
    assert (np.linalg.eigvalsh(estimator.joint_covariance(nodes)) > 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_nodes_that_stand_still_for_ever(make, seed):
    """Stop lines and poles have no process noise: Q is singular."""
    rng = np.random.default_rng(40 + seed)
    in_step(random_program(rng, moments=7, kinds=(CAR, POLE)), make())


@pytest.mark.parametrize("seed", range(4))
def test_a_scene_of_lights_lanes_cones_and_trailers(make, seed):
    """Standing and moving nodes whose edges go between kinds, with rates that follow the belief on a light."""
    rng = np.random.default_rng(seed)
    in_step(road_program(rng), make())


@pytest.mark.parametrize("seed", range(3))
def test_measurements_far_better_than_the_prior(make, seed):
    rng = np.random.default_rng(seed)
    prior = Add(np.array([1, 2]), rng.normal(size=(2, 4)) * 1e3, np.stack([1e6 * np.eye(4)] * 2))
    sharp = Update(Measurements(np.array([1]), np.array([[3.0, 4.0]]), np.eye(2, 4), 1e-2 * np.eye(2)))
    tolerance = max(TOLERANCE, 20 * np.finfo(float).eps * 1e6 / 1e-2)
    in_step([prior, sharp], make(), tolerance)


@pytest.mark.parametrize("seed", range(6))
def test_numbers_without_a_digit_left_do_no_harm(make, seed):
    """Interactions that drive variances beyond 1e80 within the gap: an answer or an exception, and life goes on."""
    rng = np.random.default_rng(seed)
    estimator = make()
    nodes = np.arange(4)
    new_nodes(rng, nodes.tolist(), CAR).run(estimator)
    target, source = np.array([0, 1, 2, 3, 0, 1]), np.array([1, 0, 3, 2, 2, 3])
    apart = rng.normal(size=(6, 4, 4)) + np.eye(4)
    edges = Edges("repulsion", target, source, np.full(6, 0.05), apart, -apart[::-1], np.zeros((6, 4)))
    try:
        estimator.predict(discretise(SceneGraph.of(nodes, CAR, [edges]), 300.0))
    except SagaError:
        assert estimator.time == 0.0
    before = estimator.joint_mean(nodes), estimator.joint_covariance(nodes)
    try:
        estimator.update(Measurements(nodes, np.zeros((len(nodes), 2)), np.eye(2, 4), 0.1 * np.eye(2)))
    except SagaError:
        assert np.array_equal(estimator.joint_mean(nodes), before[0])
        assert np.array_equal(estimator.joint_covariance(nodes), before[1])
    estimator.marginalise(nodes)
    in_step([new_nodes(rng, [901, 902], CAR), Update(measured([901]))], estimator)


@pytest.mark.parametrize("seed", range(8))
def test_every_moment_is_smoothed_as_by_rauch_tung_striebel(make_smoother, seed):
    """Moments in the smoother's window agree after every operation of a random program."""
    smoother, textbook = make_smoother(), TextbookEstimator()
    for operation in random_program(np.random.default_rng(200 + seed), moments=6):
        operation.run(smoother)
        operation.run(textbook)
        moments = smoother.smoothed()
        assert len(moments) > 0
        for moment, reference in zip(moments[::-1], textbook.smoothed()[::-1], strict=False):
            assert set(reference) <= set(moment.nodes.tolist())
            for node, (mean, P) in reference.items():
                assert np.abs((moment.mean([node])[0] - mean) / np.sqrt(np.diag(P))).max() <= TOLERANCE
                assert np.linalg.norm(moment.covariance([node])[0] - P) <= TOLERANCE * np.linalg.norm(P)


@pytest.mark.parametrize("seed", range(6))
def test_late_measurements_change_the_past_as_if_they_had_come_in_time(make_smoother, seed):
    """At any time within the window, also between two moments: the interval is split, its graph kept."""
    smoother, textbook, late = make_smoother(), Textbook(), 0
    for call in random_scenario(np.random.default_rng(300 + seed), late=0.5).calls:
        if admissible(textbook, call, getattr(smoother, "start", 0.0)):
            tell(textbook, [call])
            tell(smoother, [call])
            if call[0] == "update" and call[2] is not None:
                late += 1
                assert_smoothed(smoother.smoothed(), textbook, joint=False)
    assert late > 0 or getattr(smoother, "lag", 1.0) == 0.0
    assert_smoothed(smoother.smoothed(), textbook, joint=False)


def zeros(values):
    """Vectors of zeros."""
    result = gtsam.Values()
    for key in values.keys():  # noqa: SIM118 -- gtsam.Values is no dict
        result.insert(key, np.zeros_like(values.atVector(key)))
    return result


@pytest.mark.parametrize("seed", range(3))
def test_gtsam_solves_the_estimators_graph_to_the_same_answer(make, seed):
    """GTSAM's own optimiser, from zero: by QR it agrees to 1e-7 of a standard deviation.

    Its marginals go by Cholesky, which squares the condition. With Q as small as dt^5 of an acceleration that costs
    digits, so that intervals are not too short here and covariances agree to 1e-6.
    """
    program = random_program(np.random.default_rng(seed), moments=5, intervals=(0.3, 0.5, 1.2))
    estimator, _ = run(program, make())
    equivalent = estimator.graph()
    if isinstance(equivalent, SceneFactorGraph):
        own = equivalent.copy()
        own.moved_to(zeros(own.values))
        own.solve(SolverSettings(tolerance=1e-10))
        for node in estimator.nodes.tolist():
            x, P = own.state(node_key(node, own.epoch)), estimator.covariance([node])[0]
            assert np.abs((x - estimator.mean([node])[0]) / np.sqrt(np.diag(P))).max() < 1e-7
        return
    start = zeros(equivalent.values)
    settings = gtsam.GaussNewtonParams()
    settings.setLinearSolverType("MULTIFRONTAL_QR")
    solved = gtsam.GaussNewtonOptimizer(equivalent.native(), start, settings).optimize()
    marginals = gtsam.Marginals(equivalent.native(), solved)
    for node in estimator.nodes.tolist():
        key, P = newest_key(equivalent, node), estimator.covariance([node])[0]
        for values in (solved, equivalent.values):
            assert np.abs((values.atVector(key) - estimator.mean([node])[0]) / np.sqrt(np.diag(P))).max() < 1e-7
        assert np.linalg.norm(marginals.marginalCovariance(key) - P) < 1e-6 * np.linalg.norm(P)


@pytest.mark.parametrize("seed", range(3))
def test_the_batch_solver_solves_the_estimators_graph_to_the_same_answer(make, seed):
    """Its graph is a running graph: nodes of a map by their kind, moments by their time, poles with one variable."""
    estimator, _ = run(random_program(np.random.default_rng(seed), moments=6), make())
    estimator.add([-4], np.array([[3.0, 1.0]]), 0.1 * np.eye(2)[None])
    solver = BatchSolver(graph=estimator.graph())
    for node in estimator.nodes.tolist():
        key, P = newest_key(estimator.graph(), node), estimator.covariance([node])[0]
        assert np.abs((solver.state(key) - estimator.mean([node])[0]) / np.sqrt(np.diag(P))).max() < 5e-9
        assert np.linalg.norm(solver.covariance(key) - P) < 5e-9 * np.linalg.norm(P)
    assert str(solver.graph().variable(key)) == f"map node 4 at {estimator.time:.2f} s"


def test_any_subset_in_any_order_can_be_read(make):
    rng = np.random.default_rng(12)
    estimator, textbook = make(), TextbookEstimator()
    program = random_program(rng, moments=6)
    run(program, estimator)
    run(program, textbook)
    for _ in range(10):
        some = rng.permutation(textbook.nodes)[: int(rng.integers(0, len(textbook.nodes) + 1))]
        P = textbook.joint_covariance(some)
        assert np.allclose(estimator.joint_covariance(some), P, rtol=1e-8, atol=1e-9 * np.abs(P).max(initial=0))
        assert np.allclose(estimator.joint_mean(some), textbook.joint_mean(some), rtol=1e-9, atol=1e-9)
        assert estimator.joint_covariance(some).shape == (len(P), len(P))
    for d in (4, 6):
        same_size = [n for n in textbook.nodes.tolist() if textbook.mean([n]).shape[1] == d]
        assert np.allclose(estimator.mean(same_size), textbook.mean(same_size), rtol=1e-9, atol=1e-9)
        assert np.allclose(estimator.covariance(same_size), textbook.covariance(same_size), rtol=1e-8, atol=1e-9)


def test_what_is_read_is_the_readers_own(make):
    """Writing into an answer, or into what was told, changes nothing."""
    estimator = make()
    mean, covariance = np.ones((1, 4)), np.eye(4)[None].copy()
    estimator.add([1], mean, covariance)
    mean[:], covariance[:] = 7.0, 7.0
    for read in (estimator.mean, estimator.covariance, estimator.joint_mean, estimator.joint_covariance):
        answer = read([1])
        if answer.flags.writeable:
            answer[:] = -5.0
    assert estimator.mean([1]).tolist() == [[1.0] * 4]
    assert estimator.covariance([1])[0].tolist() == np.eye(4).tolist()


def test_an_estimator_of_nothing(make):
    estimator = make()
    assert len(estimator.nodes) == 0
    estimator.predict(discretise(SceneGraph([], ()), 0.5))
    assert estimator.update(Measurements([], np.empty((0, 2)), np.eye(2, 4), np.eye(2))) == 0.0
    estimator.marginalise([])
    estimator.add([], np.empty((0, 4)), np.empty((0, 4, 4)))
    assert estimator.joint_mean([]).shape == (0,)
    assert estimator.joint_covariance([]).shape == (0, 0)
    assert len(estimator.nodes) == 0


def test_a_node_that_left_may_come_back_as_a_new_one(make):
    rng = np.random.default_rng(5)
    program = [
        new_nodes(rng, [1, 2], CAR),
        Predict(discretise(random_graph(rng, (CAR, CAR), [2, 1], 1.0), 0.5)),
        Marginalise(np.array([1])),
        new_nodes(rng, [1], BUS),
        Predict(discretise(random_graph(rng, (BUS, CAR), [1, 2], 1.0), 0.5)),
        Update(Measurements(np.array([1]), np.zeros((1, 2)), np.eye(2, 6), np.eye(2))),
        Marginalise(np.array([1, 2])),
        new_nodes(rng, [2], TRAM),
    ]
    in_step(program, make())


def test_all_nodes_may_leave(make):
    rng = np.random.default_rng(6)
    estimator = make()
    in_step([new_nodes(rng, [1, 2], CAR), Marginalise(np.array([2, 1]))], estimator)
    in_step([new_nodes(rng, [5], CONE), Update(Measurements([5], [[1.0, 2.0]], np.eye(2), np.eye(2)))], estimator)


def test_what_a_node_told_of_its_neighbours_stays_when_it_leaves(make):
    """The leader is seen and leaves; its follower, never seen, keeps what was learnt through it."""
    rng = np.random.default_rng(7)
    told, untold = make(), make()
    for estimator in (told, untold):
        new_nodes(np.random.default_rng(1), [1, 2], CAR).run(estimator)
        graph = random_graph(np.random.default_rng(2), (CAR, CAR), [1, 2], 1.0)
        Predict(discretise(graph, 1.0)).run(estimator)
    told.update(Measurements([1], rng.normal(size=(1, 4)), np.eye(4), 0.01 * np.eye(4)))
    told.marginalise([1])
    untold.marginalise([1])
    assert np.trace(told.covariance([2])[0]) < 0.95 * np.trace(untold.covariance([2])[0])
    assert np.linalg.norm(told.mean([2]) - untold.mean([2])) > 0.01


# indifferent to order, and to coupling where there is none


def permuted(operation, rng):
    """Return the operation with its nodes in another order."""
    if isinstance(operation, Add):
        order = rng.permutation(len(operation.nodes))
        return Add(operation.nodes[order], operation.means[order], operation.covariances[order])
    if isinstance(operation, Marginalise):
        return Marginalise(rng.permutation(operation.nodes))
    if isinstance(operation, Update):
        m = operation.measurements
        order = rng.permutation(len(m))
        return Update(Measurements(m.nodes[order], m.z[order], m.H[order], m.R[order]))
    graph = operation.transition.graph
    order = rng.permutation(len(graph))
    place = np.argsort(order)
    groups = tuple(
        Edges(g.interaction, place[g.target], place[g.source], g.rate, g.A_self, g.A_other, g.b) for g in graph.edges
    )
    types = tuple(graph.types[k] for k in order)
    return Predict(discretise(SceneGraph(graph.nodes[order], types, groups), operation.transition.dt))


@pytest.mark.parametrize("seed", range(6))
def test_the_order_in_which_nodes_are_told_does_not_matter(make, seed):
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=6)
    one, likelihoods = run(program, make())
    other, same_likelihoods = run([permuted(operation, rng) for operation in program], make())
    nodes = one.nodes
    assert sorted(other.nodes.tolist()) == sorted(nodes.tolist())
    assert same_likelihoods == pytest.approx(likelihoods, rel=1e-9)
    P = one.joint_covariance(nodes)
    assert np.linalg.norm(other.joint_covariance(nodes) - P) <= 1e-9 * np.linalg.norm(P)
    assert np.abs(other.joint_mean(nodes) - one.joint_mean(nodes)).max() <= 1e-9 * np.sqrt(np.diag(P)).max()


@pytest.mark.parametrize("seed", range(4))
def test_rate_zero_is_independent_filters_exactly(make, seed):
    """Together or each alone: the same digits, and no correlation between any two.

    iSAM2 solves when it is told something, so that others change how often; its digits are the same to rounding.
    """
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=6, max_rate=0.0)
    together, _ = run(program, make())
    rounding = 1e-11 if isinstance(together, IncrementalFilter | GraphFilter) else 0.0
    for node in together.nodes.tolist():
        alone, _ = run([part for part in (only(operation, node) for operation in program) if part], make())
        assert np.allclose(alone.mean([node]), together.mean([node]), rtol=rounding, atol=rounding)
        assert np.allclose(alone.covariance([node]), together.covariance([node]), rtol=rounding, atol=rounding)
    P = together.joint_covariance(together.nodes)
    blocks = np.zeros_like(P)
    start = 0
    for node in together.nodes.tolist():
        own = together.covariance([node])[0]
        blocks[start : start + len(own), start : start + len(own)] = own
        start += len(own)
    assert np.array_equal(P, blocks)


def only(operation, node):
    """Return the part of an operation on one node; None if it has none."""
    if isinstance(operation, Predict):
        graph = operation.transition.graph  # type: ignore[attr-defined]
        rows = np.flatnonzero(graph.nodes == node)
        if len(rows) == 0:
            return None
        return Predict(discretise(SceneGraph([node], (graph.types[rows[0]],)), operation.transition.dt))  # type: ignore[attr-defined]
    if isinstance(operation, Update):
        m = operation.measurements
        rows = np.flatnonzero(m.nodes == node)
        return Update(Measurements(m.nodes[rows], m.z[rows], m.H[rows], m.R[rows])) if len(rows) else None
    rows = np.flatnonzero(np.asarray(operation.nodes) == node)
    if len(rows) == 0:
        return None
    if isinstance(operation, Marginalise):
        return Marginalise(np.array([node]))
    return Add(operation.nodes[rows], operation.means[rows], operation.covariances[rows])


# bad input: one clear exception, and nothing has happened

MIXED = (CAR, BUS, CONE, CAR)
IDS = [4, 8, 15, 16]


def filled(make):
    """An estimator that has seen something of cars 4 and 16, bus 8 and cone 15."""
    rng = np.random.default_rng(0)
    estimator = make()
    for node, node_type in zip(IDS, MIXED, strict=True):
        new_nodes(rng, [node], node_type).run(estimator)
    estimator.predict(discretise(random_graph(rng, MIXED, IDS, 0.7), 0.4))
    estimator.update(Measurements([4, 16], rng.normal(size=(2, 2)), np.eye(2, 4), 0.2 * np.eye(2)))
    return estimator


def transition(ids, types=None, dt=0.3):
    types = types or tuple(dict(zip(IDS, MIXED, strict=True)).get(node, CAR) for node in ids)
    return discretise(random_graph(np.random.default_rng(1), types, ids, 0.7), dt)


def measured(nodes, d=4, **columns):
    m = len(nodes)
    return Measurements(**({"nodes": nodes, "z": np.zeros((m, 2)), "H": np.eye(2, d), "R": np.eye(2)} | columns))


def added(nodes, d=4, mean=0.0, P=None):
    P = np.eye(d) if P is None else np.asarray(P)
    return nodes, np.full((len(nodes), d), mean), np.tile(P, (len(nodes), 1, 1))


BAD = {
    "add: known already": (lambda e: e.add(*added([5, 8])), InputError, "node 8 is in the estimator already"),
    "add: twice in one call": (
        lambda e: e.add(*added([5, 5])),
        InputError,
        "nodes: expected unique ids, 5 occurs more",
    ),
    "add: NaN mean": (
        lambda e: e.add(*added([5], mean=np.nan)),
        InputError,
        r"means\[0, 0\]: expected a finite number",
    ),
    "add: infinite mean": (
        lambda e: e.add(*added([5], mean=np.inf)),
        InputError,
        "means.*expected a finite number",
    ),
    "add: NaN covariance": (
        lambda e: e.add(*added([5], P=np.full((4, 4), np.nan))),
        InputError,
        "covariances.*finite",
    ),
    "add: singular covariance": (
        lambda e: e.add(*added([5], P=np.zeros((4, 4)))),
        InputError,
        "positive definite",
    ),
    "add: indefinite covariance": (
        lambda e: e.add(*added([5], P=-np.eye(4))),
        InputError,
        "positive definite",
    ),
    "add: asymmetric covariance": (
        lambda e: e.add(*added([5], P=np.eye(4) + np.eye(4, k=1))),
        InputError,
        r"covariances\[0\]: expected a symmetric matrix",
    ),
    "add: covariance of another size": (
        lambda e: e.add([5], np.zeros((1, 4)), np.eye(6)[None]),
        InputError,
        r"covariances: expected shape \(1, 4, 4\), got \(1, 6, 6\)",
    ),
    "add: flat mean": (lambda e: e.add([5], np.zeros(4), np.eye(4)[None]), InputError, "means: expected shape"),
    "add: too few means": (
        lambda e: e.add(*added([5])[:1], *added([5, 6])[1:]),
        InputError,
        "means: expected shape",
    ),
    "add: ids that are no integers": (
        lambda e: e.add([5.5], *added([5])[1:]),
        InputError,
        "nodes: expected a list of",
    ),
    "add: ids that are no list": (
        lambda e: e.add(5, *added([5])[1:]),
        InputError,
        "nodes: expected a list of integers",
    ),
    "predict: a node missing": (lambda e: e.predict(transition([4, 8, 15])), InputError, "expected 4 nodes, got 3"),
    "predict: an unknown node": (
        lambda e: e.predict(transition([4, 8, 15, 99])),
        UnknownNodeError,
        "node 99 is not in the estimator",
    ),
    "predict: a node too many": (
        lambda e: e.predict(transition([4, 8, 15, 16, 99])),
        UnknownNodeError,
        "node 99 is not in the estimator",
    ),
    "predict: other sizes": (
        lambda e: e.predict(transition(IDS, (CAR, CAR, CONE, CAR))),
        InputError,
        "transition: the sizes of its states differ",
    ),
    "predict: sizes exchanged": (
        lambda e: e.predict(transition(IDS, (BUS, CAR, CONE, CAR))),
        InputError,
        "transition: the sizes of its states differ",
    ),
    "predict: NaN": (
        lambda e: e.predict(dataclasses.replace(transition(IDS), b=np.full(16, np.nan))),
        InputError,
        "b: expected finite numbers",
    ),
    "predict: no noise for a node": (
        lambda e: e.predict(dataclasses.replace(transition(IDS), Q=transition(IDS).Q[1:])),
        InputError,
        "Q: expected one block for each of 4 nodes",
    ),
    "predict: blocks of the wrong size": (
        lambda e: e.predict(
            dataclasses.replace(transition(IDS), F=(Blocks(np.array([0]), np.array([1]), np.ones((1, 4, 4))),))
        ),
        InputError,
        "F: blocks of size 4 x 4 do not fit",
    ),
    "predict: negative interval": (lambda e: e.predict(transition(IDS, dt=-1.0)), InputError, "dt: expected a finite"),
    "predict: endless interval": (lambda e: e.predict(transition(IDS, dt=np.inf)), InputError, "dt: expected a finite"),
    "predict: no transition": (
        lambda e: e.predict(transition(IDS).graph),
        InputError,
        "transition: expected Transition, got SceneGraph",
    ),
    "update: no measurements": (
        lambda e: e.update(([4], [[0.0, 0.0]])),
        InputError,
        "measurements: expected Measurements.*, got tuple",
    ),
    "restore: no snapshot": (lambda e: e.restore((1, 2, 3.0)), InputError, "state: expected .*State, got tuple"),
    "update: unknown node": (
        lambda e: e.update(measured([4, 99])),
        UnknownNodeError,
        "node 99 is not in the estimator",
    ),
    "update: nodes of mixed sizes": (lambda e: e.update(measured([4, 8])), InputError, "expected states of equal size"),
    "update: H of another size": (lambda e: e.update(measured([4], d=6)), InputError, "H: expected 4 columns"),
    "update: H of another size, mixed": (lambda e: e.update(measured([8], d=4)), InputError, "H: expected 6 columns"),
    "update: NaN": (lambda e: e.update(measured([4], z=[[np.nan, 0.0]])), InputError, r"z\[0, 0\]: expected a finite"),
    "update: infinite": (lambda e: e.update(measured([4], z=[[np.inf, 0.0]])), InputError, "z.*expected a finite"),
    "update: NaN in H": (lambda e: e.update(measured([4], H=np.full((2, 4), np.nan))), InputError, "H.*finite"),
    "update: wrong shape": (lambda e: e.update(measured([4], z=[[0.0, 0.0, 0.0]])), InputError, "H: expected shape"),
    "update: singular noise": (lambda e: e.update(measured([4], R=np.ones((2, 2)))), InputError, "positive definite"),
    "update: no noise": (lambda e: e.update(measured([4], R=np.zeros((2, 2)))), InputError, "positive definite"),
    "update: negative noise": (lambda e: e.update(measured([4], R=-np.eye(2))), InputError, "positive definite"),
    "marginalise: unknown node": (
        lambda e: e.marginalise([4, 99]),
        UnknownNodeError,
        "node 99 is not in the estimator",
    ),
    "marginalise: no list": (lambda e: e.marginalise(4), InputError, "nodes: expected a list of integer"),
    "mean: unknown node": (lambda e: e.mean([99]), UnknownNodeError, "node 99 is not in the estimator"),
    "mean: mixed sizes": (lambda e: e.mean([4, 8]), InputError, "expected states of equal size"),
    "covariance: unknown node": (lambda e: e.covariance([99]), UnknownNodeError, "node 99 is not in the estimator"),
    "covariance: mixed sizes": (lambda e: e.covariance([4, 8]), InputError, "expected states of equal size"),
    "joint mean: unknown node": (lambda e: e.joint_mean([4, 99]), UnknownNodeError, "node 99 is not in the estimator"),
    "joint covariance: unknown node": (lambda e: e.joint_covariance([4, 99]), UnknownNodeError, "node 99 is not"),
    "joint covariance: ids that are no integers": (lambda e: e.joint_covariance(["4"]), InputError, "nodes: expected"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_ends_in_one_exception_and_changes_nothing(make, name):
    call, error, message = BAD[name]
    estimator, untouched = filled(make), filled(make)
    with pytest.raises(error, match=message):
        call(estimator)
    assert estimator.nodes.tolist() == untouched.nodes.tolist()
    assert np.array_equal(estimator.joint_mean(IDS), untouched.joint_mean(IDS))
    assert np.array_equal(estimator.joint_covariance(IDS), untouched.joint_covariance(IDS))
    for either in (estimator, untouched):
        new_nodes(np.random.default_rng(3), [23], TRAM).run(either)
        either.predict(discretise(random_graph(np.random.default_rng(4), (*MIXED, TRAM), [*IDS, 23], 0.5), 0.2))
        either.update(measured([4, 16]))
        either.marginalise([8])
    assert np.array_equal(estimator.joint_covariance([4, 15, 16, 23]), untouched.joint_covariance([4, 15, 16, 23]))
    assert np.array_equal(estimator.joint_mean([4, 15, 16, 23]), untouched.joint_mean([4, 15, 16, 23]))


def test_bad_input_does_not_end_the_interpreter(recipe):
    """All of it at once, in an interpreter of its own: a crash in compiled code could not be caught here."""
    script = textwrap.dedent(
        f"""
        import sys, warnings
        sys.path[:0] = {sys.path!r}
        warnings.simplefilter("error")
        from tests.saga_fg.estimators import test_conformance as suite
        from saga_fg import SagaError
        make = suite.maker({recipe!r})
        estimator = suite.filled(make)
        for name, (call, error, message) in suite.BAD.items():
            try:
                call(estimator)
            except SagaError:
                continue
            sys.exit(f"{{name}}: no exception")
        estimator.update(suite.measured([4, 16]))
        estimator.predict(suite.transition(suite.IDS, dt=1000.0))
        print(len(suite.BAD), "refused;", len(estimator.nodes), "nodes left")
        """
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:] + done.stdout[-2000:]
    assert done.stdout.split() == [str(len(BAD)), "refused;", "4", "nodes", "left"]


def test_of_no_nodes_there_is_nothing_to_tell(make):
    for estimator in (make(), filled(make)):
        nodes = estimator.nodes.tolist()
        assert estimator.mean([]).shape[0] == estimator.covariance([]).shape[0] == 0
        assert estimator.joint_mean([]).shape == (0,)
        assert estimator.joint_covariance([]).shape == (0, 0)
        assert estimator.update(Measurements([], [], [], [])) == 0.0
        estimator.marginalise([])
        assert estimator.nodes.tolist() == nodes


# snapshots


def test_continuing_from_a_snapshot_is_bit_identical(make):
    estimator = make()
    program = random_program(np.random.default_rng(21), moments=9)
    middle = len(program) // 2
    run(program[:middle], estimator)
    state = estimator.snapshot()
    before = estimator.joint_mean(estimator.nodes), estimator.joint_covariance(estimator.nodes)
    run(program[middle:], estimator)
    first = estimator.nodes, estimator.joint_mean(estimator.nodes), estimator.joint_covariance(estimator.nodes)
    for again in (estimator, make()):
        again.restore(state)
        assert np.array_equal(again.joint_mean(again.nodes), before[0])
        assert np.array_equal(again.joint_covariance(again.nodes), before[1])
        run(program[middle:], again)
        second = again.nodes, again.joint_mean(again.nodes), again.joint_covariance(again.nodes)
        for a, b in zip(first, second, strict=True):
            assert np.array_equal(a, b)


def test_a_snapshot_of_another_kind_of_estimator_is_refused(make):
    estimator, untouched = filled(make), filled(make)
    own = type(make().snapshot())
    others = [filled(maker(kind.values[0])).snapshot() for kind in ESTIMATORS]
    for state in others:
        if not isinstance(state, own):
            with pytest.raises(InputError, match=f"state: expected {own.__name__}, got {type(state).__name__}"):
                estimator.restore(state)
    assert np.array_equal(estimator.joint_mean(IDS), untouched.joint_mean(IDS))
    assert np.array_equal(estimator.joint_covariance(IDS), untouched.joint_covariance(IDS))


def test_the_suite_would_notice(make):
    """The comparison itself: an estimator that forgets a correlation, or is off by a thousandth of a sigma, fails."""

    class Forgetful(JointKalmanFilter):
        def joint_covariance(self, nodes):
            P = super().joint_covariance(nodes)
            return np.where(np.abs(P) < np.abs(P).max() * 1e-2, 0.0, P)

    class Sloppy(JointKalmanFilter):
        def joint_mean(self, nodes):
            mean = super().joint_mean(nodes)
            return mean + 1e-3

    program = random_program(np.random.default_rng(2), moments=5)
    for kind in (Forgetful, Sloppy):
        with pytest.raises(AssertionError):
            in_step(program, kind())
