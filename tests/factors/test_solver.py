"""The solver: convergence, damping, robust weights, variables on manifolds, and what it says when it cannot."""

import gtsam
import numpy as np
import pytest

from factors import (
    FactorError,
    SingularSystemError,
    SolverSettings,
    Vector,
    gaussian_factor,
    gaussian_graph,
    interaction_factor,
    nonlinear_graph,
    prior_factor,
    prior_factors,
    residual_factor,
    solve,
)

X = [gtsam.symbol("x", i) for i in range(10)]
EMPTY = gtsam.NonlinearFactorGraph()


def values_of(states):
    values = gtsam.Values()
    for key, state in states.items():
        values.insert(key, state)
    return values


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def on_vector(residual, key=0, dim=2, m=2, **given):
    return residual_factor((key,), (Vector(dim),), residual, np.eye(m), **given)


@pytest.mark.parametrize("method", ["levenberg-marquardt", "line-search"])
def test_linear_problem_takes_one_step(method, covariance):
    rng = np.random.default_rng(0)
    factors = [prior_factor(X[0], rng.normal(size=3), covariance(rng, 3))]
    for i in range(6):
        factors.append(
            interaction_factor(X[i + 1], [X[i]], [rng.normal(size=(3, 3))], rng.normal(size=3), covariance(rng, 3))
        )
    start = values_of({X[i]: 10 * rng.normal(size=3) for i in range(7)})
    solution = solve(nonlinear_graph(factors, dict.fromkeys(X, 3)), [], start, SolverSettings(method=method))
    expected = gaussian_graph(factors).optimize()
    assert solution.converged
    assert solution.iterations <= 2
    for i in range(7):
        np.testing.assert_allclose(solution.values.atVector(X[i]), expected.at(X[i]), atol=1e-7)
    information, _ = gaussian_graph(factors).hessian(gtsam.Ordering(X[:7]))
    np.testing.assert_allclose(solution.covariance(X[2:4]), np.linalg.inv(information)[6:12, 6:12], rtol=1e-6)


@pytest.mark.parametrize("method", ["levenberg-marquardt", "line-search"])
def test_damped_methods_come_down_a_curved_valley(method):
    start = values_of({0: np.array([-1.2, 1.0])})
    solution = solve(EMPTY, [on_vector(rosenbrock)], start, SolverSettings(method))
    assert solution.converged
    np.testing.assert_allclose(solution.values.atVector(0), [1.0, 1.0], atol=1e-8)
    assert solution.error == pytest.approx(0.0, abs=1e-15)


def test_a_line_search_ends_the_to_and_fro_of_gauss_newton_or_says_that_nothing_helps():
    """x^2 = -1 at a prior of 0.3: the minimum is beside the prior, and full steps jump over it for ever."""
    factors = [on_vector(lambda x: x**2 + 1, dim=1, m=1), on_vector(lambda x: 0.5 * (x - 0.3), dim=1, m=1)]
    start = values_of({0: np.array([1.0])})
    searched = solve(EMPTY, factors, start, SolverSettings("line-search", 60))
    assert searched.converged
    x = searched.values.atVector(0)[0]
    assert 2 * x * (x**2 + 1) + 0.25 * (x - 0.3) == pytest.approx(0.0, abs=1e-5)
    assert searched.step.norm() < 1e-5
    uphill = on_vector(lambda x: x, dim=1, m=1, jacobians=lambda x: [-np.eye(1)])
    solution = solve(EMPTY, [uphill], values_of({0: np.array([1.0])}), SolverSettings("line-search"))
    assert not solution.converged
    assert solution.values.atVector(0)[0] == 1.0


def test_slow_convergence_ends_where_the_error_hardly_falls():
    factor = on_vector(
        lambda x: np.array([x[0] - 1, 3 + 0.1 * x[0] ** 2]), dim=1
    )  # a large residual: linear convergence
    start = values_of({0: np.zeros(1)})
    exact, soon = (solve(EMPTY, [factor], start, SolverSettings(relative_tolerance=share)) for share in (0.0, 1e-5))
    assert exact.converged
    assert soon.converged
    assert soon.iterations < exact.iterations - 3
    assert soon.error == pytest.approx(exact.error, rel=2e-5)


def test_running_out_of_iterations_is_reported():
    solution = solve(
        EMPTY, [on_vector(rosenbrock)], values_of({0: np.array([-1.2, 1.0])}), SolverSettings(max_iterations=2)
    )
    assert not solution.converged
    assert solution.iterations == 2
    assert solution.error < 0.5 * np.sum(rosenbrock(np.array([-1.2, 1.0])) ** 2)


