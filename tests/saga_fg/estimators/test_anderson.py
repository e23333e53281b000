"""Anderson acceleration finds fixed points in fewer steps, and survives where the map is wild."""

import numpy as np

from saga_fg.estimators.backward import AndersonAcceleration


def iterate(g, x, accelerated, steps):
    memory, scale = AndersonAcceleration(), np.ones_like(x)
    for count in range(steps):
        image = g(x)
        if np.abs(image - x).max() < 1e-10:
            return x, count
        x = memory.next(x, image, scale) if accelerated else image
    return x, steps


def test_a_slow_linear_map_takes_a_few_steps():
    rng = np.random.default_rng(0)
    A = 0.95 * np.linalg.qr(rng.normal(size=(4, 4)))[0]
    b = rng.normal(size=4)
    solution = np.linalg.solve(np.eye(4) - A, b)
    found, steps = iterate(lambda x: A @ x + b, np.zeros(4), True, 300)
    _, plain = iterate(lambda x: A @ x + b, np.zeros(4), False, 1000)
    np.testing.assert_allclose(found, solution, atol=1e-8)
    assert steps < 15 < 100 < plain


def test_a_nonlinear_map_converges_to_its_fixed_point():
    found, steps = iterate(np.cos, np.array([0.0, 3.0]), True, 100)
    np.testing.assert_allclose(found, 0.7390851332151607, atol=1e-8)
    assert steps < 30


def test_a_map_with_kinks_does_not_send_it_away():
    def g(x):
        return np.where(x > 1, 0.9 * x, 1 - 0.9 * x)

    found, steps = iterate(g, np.array([5.0, -3.0]), True, 500)
    assert steps < 500
    np.testing.assert_allclose(found, g(found), atol=1e-9)


def test_the_scale_decides_what_counts():
    memory = AndersonAcceleration()
    first = memory.next(np.zeros(2), np.array([1.0, 1e6]), np.array([1.0, 1e6]))
    np.testing.assert_array_equal(first, [1.0, 1e6])
    second = memory.next(first, first + np.array([0.5, 5e5]), np.array([1.0, 1e6]))
    np.testing.assert_allclose(second, [2.0, 2e6])  # the sum of the geometric series
