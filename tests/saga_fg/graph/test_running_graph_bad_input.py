"""Law 6 of the running graph: whatever a provider gives, one clear error, and the smoother goes on as if not asked.

Each case runs in a process of its own, which a crash of the interpreter would end.
"""

import multiprocessing
import queue
import traceback

import gtsam
import numpy as np
import pytest

from factors import (
    ResidualFactors,
    Vector,
    gaussian_factor,
    interaction_factor,
    prior_factor,
    residual_factor,
)
from saga_fg import InputError, SceneGraph
from saga_fg.conformance.programs import CAR
from saga_fg.estimators import GraphFilter, IncrementalSmoother, JointKalmanFilter, RelinearisationSettings
from saga_fg.graph import EGO_POSE, LANDMARK, OBJECT, Additions, GraphError, NewVariable, SceneFactorGraph, key_of
from saga_fg.model.discretisation import discretise

UNIT = gtsam.noiseModel.Isotropic.Sigma


class Cars:
    """Two cars that keep going, seen at every epoch."""

    name = "cars"

    def factors(self, view):
        keys = [view.key(OBJECT, n) for n in (7, 12)]
        F = np.eye(4) + view.dt * np.eye(4, k=2)
        before = [one.key for one in view.before(OBJECT).values()]
        if before:
            new = [NewVariable(OBJECT, n, F @ view.state(k), label="car") for n, k in zip((7, 12), before, strict=True)]
            factors = [
                interaction_factor(k, [j], [F], np.zeros(4), 0.1 * np.eye(4)) for j, k in zip(before, keys, strict=True)
            ]
        else:
            new = [NewVariable(OBJECT, n, np.zeros(4), label="car") for n in (7, 12)]
            factors = [prior_factor(k, np.ones(4), np.eye(4)) for k in keys]
        return Additions(new, [*factors, *(gaussian_factor([k], [np.eye(2, 4)], [view.time, 1.0]) for k in keys)])


class Given:
    """Adds what a function of the view and the key of car 12 gives."""

    name = "user"

    def __init__(self, function):
        self.function = function

    def factors(self, view):
        return self.function(view, view.key(OBJECT, 12))


def adds(*factors):
    return Additions(factors=list(factors))


def single(key, residual, dim=4):
    return residual_factor((key,), (Vector(dim),), residual, np.eye(1), name="wall")


def custom(key, function, dim=1):
    return gtsam.CustomFactor(UNIT(dim, 1.0), [key], function)


def raising(*_):
    raise KeyError("oops")


