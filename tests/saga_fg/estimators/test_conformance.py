"""Every estimator gives the textbook's answers, in any order, and consistent ones."""

import dataclasses

import gtsam
import numpy as np
import pytest

from factors import SolverSettings
from saga_fg import Edges, SagaError, SceneGraph
from saga_fg.conformance import TOLERANCE, assert_equal
from saga_fg.conformance.programs import (
    BUS,
    CAR,
    CONE,
    POLE,
    TRAM,
    VAN,
    Add,
    Marginalise,
    Predict,
    TextbookEstimator,
    Update,
    new_nodes,
    random_graph,
    random_program,
    run,
)
from saga_fg.estimators import BatchSolver, GraphFilter, Measurements
from saga_fg.graph import SceneFactorGraph
from saga_fg.graph.variables import node_key
from saga_fg.model.discretisation import discretise
from saga_fg.model.manoeuvres import KnownCourses
from tests.saga_fg.estimator_scenario import Textbook, admissible, assert_smoothed, random_scenario, tell
from tests.saga_fg.every_estimator import ESTIMATORS, maker
from tests.saga_fg.graph_keys import newest_key
from tests.saga_fg.road_scenes import road_program

SMOOTHERS = [kind for kind in ESTIMATORS if hasattr(maker(kind.values[0])(), "smoothed")]


@pytest.fixture(params=SMOOTHERS)
def make_smoother(request):
    """Makes fresh estimators of those kinds that tell of earlier moments too."""
    return maker(request.param)


def in_step(program, estimator, tolerance=TOLERANCE, textbook=None):
    """Run a program on an estimator and the textbook, comparing after every operation."""
    textbook = textbook or TextbookEstimator()
    for operation in program:
        expected = operation.run(textbook)
        result = operation.run(estimator)
        if expected is not None and not np.isnan(result):
            assert result == pytest.approx(expected, rel=tolerance, abs=tolerance * 10)
        assert_equal(estimator, textbook, tolerance)
    return textbook


# equal to the textbook


@pytest.mark.parametrize("seed", range(2))
def test_nodes_that_turn_and_scenes_of_lights_lanes_cones_and_trailers_agree_with_the_textbook(make, seed):
    """Courses with known headings and turn rates, recorded with every interval."""
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=7, kinds=(CAR, VAN, CONE))
    in_step([with_courses(rng, operation) for operation in program], make())
    # Standing and moving nodes whose edges go between kinds, with rates that follow the belief on a light.
    rng = np.random.default_rng(seed)
    in_step(road_program(rng), make())


def with_courses(rng, operation):
    """A prediction in which some of the vans have a known course, and some of these brake to a stop."""
    if not isinstance(operation, Predict):
        return operation
    graph, dt = operation.transition.graph, operation.transition.dt
    ids = graph.nodes[[k for k, t in enumerate(graph.types) if t is VAN and rng.random() < 0.7]]
    heading, rate, variance = rng.normal(0, (2.0, 0.4, 0.1), (len(ids), 3)).T
    record = KnownCourses.from_turn_rates(VAN, ids, heading, rate, variance**2, rng.normal(0, 2, (len(ids), 6)), dt)
    return Predict(discretise(dataclasses.replace(graph, motions=(record,)), dt))


@pytest.mark.parametrize("seed", [0])
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


@pytest.mark.parametrize("seed", [0])
def test_nodes_that_stand_still_for_ever_and_measurements_far_better_than_the_prior(make, seed):
    """Stop lines and poles have no process noise: Q is singular."""
    rng = np.random.default_rng(40 + seed)
    in_step(random_program(rng, moments=7, kinds=(CAR, POLE)), make())
    rng = np.random.default_rng(seed)
    prior = Add(np.array([1, 2]), rng.normal(size=(2, 4)) * 1e3, np.stack([1e6 * np.eye(4)] * 2))
    sharp = Update(Measurements(np.array([1]), np.array([[3.0, 4.0]]), np.eye(2, 4), 1e-2 * np.eye(2)))
    tolerance = max(TOLERANCE, 20 * np.finfo(float).eps * 1e6 / 1e-2)
    in_step([prior, sharp], make(), tolerance)


@pytest.mark.parametrize("seed", range(2))
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
    in_step(
        [new_nodes(rng, [901, 902], CAR), Update(Measurements([901], np.zeros((1, 2)), np.eye(2, 4), np.eye(2)))],
        estimator,
    )


@pytest.mark.parametrize("late", [0.0, 0.5])
@pytest.mark.parametrize("seed", range(2))
def test_every_epoch_is_smoothed_as_by_rauch_tung_striebel(make_smoother, seed, late):
    """After every call; late measurements change the past as if they had come in time, also within an interval."""
    scenario = random_scenario(np.random.default_rng(300 + seed), 6, late=late, intervals=(0.02, 0.1, 0.37, 0.5, 1.2))
    smoother, textbook, count = make_smoother(), Textbook(), 0
    for call in scenario.calls:
        if (taken := admissible(textbook, call, smoother)) is not None:
            tell(textbook, [taken])
            tell(smoother, [taken])
            count += call[0] == "update" and call[2] is not None
            assert_smoothed(smoother, textbook, joint=False)
    assert count > 0 or late == 0 or smoother.start == smoother.time


def zeros(values):
    """Vectors of zeros."""
    result = gtsam.Values()
    for key in values.keys():  # noqa: SIM118 -- gtsam.Values is no dict
        result.insert(key, np.zeros_like(values.atVector(key)))
    return result


@pytest.mark.parametrize("seed", [0])
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


@pytest.mark.parametrize("seed", [0])
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


# Every estimator is indifferent to order, to coupling where there is none, and to a snapshot between


@pytest.mark.parametrize("seed", range(2))
def test_rate_zero_is_independent_filters_exactly(make, seed):
    """Together or each alone: the same digits, and no correlation between any two.

    iSAM2 solves when it is told something, so that others change how often; its digits are the same to rounding.
    """
    rng = np.random.default_rng(seed)
    program = random_program(rng, moments=6, max_rate=0.0)
    together, _ = run(program, make())
    rounding = 1e-11 if isinstance(together, GraphFilter) else 0.0
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