def test_step_to_where_a_factor_is_undefined_is_shortened():
    def logarithm(x):
        return np.log(x - 1.0) if x[0] > 1 else np.array([np.nan])

    for method in ("levenberg-marquardt", "line-search"):
        start = values_of({0: np.array([10.0])})
        solution = solve(EMPTY, [on_vector(logarithm, dim=1, m=1)], start, SolverSettings(method))
        assert solution.converged
        assert solution.values.atVector(0)[0] == pytest.approx(2.0, abs=1e-8)


def test_free_variables_and_directions_are_named_in_systems_of_any_size():
    between = gaussian_factor(X[1:3], [np.eye(2), -np.eye(2)], [0.0, 0.0])
    graph = nonlinear_graph([prior_factor(X[0], [0.0, 0.0], np.eye(2)), between], dict.fromkeys(X, 2))
    start = values_of({key: np.ones(2) for key in X[:3]})
    for method in ("levenberg-marquardt", "line-search"):
        with pytest.raises(SingularSystemError, match="does not determine x1, x2") as caught:
            solve(graph, [], start, SolverSettings(method=method))
        assert caught.value.keys == (X[1], X[2])
    ranges = residual_factor((X[3],), (Vector(2),), lambda x: [np.hypot(*x) - 5.0], np.eye(1))
    known = on_vector(lambda x: x - [1.0, 2.0], X[1])
    with pytest.raises(SingularSystemError, match="does not determine x3;"):
        solve(EMPTY, [ranges, known], values_of({X[1]: np.ones(2), X[3]: np.array([3.0, 3.0])}))
    keys = [gtsam.symbol("x", i) for i in range(1100)]
    factors = prior_factors(keys[:-1], np.zeros((1099, 3)), np.eye(3)).native()
    factors.append(gaussian_factor([keys[-1]], [np.ones((1, 3))], [0.0]))
    with pytest.raises(SingularSystemError, match="near x1099") as caught:
        solve(nonlinear_graph(factors, dict.fromkeys(keys, 3)), [], values_of(dict.fromkeys(keys, np.ones(3))))
    assert caught.value.keys == (keys[-1],)


def test_variables_without_factors_and_factors_without_variables_are_named():
    graph = nonlinear_graph([prior_factor(X[0], [0.0], [[1.0]])], {X[0]: 1})
    with pytest.raises(SingularSystemError, match="no factor speaks of x4"):
        solve(graph, [], values_of({X[0]: np.zeros(1), X[4]: np.zeros(1)}))
    graph = nonlinear_graph([prior_factor(X[0], [0.0], [[1.0]])], {X[0]: 1})
    with pytest.raises(FactorError, match="expected x5, which factors speak of"):
        solve(graph, [on_vector(lambda x: x, X[5])], values_of({X[0]: np.zeros(1)}))


def test_linear_factor_on_another_dimension_is_refused(subtests):
    for state in [np.zeros(3), gtsam.Pose2()]:
        with subtests.test(state=state):
            graph = nonlinear_graph([prior_factor(X[0], [0.0, 0.0], np.eye(2))], {X[0]: 2})
            with pytest.raises(FactorError, match="2 columns, but these variables have 3 dimensions"):
                solve(graph, [], values_of({X[0]: state}))


def test_what_gtsam_cannot_evaluate_is_a_factor_error():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose2(X[0], gtsam.Pose2(), gtsam.noiseModel.Unit.Create(3)))
    with pytest.raises(FactorError, match="GTSAM could not evaluate"):
        solve(graph, [], values_of({X[0]: np.zeros(3)}))
    factor = prior_factor(X[0], [0.0], [[1.0]])
    factor.getb()[0] = np.nan
    with pytest.raises(FactorError, match="not finite"):
        solve(nonlinear_graph([factor], {X[0]: 1}), [], values_of({X[0]: np.zeros(1)}))


def test_bad_settings_are_refused(subtests):
    for given in [
        {"method": "newton"},
        {"max_iterations": 0},
        {"tolerance": 0.0},
        {"damping": -1.0},
        {"tolerance": np.nan},
        {"relative_tolerance": -1e-9},
    ]:
        with subtests.test(given=given), pytest.raises(FactorError):
            SolverSettings(**given)
