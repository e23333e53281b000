"""What would crash GTSAM, or make no sense, is refused."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import FactorError
from factors.validation import (
    checked_key_array,
    checked_key_rows,
    checked_keys,
    format_key,
    whitener,
    whiteners,
)

TRAPS = {
    "block of wrong height": "gaussian_factor([1, 2], [I2, np.eye(3)], np.zeros(2))",
    "right-hand side of wrong length": "gaussian_factor([1], [I2], np.zeros(3), np.eye(3))",
    "matrix instead of a vector": "prior_factor(1, np.zeros((2, 1)), I2)",
    "covariance of wrong shape": "prior_factor(1, np.zeros(2), np.eye(3))",
    "singular covariance": "prior_factor(1, np.zeros(2), np.zeros((2, 2)))",
    "nan in a mean": "prior_factor(1, [np.nan, 0.0], I2)",
    "nan in a nonlinear measurement": "detection_factors([1], Radar(4), [[1.0, np.nan, 0.0]], np.eye(3))",
    "nan in an interaction": "interaction_factor(1, [2], [[[np.nan]]], [0.0], [[1.0]])",
    "empty factor": "gaussian_factor([], [], [])",
    "factor without columns": "gaussian_factor([1], [np.zeros((2, 0))], np.zeros(2))",
    "no arrays at all": "gaussian_factor([1], [None], ['b'])",
    "step of wrong blocks": "interaction_factors([9], [1], [0, 1], [I2], [[0, 0, 0]], [np.eye(3)])",
    "step with keys missing": "interaction_factors([9], [1], [0, 2], [I2], [[0, 0]], [I2])",
    "step with rows out of range": "interaction_factors([9], [1], [-1, 0], [I2], [[0, 0]], [I2])",
    "many factors, one covariance missing": "prior_factors([1, 2, 3], np.zeros((3, 2)), [I2, I2])",
    "interaction with a key missing": "interaction_factor(1, [2, 3], [I2], np.zeros(2), I2)",
    "joint prior with a mean missing": "joint_prior_factor([1, 2], [np.zeros(2)], I2)",
    "joint prior of wrong size": "joint_prior_factor([1, 2], [np.zeros(2), np.zeros(2)], np.eye(3))",
    "one key in two dimensions": "nonlinear_graph([small, prior_factor(1, [0.0, 0.0], I2)], {1: 2})",
    "one key in two dimensions, linear": "check_dimensions([small, prior_factor(1, [0.0, 0.0], I2)], {1: 1})",
    "key of unknown dimension": "nonlinear_graph([small], {2: 1})",
    "marginal of an unknown key": "marginal_factors(gaussian_graph([small]), [2])",
    "moments of an unknown key": "marginal_moments(gaussian_graph([small]), [2])",
    "marginal of an empty graph": "marginal_factors(gaussian_graph([]), [1])",
    "marginal of a free variable": "marginal_factors(gaussian_graph([loose]), [1])",
    "covariance of a free variable": "marginal_moments(gaussian_graph([loose]), [1, 2])",
    "solving with a free variable": "solve(nonlinear_graph([loose], {1: 3, 2: 2}), [], values)",
    "custom factor without Jacobians": "solve(graph_of(lambda this, values, H: values.atVector(1)), [], values)",
    "linearising a custom factor without Jacobians": "linearised(graph_of(lambda *_: np.zeros(3)), [], values)",
    "solving with another type of variable": "solve(nonlinear_graph([flat], {1: 2}), [], posed)",
}


def test_every_trap_is_an_exception(run_apart):
    code = f"""
I2 = np.eye(2)
small = prior_factor(1, [0.0], [[1.0]])
flat = prior_factor(1, [0.0, 0.0], I2)
loose = gaussian_factor([1, 2], [np.eye(2, 3), I2], np.zeros(2))
values, posed = gtsam.Values(), gtsam.Values()
values.insert(1, np.zeros(3))
values.insert(2, np.zeros(2))
posed.insert(1, gtsam.Pose2())

def graph_of(evaluate):
    graph = nonlinear_graph([gaussian_factor([2], [I2], np.zeros(2))], {{2: 2}})
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, 0.5), [1], evaluate))
    return graph

for name, call in {TRAPS!r}.items():
    print(name, end=": ", flush=True)  # so that a crash tells where
    try:
        eval(call)
        print("accepted")
    except FactorError as error:
        print("refused,", error)
"""
    lines = run_apart(code).splitlines()
    assert len(lines) == len(TRAPS)  # one line each, meant for people
    for name, line in zip(TRAPS, lines, strict=True):
        assert line.startswith(f"{name}: refused, ")


FAULTS = {
    "unset jacobians": ("np.zeros(2)", "[]"),
    "no jacobians": ("np.zeros(2)", "None"),
    "one jacobian missing": ("np.zeros(2)", "[np.eye(2)]"),
    "jacobian transposed": ("np.zeros(2)", "[np.eye(2), np.ones((3, 2))]"),
    "jacobian too small": ("np.zeros(2)", "[np.eye(2), np.eye(2)]"),
    "jacobian flat": ("np.zeros(2)", "[np.eye(2), np.ones(6)]"),
    "jacobian of nan": ("np.zeros(2)", "[np.eye(2), np.full((2, 3), np.nan)]"),
    "residual too long": ("np.zeros(3)", "[np.eye(2), np.ones((2, 3))]"),
    "residual of nan": ("np.full(2, np.nan)", "[np.eye(2), np.ones((2, 3))]"),
    "residual none": ("None", "[np.eye(2), np.ones((2, 3))]"),
    "exception": ("1 / 0", "[np.eye(2), np.ones((2, 3))]"),
}

SETTING = """
fault = None  # or what the functions do instead of what they should
def residual(x, y):
    return eval(fault[0]) if fault else x - y[:2]
