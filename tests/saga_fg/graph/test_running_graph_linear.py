"""Law 1 of the running graph: what is linear equals the textbook, whatever comes and goes and however time runs."""

import numpy as np
import pytest

from saga_fg.conformance.programs import (
    CAR,
    CONE,
    Predict,
    TextbookEstimator,
    Update,
    new_nodes,
    random_graph,
    random_program,
)
from saga_fg.estimators import Measurements
from saga_fg.model.discretisation import discretise
from tests.saga_fg.graph_estimator import GraphEstimator

LAGS = [pytest.param(0.0, id="filter"), pytest.param(1.0, id="lag"), pytest.param(None, id="all")]
USUAL = (0.02, 0.1, 0.37, 0.5, 1.2)
MILLISECONDS = (1e-3, 0.05, 1.0)


def largest_errors(program, estimator):
    """Largest errors after every operation: means in posterior sigmas, joint and single covariances relative."""
    textbook = TextbookEstimator()
    errors = np.zeros(3)
    for operation in program:
        operation.run(textbook)
        operation.run(estimator)
        nodes = textbook.nodes.tolist()
        assert sorted(estimator.nodes) == sorted(nodes)
        if not nodes:
            continue
        P = textbook.joint_covariance(nodes)
        mean = (estimator.joint_mean(nodes) - textbook.joint_mean(nodes)) / np.sqrt(np.diag(P))
        joint = np.linalg.norm(estimator.joint_covariance(nodes) - P) / np.linalg.norm(P)
        own = [(estimator.covariance(node), textbook.covariance([node])[0]) for node in nodes]
        single = max(np.linalg.norm(mine - its) / np.linalg.norm(its) for mine, its in own)
        errors = np.maximum(errors, [np.abs(mean).max(), joint, single])
    return errors


@pytest.mark.parametrize("lag", LAGS)
def test_random_programs_agree_with_the_textbook(lag, subtests):
    """New and leaving nodes, misses, several sensors, graphs that change, nodes of four kinds."""
    for seed in range(10):
        with subtests.test(seed=seed):
            mean, joint, single = largest_errors(
                random_program(np.random.default_rng(seed), moments=7, intervals=USUAL), GraphEstimator(lag)
            )
            assert mean < (2e-9 if lag == 0.0 else 5e-9)  # rounding differs from processor to processor
            assert joint < (1e-8 if lag == 0.0 else 1e-9)  # each interval begins from covariances
            assert single < 3e-8  # iSAM2's marginals have one digit less


@pytest.mark.parametrize("lag", LAGS)
def test_milliseconds_beside_seconds(lag, subtests):
    """With constant velocity. The noise of constant acceleration falls with the fifth power of the interval."""
    for seed in range(10):
        with subtests.test(seed=seed):
            program = random_program(np.random.default_rng(seed), moments=9, intervals=MILLISECONDS, kinds=(CAR, CONE))
            mean, joint, single = largest_errors(program, GraphEstimator(lag))
            assert max(mean, joint, single) < 1e-9


def test_a_long_program_does_not_drift_away():
    program = random_program(np.random.default_rng(100), moments=60, kinds=(CAR, CONE), intervals=USUAL, density=0.15)
    mean, joint, single = largest_errors(program, GraphEstimator(0.0))
    assert max(mean, joint, single) < 1e-9


@pytest.mark.parametrize(("n", "elimination", "most"), [(25, "qr", 1e-9), (70, "cholesky", 1e-7)])
def test_many_nodes_that_hang_together(n, elimination, most):
    """Very many are eliminated by Cholesky, which keeps half the digits."""
    rng, ids = np.random.default_rng(5), list(range(n))
    program = [new_nodes(rng, ids, CAR)]
    for _ in range(5):
        seen = np.array(ids)[rng.random(n) < 0.6]
        measured = Measurements(seen, 10 * rng.normal(size=(len(seen), 2)), np.eye(2, 4), 0.2 * np.eye(2))
        program += [Predict(discretise(random_graph(rng, (CAR,) * n, ids, 0.2), 0.3)), Update(measured)]
    estimator, textbook = GraphEstimator(0.0), TextbookEstimator()
    for operation in program:
        operation.run(textbook)
        operation.run(estimator)
    assert estimator.smoother.graph().elimination == elimination
    P = textbook.joint_covariance(ids)
    assert np.abs((estimator.joint_mean(ids) - textbook.joint_mean(ids)) / np.sqrt(np.diag(P))).max() < most
    assert np.linalg.norm(estimator.joint_covariance(ids) - P) < most * np.linalg.norm(P)
    assert np.linalg.norm(estimator.covariance(7) - textbook.covariance([7])[0]) < 10 * most
