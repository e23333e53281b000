"""Conformance of an estimator, a user's own too: one import, one call. Of other parts: `saga_fg.conformance.parts`.

    from saga_fg.conformance import check_estimator

    check_estimator(MyFilter)

runs random programs (new and leaving nodes, misses, several sensors, changing graphs, irregular intervals) on fresh
estimators and on the textbook's dense Kalman filter side by side, and compares them after every operation. With
pytest, `CHECKS` gives a test each:

    @pytest.mark.parametrize("check", CHECKS)
    def test_my_filter(check):
        check(MyFilter)

`random_program`, `TextbookEstimator` and `assert_equal` are there for tests of one's own.
"""

import copy
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from saga_fg.conformance.parts import (
    check_association_cost,
    check_class_model,
    check_edge_rule,
    check_interaction,
    check_motion,
    check_provider,
    check_sensor,
    require,
)
from saga_fg.conformance.programs import (
    CAR,
    TRAM,
    Add,
    Marginalise,
    Operation,
    Predict,
    TextbookEstimator,
    Update,
    new_nodes,
    random_graph,
    random_program,
    run,
)
from saga_fg.errors import SagaError
from saga_fg.estimators import Estimator, Measurements
from saga_fg.model import SceneGraph, discretise

__all__ = [
    "CHECKS",
    "Add",
    "Marginalise",
    "Operation",
    "Predict",
    "TextbookEstimator",
    "Update",
    "assert_equal",
    "assert_equal_in_every_step",
    "check_association_cost",
    "check_class_model",
    "check_edge_rule",
    "check_estimator",
    "check_interaction",
    "check_motion",
    "check_provider",
    "check_sensor",
    "new_nodes",
    "random_graph",
    "random_program",
    "run",
]

TOLERANCE = 1e-9  # posterior standard deviations of means; relative, in the Frobenius norm, of covariances

Make = Callable[[], Estimator]


def assert_equal(estimator: Estimator, textbook: TextbookEstimator, tolerance: float = TOLERANCE) -> None:
    """Raise `AssertionError` unless all means and joint covariances agree within a tolerance."""
    nodes = textbook.nodes
    require(sorted(estimator.nodes.tolist()) == sorted(nodes.tolist()), f"nodes {estimator.nodes.tolist()}")
    if len(nodes) == 0:
        return
    P = textbook.joint_covariance(nodes)
    sigma = np.sqrt(np.diag(P))
    error = float(np.abs((estimator.joint_mean(nodes) - textbook.joint_mean(nodes)) / sigma).max())
    require(error <= tolerance, f"joint_mean is off by {error:.3g} standard deviations")
    error = float(np.linalg.norm(estimator.joint_covariance(nodes) - P) / np.linalg.norm(P))
    require(error <= tolerance, f"joint_covariance is off by {error:.3g}, relative")
    for node in nodes.tolist():
        own, mean = textbook.covariance([node])[0], textbook.mean([node])[0]
        error = float(np.linalg.norm(estimator.covariance([node])[0] - own) / np.linalg.norm(own))
        require(error <= tolerance, f"covariance of node {node} is off by {error:.3g}, relative")
        error = float((np.abs(estimator.mean([node])[0] - mean) / np.sqrt(np.diag(own)).max()).max())
        require(error <= tolerance, f"mean of node {node} is off by {error:.3g} standard deviations")


def assert_equal_in_every_step(
    program: Iterable[Operation], estimator: Estimator, tolerance: float = TOLERANCE
) -> TextbookEstimator:
    """Run a program on an estimator and on the textbook, which is returned, and compare after every operation."""
    textbook = TextbookEstimator()
    for number, operation in enumerate(program):
        expected, result = operation.run(textbook), operation.run(estimator)
        try:
            if expected is not None and result is not None and not np.isnan(result):
                close = abs(result - expected) <= tolerance * max(abs(expected), 10.0)
                require(close, f"the log-likelihood is {result:.12g}, expected {expected:.12g}")
            assert_equal(estimator, textbook, tolerance)
        except AssertionError as error:
            raise AssertionError(f"operation {number}, {type(operation).__name__}: {error}") from error
    return textbook


def check_methods(make: Make) -> None:
    """It can be made, and is an `Estimator` with all methods that every estimator has."""
    try:
        estimator = make()
    except TypeError as error:  # of a class that lacks some
        raise AssertionError(str(error)) from error
    require(isinstance(estimator, Estimator), f"expected an Estimator, got {type(estimator).__name__}")


def check_programs(make: Make) -> None:
    """Nodes of mixed sizes, changing graphs, several sensors, misses, new and leaving nodes, irregular intervals."""
    for seed in range(10):
        assert_equal_in_every_step(random_program(np.random.default_rng(seed), moments=7), make())


def check_long_program(make: Make) -> None:
    """Forty intervals: no drift."""
    rng = np.random.default_rng(100)
    assert_equal_in_every_step(random_program(rng, moments=40, kinds=(CAR, TRAM), density=0.15), make())