CASES = {
    "nothing": (lambda v, k: None, "provider user: expected Additions, got NoneType"),
    "a list": (lambda v, k: [1], "provider user: expected Additions, got list"),
    "raises": (raising, r"provider user: KeyError\('oops'\)"),
    "no list of factors": (lambda v, k: Additions(factors=3), "expected a list of factors, got int"),
    "no list of variables": (lambda v, k: Additions(3), "variables: expected a list, got int"),
    "no names": (lambda v, k: Additions(named=[3]), "named: expected factors by name, got list"),
    "no factor": (lambda v, k: adds("x"), "expected a gtsam.JacobianFactor, a GTSAM nonlinear factor.*got str"),
    "no variable": (lambda v, k: Additions(["x"]), "expected NewVariable, got str"),
    "known variable": (
        lambda v, k: Additions([NewVariable(OBJECT, 12, np.zeros(4), label="car")]),
        "provider user: car 12 at 3.40 s: expected a new variable, it is in the graph already",
    ),
    "twice": (
        lambda v, k: Additions([NewVariable(LANDMARK, 1, np.zeros(2), static=True)] * 2),
        "landmark 1: expected a new variable, it is in the graph already",
    ),
    "undetermined": (
        lambda v, k: Additions([NewVariable(OBJECT, 3, np.zeros(4), label="dog")]),
        r"dog 3 at 3.40 s: not determined by the factors \(factors on dog 3 at 3.40 s: none\); expected a prior",
    ),
    "half determined": (
        lambda v, k: Additions(
            [NewVariable(OBJECT, 3, np.zeros(4), label="dog")],
            [gaussian_factor([v.key(OBJECT, 3)], [np.eye(2, 4)], np.zeros(2))],
        ),
        r"dog 3 at 3.40 s: not determined by the factors \(factors on dog 3 at 3.40 s: 1 linear factor\); expected",
    ),
    "NaN state": (lambda v, k: Additions([NewVariable(OBJECT, 3, np.full(4, np.nan))]), "object 3 at 3.40 s.*finite"),
    "NaN pose": (
        lambda v, k: Additions([NewVariable(EGO_POSE, 0, gtsam.Pose2(np.nan, 0, 0))]),
        "ego pose 0 at 3.40 s: expected a state of finite numbers",
    ),
    "a matrix as state": (
        lambda v, k: Additions([NewVariable(OBJECT, 3, np.eye(2))]),
        "expected a vector, a pose, a plane or a bias",
    ),
    "negative id": (lambda v, k: Additions([NewVariable(OBJECT, -3, np.zeros(4))]), "expected id to be a whole number"),
    "unknown variable": (
        lambda v, k: adds(prior_factor(key_of(OBJECT, 99, 34), np.zeros(4), np.eye(4))),
        "linear factor: expected variables of the graph, object 99 of epoch 34 is none: never added, or marginalised",
    ),
    "expired variable": (
        lambda v, k: adds(single(key_of(OBJECT, 12, 2), lambda x: x[:1])),
        "wall: expected variables of the graph, object 12 of epoch 2 is none: never added, or marginalised",
    ),
    "linear, too wide": (
        lambda v, k: adds(prior_factor(k, np.zeros(5), np.eye(5))),
        "user: linear factor on car 12 at 3.40 s: expected 4 columns, as the variables have dimensions, got 5",
    ),
    "linear, NaN": (
        lambda v, k: adds(gtsam.JacobianFactor(k, np.eye(4), np.full(4, np.nan), UNIT(4, 1.0))),
        "user: linear factor on car 12 at 3.40 s: expected finite numbers",
    ),
    "linear, constraint": (
        lambda v, k: adds(gtsam.JacobianFactor(k, np.eye(4), np.zeros(4), gtsam.noiseModel.Constrained.All(4))),
        "expected noise with variances",
    ),
    "native, too long": (
        lambda v, k: adds(gtsam.PriorFactorVector(k, np.zeros(5), UNIT(5, 1.0))),
        r"PriorFactorVector on car 12 at 3.40 s: expected variables Vector\(dim=5\)",
    ),
    "native, other noise": (
        lambda v, k: adds(gtsam.BearingRangeFactor2D(k, v.key(OBJECT, 7), gtsam.Rot2(), 1.0, UNIT(1, 1.0))),
        "BearingRangeFactor2D on car 12 at 3.40 s, car 7 at 3.40 s: ",
    ),
    "native, other type": (
        lambda v, k: adds(gtsam.PriorFactorPose2(k, gtsam.Pose2(), UNIT(3, 1.0))),
        "PriorFactorPose2 on car 12 at 3.40 s: .*type stored",
    ),
    "native, NaN": (
        lambda v, k: adds(gtsam.PriorFactorVector(k, np.full(4, np.nan), UNIT(4, 1.0))),
        "PriorFactorVector on car 12 at 3.40 s: expected a residual and Jacobians of finite numbers",
    ),
    "native, constraint": (
        lambda v, k: adds(gtsam.PriorFactorVector(k, np.zeros(4), gtsam.noiseModel.Constrained.All(4))),
        "PriorFactorVector: expected noise with variances, no hard constraint",
    ),
    "container": (
        lambda v, k: adds(gtsam.LinearContainerFactor(prior_factor(k, np.zeros(4), np.eye(4)))),
        "LinearContainerFactor: expected the linear factor itself",
    ),
    "custom, wrong residual": (
        lambda v, k: adds(custom(k, lambda this, values, H: np.zeros(3))),
        r"custom factor on car 12 at 3.40 s: residual: expected shape \(1\), got",
    ),
    "custom, no residual": (lambda v, k: adds(custom(k, lambda this, values, H: None)), "custom factor on car 12"),
    "custom, raises": (lambda v, k: adds(custom(k, raising)), r"custom factor on car 12 at 3.40 s: KeyError\('oops'\)"),
    "custom, NaN": (lambda v, k: adds(custom(k, lambda this, values, H: np.full(1, np.nan))), "custom factor.*finite"),
    "ours, raises": (lambda v, k: adds(single(k, raising)), "user: wall on car 12 at 3.40 s: .*oops"),
    "ours, NaN": (lambda v, k: adds(single(k, lambda x: [np.inf])), "wall on car 12 at 3.40 s: .*finite number"),
    "ours, other dimension": (
        lambda v, k: adds(single(k, lambda x: x[:1], dim=6)),
        r"wall on car 12 at 3.40 s: expected variables Vector\(dim=6\), got Vector\(dim=4\)",
    ),
    "stacked, other dimension": (
        lambda v, k: adds(ResidualFactors([[k]], (2,), lambda x: x, np.eye(2), name="walls")),
        r"walls on car 12 at 3.40 s: expected variables Vector\(dim=2\)",
    ),
}


def cases(names, reports):
    """Some cases; the name of each, or what went wrong, is put into `reports`."""
    for name in names:
        reports.put(name)
        try:
            case(*CASES[name])
        except BaseException:
            reports.put(f"{name}: {traceback.format_exc()}")
            return
    reports.put("done")