def jacobians(x, y):
    return eval(fault[1]) if fault else [np.eye(2), -np.eye(2, 3)]
factor = residual_factor((1, 2), (Vector(2), Vector(3)), residual, np.eye(2), jacobians)
values = gtsam.Values()
values.insert(1, np.ones(2))
values.insert(2, np.zeros(3))
known = [prior_factor(1, np.zeros(2), np.eye(2)), prior_factor(2, np.ones(3), np.eye(3))]
priors = nonlinear_graph(known, {1: 2, 2: 3})
"""


def test_faulty_functions_in_gtsams_optimisers_are_exceptions(run_apart):
    code = (
        SETTING
        + f"""
graph = priors.clone()
graph.add(factor.custom_factors()[0])
attempts = (
    lambda: gtsam.LevenbergMarquardtOptimizer(graph, values).optimize(),
    lambda: gtsam.GaussNewtonOptimizer(graph, values).optimize(),
    lambda: graph.linearize(values),
    lambda: solve(priors, [factor], values),
)
for name, wrong in {FAULTS!r}.items():
    for attempt in attempts:
        fault = wrong
        print(name, flush=True, end=": ")
        try:
            attempt()
            print("accepted")
        except FactorError as error:
            print("refused,", error)
    fault = None
    assert gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().size() == 2
"""
    )
    lines = run_apart(code).splitlines()
    assert len(lines) == 4 * len(FAULTS)
    for i, line in enumerate(lines):
        assert line.startswith(f"{list(FAULTS)[i // 4]}: refused, factor on 1, 2: ")


def test_traceback_of_a_faulty_function_can_be_printed(run_apart):
    """Objects that GTSAM lends to a callback must not be found, dangling, in the frames of a traceback."""
    code = (
        SETTING
        + """
import gc
def failing_frames():
    graph = priors.clone()
    graph.add(factor.custom_factors()[0])
    try:
        graph.linearize(values)
    except FactorError as error:
        trace, frames = error.__traceback__, []
        while trace.tb_next is not None:
            trace = trace.tb_next
            frames.append(dict(trace.tb_frame.f_locals))
        return frames
fault = ("1 / 0", "None")
frames = failing_frames()
gc.collect()
lent = [name for frame in frames for name, it in frame.items() if isinstance(it, gtsam.JacobianVector | gtsam.Factor)]
print(len(frames) > 1, lent, len(repr(frames)) > 0)
"""
    )
    assert run_apart(code) == "True [] True\n"


# Checks at the door: what is accepted comes out right, what is not is named


@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_whitened_covariance_is_identity(seed, dim):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(dim, dim)) * np.exp(rng.uniform(-3, 3, dim))[:, None]
    covariance = root @ root.T + 1e-3 * np.diag(np.diag(root @ root.T))
    W = whitener("Q", covariance, dim)
    np.testing.assert_allclose(W @ covariance @ W.T, np.eye(dim), atol=1e-7)
    assert (np.tril(W, -1) == 0).all()


def test_bad_covariance_is_refused(subtests):
    for covariance, message in [
        ([[1.0, 1.0], [1.0, 1.0]], "singular"),
        ([[1e-30, 0.0], [0.0, 0.0]], "singular"),
        ([[1.0, 2.0], [2.0, 1.0]], "singular or indefinite"),
        ([[-1.0, 0.0], [0.0, 1.0]], "singular or indefinite"),
        ([[1.0, 0.5], [0.0, 1.0]], "symmetric"),
        ([[1.0, np.nan], [np.nan, 1.0]], r"Q\[0, 1\]: expected a finite number, got nan"),
        ([[1.0, 0.0]], r"expected shape \(2, 2\), got \(1, 2\)"),
        ([1.0, 1.0], "expected shape"),
        ("noise", "expected numbers"),
    ]:
        with subtests.test(message), pytest.raises(FactorError, match=message):
            whitener("Q", covariance, 2)


def test_whiteners_take_any_scale_and_name_a_bad_entry():
    covariance = np.diag([1e-12, 1e12])
    np.testing.assert_allclose(whitener("Q", covariance, 2), np.diag([1e6, 1e-6]))
    stack = np.stack([np.eye(2), np.ones((2, 2)), np.eye(2)])
    with pytest.raises(FactorError, match=r"Q\[1\]"):
        whiteners("Q", stack)


def test_keys_are_any_of_gtsams_each_once_and_nothing_else(subtests):
    for keys in [[-1], [1.5], ["x"], [2**64], [[1, 2]], [True], [None]]:
        with subtests.test(keys=keys):
            with pytest.raises(FactorError, match=r"integers|shape"):
                checked_key_rows("keys", [keys], 1)
            with pytest.raises(FactorError, match=r"integers|shape"):
                checked_keys("keys", keys)
    keys = [0, gtsam.symbol("x", 3), 2**64 - 1]
    assert checked_keys("keys", keys) == tuple(keys)
    assert checked_key_array("keys", np.array(keys, np.uint64)).tolist() == keys
    assert [format_key(key) for key in keys] == ["0", "x3", str(2**64 - 1)]
    with pytest.raises(FactorError, match="x1 occurs twice"):
        checked_keys("keys", [gtsam.symbol("x", 1), 2, gtsam.symbol("x", 1)])