def check_intervals(make: Make) -> None:
    """Intervals of a millisecond beside those of a second, and none at all."""
    for seed, intervals in enumerate([(0.0, 0.4), (1e-6, 0.4), (1e-3, 0.05, 1.0)]):
        assert_equal_in_every_step(random_program(np.random.default_rng(seed), intervals=intervals), make())


def check_without_nodes(make: Make) -> None:
    """An estimator of nothing can be predicted and corrected."""
    estimator = make()
    estimator.predict(discretise(SceneGraph.of([], CAR, []), 0.5))
    nothing = Measurements(np.empty(0, dtype=np.int64), np.empty((0, 2)), np.eye(2, 4), np.eye(2))
    require(estimator.update(nothing) == 0.0, "update by no measurements is expected to return 0")
    estimator.marginalise([])
    require(len(estimator.nodes) == 0 and estimator.joint_mean([]).shape == (0,), "expected no node")


def check_several_kinds(make: Make) -> None:
    """Measurements of several kinds in one update are taken in as one after the other."""
    rng, ids = np.random.default_rng(1), np.array([1, 2])
    together, apart = make(), make()
    for one in (together, apart):
        new_nodes(np.random.default_rng(0), [1, 2], CAR).run(one)
    kinds = [Measurements(ids, rng.normal(size=(2, k)), np.eye(k, 4), np.eye(k)) for k in (2, 4)]
    together.update(kinds)
    for kind in kinds:
        apart.update(kind)
    close = np.allclose(together.joint_mean(ids), apart.joint_mean(ids), rtol=1e-9, atol=1e-9)
    require(close, "an update by a sequence of measurements differs from one update after the other")


def check_copies(make: Make) -> None:
    """A copy and what is restored from a snapshot go on as the estimator does, and leave it as it is."""
    program = random_program(np.random.default_rng(3), moments=6)
    half = len(program) // 2
    estimator, _ = run(program[:half], make())
    restored, untouched = make(), make()
    restored.restore(copy.deepcopy(estimator.snapshot()))
    untouched.restore(estimator.snapshot())
    for twin in (copy.copy(estimator), restored):
        run(program[half:], twin)
        require(estimator.nodes.tolist() == untouched.nodes.tolist(), "a copy has changed its original")
        nodes = untouched.nodes
        same = np.array_equal(estimator.joint_covariance(nodes), untouched.joint_covariance(nodes))
        require(same and estimator.time == untouched.time, "a copy has changed its original")
        textbook, _ = run(program, TextbookEstimator())
        assert_equal(twin, textbook)


def check_bad_input(make: Make) -> None:
    """An unknown node, a known one, NaN, a node missing in a transition: an `InputError` or `UnknownNodeError`."""
    ids = [4, 8]

    def filled() -> Estimator:
        estimator = make()
        new_nodes(np.random.default_rng(0), ids, CAR).run(estimator)
        return estimator

    one = discretise(random_graph(np.random.default_rng(1), (CAR,), [4]), 0.3)
    mean, P = np.zeros((1, 4)), np.eye(4)[None]
    unknown = Measurements(np.array([99]), np.zeros((1, 2)), np.eye(2, 4), np.eye(2))
    calls: dict[str, Callable[[Estimator], object]] = {
        "add: a known node": lambda e: e.add([4], mean, P),
        "add: NaN": lambda e: e.add([5], mean * np.nan, P),
        "add: a singular covariance": lambda e: e.add([5], mean, 0 * P),
        "predict: a node missing": lambda e: e.predict(one),
        "update: an unknown node": lambda e: e.update(unknown),
        "marginalise: an unknown node": lambda e: e.marginalise([99]),
        "mean: an unknown node": lambda e: e.mean([99]),
        "restore: no snapshot": lambda e: e.restore((1, 2.0)),
    }
    for name, call in calls.items():
        estimator, untouched = filled(), filled()
        try:
            call(estimator)
        except SagaError:
            pass
        except Exception as error:
            raise AssertionError(f"{name}: expected an InputError, got {type(error).__name__}: {error}") from error
        else:
            raise AssertionError(f"{name}: expected an InputError")
        same = np.array_equal(estimator.joint_covariance(ids), untouched.joint_covariance(ids))
        require(same and estimator.nodes.tolist() == ids, f"{name}: has changed the estimator")


CHECKS: Sequence[Callable[[Make], None]] = (
    check_methods,
    check_programs,
    check_long_program,
    check_intervals,
    check_without_nodes,
    check_several_kinds,
    check_copies,
    check_bad_input,
)
"""Each raises `AssertionError` that names what differs, for the maker of fresh estimators that it is given."""


def check_estimator(make: Make) -> None:
    """Run all checks on the estimators that `make` makes, a class for example."""
    for check in CHECKS:
        try:
            check(make)
        except AssertionError as error:
            raise AssertionError(f"{check.__name__}: {error}") from error
