"""Interaction functions of the running graph: what drivers and pedestrians do."""

import numpy as np
import pytest

from benchmarks.sampled_traffic import Interaction
from factors import Vector
from factors.manifolds import central_differences
from saga_fg.model import nonlinear_interactions
from saga_fg.model.nonlinear_interactions import (
    MAX_DECELERATION,
    IntelligentDriver,
    SmoothDriver,
    SocialForce,
    smooth_acceleration,
)


def test_the_round_corners_are_close_to_the_model_away_from_them():
    driver = IntelligentDriver()
    v, s, w = np.array([8.0, 10.0, 6.0]), np.array([15.0, 30.0, 20.0]), np.array([8.0, 9.0, 6.5])
    np.testing.assert_allclose(smooth_acceleration(driver, v, s, w).value, driver.alone(v, s, w).value, atol=0.02)
    assert smooth_acceleration(driver, np.array(15.0), np.array(0.1), np.array(0.0)).value > -MAX_DECELERATION - 0.01


def test_nobody_drives_backwards_however_close_the_leader_stands():
    law, x = Interaction(SmoothDriver()), np.array([0.0, 0.0, 3.0, 0.0])
    for _ in range(100):
        x = law.predict(x, [np.array([5.5, 0.0, 0.0, 0.0])], 0.1)
    assert 0.0 < x[0] < 2.0
    assert abs(x[2]) < 0.05


def test_a_follower_closes_up_to_the_gap_he_wants_and_no_farther():
    law, leader = Interaction(SmoothDriver()), np.array([100.0, 0.0, 8.0, 0.0])
    x = np.array([20.0, 0.0, 8.0, 0.0])
    for _ in range(1200):
        x, leader = law.predict(x, [leader], 0.1), leader + np.array([0.8, 0.0, 0.0, 0.0])
    assert x[2] == pytest.approx(8.0, abs=0.05)
    assert 8.0 < leader[0] - x[0] - float(SmoothDriver.alone) < 14.0


def test_pedestrians_push_each_other_away_and_stacks_are_the_same():
    law, rng = Interaction(SocialForce()), np.random.default_rng(0)
    x, others = rng.normal(size=(5, 4)), [rng.normal(size=(5, 4)) for _ in range(2)]
    together = law.predict(x, others, 0.2)
    for k in range(5):
        np.testing.assert_allclose(law.predict(x[k], [other[k] for other in others], 0.2), together[k])
    here, there = np.zeros(4), np.array([0.5, 0.0, 0.0, 0.0])
    assert law.predict(here, [there], 0.1)[2] < 0 < law.predict(there, [here], 0.1)[2]
    assert np.isfinite(law.predict(here, [here], 0.1)).all()
    assert law.predict(here, [], 0.1).tolist() == here.tolist()


PIECES = np.array([[-5.0, 0.0, 0.0, 1.0], [0.0, 1.0, 4.0, 0.0]])  # a wall with a corner
GIVEN = {
    "driver": (SmoothDriver(), np.array(4.0)),
    "standing": (SmoothDriver(IntelligentDriver(headway=0.5)), np.array(9.0)),
    "wall": (SocialForce(), PIECES),
}


@pytest.mark.parametrize("name", GIVEN)
def test_accelerations_and_their_derivatives(name):
    """Beside a wall, past its ends, behind its corner; next to a leader."""
    (law, given), rng = GIVEN[name], np.random.default_rng(2)
    own, other = 4 * rng.normal(size=(40, 4)), rng.normal(size=(40, 4))
    stacked = np.broadcast_to(given, (40, *given.shape))
    _, by_own, by_other = law.accelerations(own, other, stacked)  # type: ignore[attr-defined]
    expected = central_differences(
        lambda a, b: law.accelerations(a, b, stacked).value,  # type: ignore[attr-defined]
        [own, other],
        [Vector(4)] * 2,
    )
    np.testing.assert_allclose(by_own, expected[0], atol=1e-6 * max(1.0, np.abs(by_own).max()))
    np.testing.assert_allclose(by_other, expected[1], atol=1e-6 * max(1.0, np.abs(by_own).max()))


def test_a_wall_pushes_along_its_normal_and_from_its_end(monkeypatch):
    monkeypatch.setattr(nonlinear_interactions, "FALLOFF", 5.0)
    at, still = np.array([[-2.5, 2.5, 0, 0], [7.0, -4.0, 0, 0]]), np.zeros((2, 4))
    a = SocialForce().accelerations(at, still, np.stack([PIECES, PIECES])).value
    normal = np.array([-1.0, 5.0]) / np.sqrt(26)
    np.testing.assert_allclose(a[0] / np.hypot(*a[0]), normal, atol=1e-7)  # the farther piece acts by e^-17
    np.testing.assert_allclose(a[1] / np.hypot(*a[1]), [0.6, -0.8], atol=1e-12)
    assert np.hypot(*a[1]) == pytest.approx(2.0 * np.exp((0.6 - 5.0) / 5.0))