def case(function, message):
    """The error, and that nothing has happened."""
    good = [Cars()]
    smoother, untouched = IncrementalSmoother(good, lag=0.5), IncrementalSmoother(good, lag=0.5)
    for k in range(24, 34):
        smoother.step(0.1 * k)
        untouched.step(0.1 * k)
    with pytest.raises(GraphError, match=message):
        smoother.step(3.4, [Cars(), Given(function)])
    assert smoother.time == pytest.approx(3.3)
    for time in (3.4, 3.5):
        smoother.step(time)
        untouched.step(time)
    for key in untouched.graph().variables:
        np.testing.assert_allclose(smoother.state(key), untouched.state(key), atol=1e-12)
        np.testing.assert_allclose(smoother.covariance(key), untouched.covariance(key), atol=1e-10)
    assert smoother.graph().variables.keys() == untouched.graph().variables.keys()
    for back_end in (JointKalmanFilter, GraphFilter):
        in_the_tracker(back_end, function, message)


def in_the_tracker(back_end, function, message):
    """Check the message for an estimator of the tracker."""
    given = Given(lambda view, key: Additions())
    estimator = back_end([given])
    estimator.add([7, 12], np.ones((2, 4)), np.stack([np.eye(4)] * 2), {7: "car", 12: "car"})
    estimator.predict(discretise(SceneGraph.of([7, 12], CAR), 3.4))
    estimator.ask_providers()
    before = estimator.joint_mean([7, 12]), estimator.joint_covariance([7, 12])
    harmless, given.function = given.function, function
    with pytest.raises(GraphError, match=message):
        estimator.ask_providers()
    given.function = harmless
    estimator.ask_providers()
    np.testing.assert_allclose(estimator.joint_mean([7, 12]), before[0], atol=1e-12)
    np.testing.assert_allclose(estimator.joint_covariance([7, 12]), before[1], atol=1e-10)


@pytest.mark.parametrize("part", range(4))
def test_one_error_and_nothing_has_happened(part):
    context = multiprocessing.get_context("forkserver")  # a library with threads in this process can't be forked
    context.set_forkserver_preload(["pytest", "factors", "saga_fg.estimators"])
    reports = context.Queue()
    process = context.Process(target=cases, args=(list(CASES)[part::4], reports))
    process.start()
    said = ""
    while said != "done":
        try:
            said = reports.get(timeout=120)
        except queue.Empty:
            pytest.fail(f"{said}: ended with {process.exitcode}")
        assert "Traceback" not in said, said
    process.join()


def test_a_custom_factor_that_leaves_its_jacobians_out_is_differentiated():
    """GTSAM would crash."""
    smoother, plain = (IncrementalSmoother([Cars()]) for _ in range(2))
    wall = Given(lambda view, key: adds(custom(key, lambda this, values, H: values.atVector(key)[1:2] - 5.0)))
    for k in range(5):
        smoother.step(0.1 * k, [Cars(), wall])
        plain.step(0.1 * k)
    key = key_of(OBJECT, 12, 4)
    assert smoother.state(key)[1] > plain.state(key)[1] + 0.5


def test_a_factor_that_fails_on_the_way_is_named_and_the_smoother_goes_on():
    """Sound where it is linearised first, not where the estimate moves to."""

    def residual(x):
        if x[0] > 0.5:
            raise ValueError("out of the yard")
        return x[:1] - 0.9

    smoother = IncrementalSmoother(lag=None)
    new = NewVariable(OBJECT, 12, np.zeros(4))
    far = Given(lambda view, key: Additions([new], [single(key, residual)]))
    with pytest.raises(GraphError, match=r"object 12 at 0.00 s"):
        smoother.step(0.0, [far])
    smoother.step(0.0, [Cars()])
    assert smoother.state(key_of(OBJECT, 12, 0))[0] == pytest.approx(0.5)


def test_time_runs_forward(subtests):
    for time in [3.0, np.nan, np.inf]:
        with subtests.test(time=time):
            smoother = IncrementalSmoother([Cars()])
            smoother.step(3.0)
            with pytest.raises(GraphError, match=r"time: expected a finite number after 3\.0"):
                smoother.step(time)


def test_settings_and_snapshots_are_checked():
    with pytest.raises(InputError, match="lag: expected"):
        IncrementalSmoother(lag=-1.0)
    with pytest.raises(InputError, match="threshold"):
        RelinearisationSettings(threshold=-0.1)
    with pytest.raises(InputError, match="expected SceneFactorGraph"):
        IncrementalSmoother().restore(3)
    with pytest.raises(GraphError, match="object 4 of epoch 2 is not in the graph"):
        SceneFactorGraph().state(key_of(OBJECT, 4, 2))
