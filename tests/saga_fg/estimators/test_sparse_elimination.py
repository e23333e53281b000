"""Batch smoothing in sparse orders of elimination: the same answer, where it is cheaper, if it has the digits."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from factors import RangeBearing, Robust
from saga_fg import Edges, InputError, SceneGraph
from saga_fg.estimators import BatchSmoother, GraduatedNonConvexity, Measurements, Observations
from saga_fg.estimators.sparse_elimination import cheapest_order
from saga_fg.model.discretisation import discretise
from tests.saga_fg.estimator_scenario import covariance_error, random_covariance, random_scenario
from tests.saga_fg.random_graphs import BUS, CAR, CONE, POLE, TRAM

EXACT = 1e-9


def queue(n, rng):
    """Every car shares the velocity of the one ahead."""
    follower = np.arange(1, n)
    A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (n - 1, 1, 1))
    edges = Edges("follow", follower, follower - 1, rng.uniform(0.3, 1, n - 1), -A, A, np.zeros((n - 1, 4)))
    return SceneGraph.of(np.arange(n), CAR, [edges])


def crowd(n, rng):
    """Everybody shares the velocity of everybody."""
    target, source = np.nonzero(~np.eye(n, dtype=bool))
    A = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (len(target), 1, 1))
    edges = Edges("crowd", target, source, np.full(len(target), 1 / n), -A, A, np.zeros((len(target), 4)))
    return SceneGraph.of(np.arange(n), CAR, [edges])


def recorded(graph_of, n, frames, order="auto", seed=0, robust=None):
    rng = np.random.default_rng(seed)
    smoother = BatchSmoother(likelihoods=False, order=order)
    smoother.add(np.arange(n), rng.normal(size=(n, 4)), random_covariance(rng, n, 4))
    for _ in range(frames):
        smoother.predict(discretise(graph_of(n, rng), 0.1))
        seen = np.flatnonzero(rng.random(n) < 0.8)
        z = rng.normal(size=(len(seen), 2))
        z[rng.random(len(seen)) < 0.1] += 50.0 if robust is not None else 0.0
        smoother.update(Measurements(seen, z, np.eye(2, 4), 0.1 * np.eye(2)), robust=robust)
    return smoother


def assert_same(smoother, reference):
    """Means within 1e-9 sigma, covariances within 1e-9."""
    for mine, theirs in zip(smoother.smoothed(), reference.smoothed(), strict=True):
        assert mine.nodes.tolist() == theirs.nodes.tolist()
        for node in mine.nodes:
            P = theirs.covariance([node])[0]
            sigma = np.sqrt(np.diag(P))
            assert np.abs((mine.mean([node])[0] - theirs.mean([node])[0]) / sigma).max() < EXACT
            assert covariance_error(mine.covariance([node])[0], P) < EXACT


@pytest.mark.parametrize("order", ["colamd", "metis"])
def test_a_queue_is_the_same_in_every_order(order):
    sparse, in_time = recorded(queue, 12, 10, order), recorded(queue, 12, 10, "time")
    assert_same(sparse, in_time)
    assert sparse.order == order
    assert sparse.graph().variables == in_time.graph().variables


@pytest.mark.parametrize("order", ["colamd", "metis"])
@pytest.mark.parametrize("kinds", [(CAR, CONE), (CAR, BUS, TRAM, CONE), (CAR, POLE)])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_happens_the_answer_is_the_same(order, kinds, seed):
    """New and leaving nodes, mixed sizes; zero-variance and badly scaled noise fall back on the order of time."""
    calls = random_scenario(np.random.default_rng(seed), frames=8, kinds=kinds, density=0.15).calls
    sparse, in_time = BatchSmoother(likelihoods=False, order=order), BatchSmoother(order="time")
    for estimator in (sparse, in_time):
        for name, *arguments in calls:
            getattr(estimator, name)(*arguments)
    assert_same(sparse, in_time)
    if POLE in kinds:
        assert sparse.order == "time"


def test_nodes_without_neighbours_do_not_end_the_interpreter():
    """METIS crashes on variables without neighbours, when others have some."""
    script = textwrap.dedent(
        f"""
        import sys
        sys.path[:0] = {sys.path!r}
        import numpy as np
        from tests.saga_fg.estimators.test_sparse_elimination import recorded, queue
        from saga_fg.estimators.sparse_elimination import sparse_ordering
        factors = [(k, k + 1) for k in range(50)] + [(k,) for k in range(100, 160)]
        assert sparse_ordering(factors, "metis").size() == 111
        assert sparse_ordering([(1,), (2,)], "metis").size() == 2
        smoother = recorded(queue, 6, 3, "metis")
        smoother.add([50, 51], np.zeros((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
        print(smoother.smoothed()[-1].covariance([50]).shape, smoother.order)
        """
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr[-2000:]
    assert run.stdout.split() == ["(1,", "4,", "4)", "metis"]


@pytest.mark.parametrize(("graph_of", "n", "order"), [(queue, 120, "colamd metis"), (crowd, 60, "time")])
def test_the_cheapest_order_is_chosen(graph_of, n, order):
    smoother = recorded(graph_of, n, 40)
    recording = smoother._recording
    assert cheapest_order(recording.epochs, recording.layouts) in order.split()
    assert smoother.order in order.split()


def test_something_nonlinear_is_solved_in_time_unless_wished_otherwise():
    smoother = recorded(queue, 4, 3, robust=Robust("huber", 1.0))
    assert smoother.order == "time"


@pytest.mark.parametrize("robust", [Robust("huber", 1.345), GraduatedNonConvexity(scale=6.0)])
def test_robust_losses_in_a_sparse_order(robust):
    sparse, in_time = (recorded(queue, 6, 8, order, robust=robust) for order in ("colamd", "time"))
    for mine, theirs in zip(sparse.weights(), in_time.weights(), strict=True):
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-7)
    assert sparse.order == "colamd"
    for mine, theirs in zip(sparse.smoothed(), in_time.smoothed(), strict=True):
        np.testing.assert_allclose(mine.state, theirs.state, atol=1e-7)


def test_nonlinear_measurements_in_a_sparse_order():
    rng = np.random.default_rng(0)
    sparse, in_time = BatchSmoother(likelihoods=False, order="metis"), BatchSmoother(order="time")
    model, truth = RangeBearing(state_dim=4), np.array([[30.0, 5, 5, 2], [-20.0, 1, 3, -3]])
    for smoother in (sparse, in_time):
        smoother.add([0, 1], truth + 0.5, np.tile(4 * np.eye(4), (2, 1, 1)))
    for _ in range(6):
        truth[:, :2] += 0.2 * truth[:, 2:]
        z = model.predict(truth) + rng.normal(size=(2, 2)) * [0.2, 0.01]
        for smoother in (sparse, in_time):
            smoother.predict(discretise(queue(2, np.random.default_rng(1)), 0.2))
            smoother.update(Observations([0, 1], z, model, np.diag([0.04, 1e-4])))
    for mine, theirs in zip(sparse.smoothed(), in_time.smoothed(), strict=True):
        np.testing.assert_allclose(mine.state, theirs.state, atol=1e-7)
        np.testing.assert_allclose(mine.covariance([0, 1]), theirs.covariance([0, 1]), rtol=1e-6, atol=1e-9)


def test_what_comes_later_changes_the_solution():
    smoother, reference = recorded(queue, 5, 4, "colamd"), recorded(queue, 5, 4, "time")
    smoother.smoothed()
    for estimator in (smoother, reference):
        estimator.update(Measurements([2], [[3.0, 3.0]], np.eye(2, 4), 0.01 * np.eye(2)), time=0.2)
    assert_same(smoother, reference)


def test_joint_covariances_come_in_the_order_of_time():
    smoother, reference = recorded(queue, 5, 4, "colamd"), recorded(queue, 5, 4, "time")
    for mine, theirs in zip(smoother.smoothed(joint=True), reference.smoothed(joint=True), strict=True):
        np.testing.assert_allclose(mine.joint_covariance([0, 4]), theirs.joint_covariance([0, 4]), atol=1e-12)


def test_an_unknown_order_is_refused():
    with pytest.raises(InputError, match="order: expected one of auto, time, colamd, metis"):
        BatchSmoother(order="nested")
