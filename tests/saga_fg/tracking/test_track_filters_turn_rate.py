"""Turn rates from headings, and what they do to tracks that nobody detects."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Curvilinear, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.track_filters import DEVIATION, STRAIGHT, TURNING, TurnRate
from tests.saga_fg.traffic_frames import frame

DT, RATE, SPEED = 0.1, 0.3, 8.0
SENSORS = {"default": Sensor(noise={"default": NoiseModel(position=0.1, yaw=0.03)})}
MOTION = Curvilinear(turn_time=2.0)
SHARE = 0.3  # of objects that turn
TURNS = TrackerSettings(classes={"default": ClassSettings(motion=MOTION, max_deviation=20.0)}, edges=())
NO_TURNS = replace(TURNS, classes={"default": replace(TURNS.classes["default"], motion=replace(MOTION, turn_time=0.0))})


def estimated(rates, noise=0.03, seed=0, flipped=0.0):
    """The filter after headings that turn by `rates` (T,), rad/s."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rates) * DT
    turn = TurnRate.initiated(np.zeros(1), np.array([noise]))
    for h in heading:
        turn.predict(DT, np.array([2.0]))
        half = np.pi * (rng.random() < flipped)
        turn.update(np.array([0]), np.array([h + half + noise * rng.normal()]), np.array([noise]))
    return turn


def known(turn):
    """The rate to predict with."""
    return turn.known(np.array([0]), SHARE)[0].item()


@pytest.mark.parametrize("flipped", [0.0, 0.5])
def test_the_rate_of_a_turn_is_found_whichever_way_round_the_boxes_are(flipped):
    turn = estimated(np.full(20, RATE), flipped=flipped)
    assert turn.rate.item() == pytest.approx(RATE, abs=0.08)
    assert known(turn) == pytest.approx(turn.rate.item(), abs=0.06), "a clear turn is hardly shrunk"


def test_noise_is_no_turn():
    rates = [abs(known(estimated(np.zeros(20), seed=seed))) for seed in range(30)]
    assert np.median(rates) < 0.01
    assert max(rates) < 0.15


def test_mean_and_variance_are_those_of_the_mixture_of_turning_and_straight(subtests):
    for rate in [0.0, 0.05, 0.4]:
        with subtests.test(rate=rate):
            turn = estimated(np.full(20, rate))
            w, P, x = turn.rate.item(), turn.P[0, 1, 1], np.linspace(-2, 2, 40001)
            normal = lambda d, s: np.exp(-0.5 * (d / s) ** 2) / s  # noqa: E731
            density = (SHARE * normal(x, TURNING) + (1 - SHARE) * normal(x, STRAIGHT)) * normal(w - x, np.sqrt(P))
            mean = (x * density).sum() / density.sum()
            variance = ((x - mean) ** 2 * density).sum() / density.sum()
            assert [value.item() for value in turn.known(np.array([0]), SHARE)] == pytest.approx(
                [mean, variance], rel=1e-4
            )


def test_a_wild_heading_counts_little():
    turn = estimated(np.zeros(20))
    before = turn.rate.item()
    turn.update(np.array([0]), np.array([1.0]), np.array([0.03]))
    assert abs(turn.rate.item() - before) < 0.1


def test_unseen_a_rate_fades_to_none_and_its_deviation_returns():
    turn = estimated(np.full(20, RATE))
    turn.predict(30.0, np.array([2.0]))
    assert turn.rate.item() == pytest.approx(0.0, abs=1e-5)
    assert turn.P[0, 1, 1] == pytest.approx(DEVIATION**2)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_two_steps_predict_as_one(share):
    one, two = (estimated(np.full(20, RATE)) for _ in range(2))
    one.predict(0.5, np.array([2.0]))
    two.predict(share * 0.5, np.array([2.0]))
    two.predict((1 - share) * 0.5, np.array([2.0]))
    for name in ("heading", "rate", "P"):
        assert getattr(two, name) == pytest.approx(getattr(one, name), abs=1e-12)


def test_without_headings_nothing_is_known():
    turn = TurnRate.initiated(np.array([np.nan]), np.array([np.pi]))
    turn.update(np.array([0]), np.array([np.nan]), np.array([np.pi]))
    assert known(turn) == 0.0
    turn.update(np.array([0]), np.array([0.5]), np.array([0.1]))
    assert turn.heading.item() == pytest.approx(0.5)


def test_a_first_heading_after_a_while_leaves_a_covariance():
    turn = TurnRate.initiated(np.array([np.nan]), np.array([np.pi]))
    turn.predict(1.0, np.array([2.0]))
    for k in range(20):
        turn.update(np.array([0]), np.array([RATE * k * DT]), np.array([0.03]))
        assert np.linalg.eigvalsh(turn.P[0]).min() > 0
        assert abs(known(turn)) < 2 * RATE
        turn.predict(DT, np.array([2.0]))
    assert turn.rate.item() == pytest.approx(RATE, abs=0.08)


def test_beyond_two_deviations_of_its_innovation_a_heading_counts_less():
    turn = estimated(np.zeros(20))
    S = turn.P[0, 0, 0] + 0.03**2
    gains = []
    for off in (1.9, 4.0):
        after = TurnRate(turn.heading.copy(), turn.rate.copy(), turn.P.copy())
        after.update(np.array([0]), turn.heading + off * np.sqrt(S), np.array([0.03]))
        gains.append((after.heading - turn.heading).item() / (off * np.sqrt(S)))
    assert gains[0] == pytest.approx(turn.P[0, 0, 0] / S)
    assert gains[1] == pytest.approx(gains[0] / 4)


def circle(t):
    """Position and heading at times t on a circle."""
    return SPEED / RATE * np.array([np.sin(RATE * t), 1 - np.cos(RATE * t)]), RATE * t


def coasting_error(settings, gap):
    """Mean error of the position `gap` s after the last detection of an object that turns."""
    errors = []
    for seed in range(8):
        rng, tracker = np.random.default_rng(seed), Tracker(settings, SENSORS)
        for k in range(25):
            p, yaw = circle(k * DT)
            seen = frame(k * DT, [p + 0.1 * rng.normal(size=2)], yaw=yaw + 0.03 * rng.normal())
            tracker.step(seen)
        tracks = tracker.tracks(24 * DT + gap)
        errors.append(np.hypot(*(tracks.boxes.position[0, :2] - circle(24 * DT + gap)[0])))
    return np.mean(errors)


@pytest.mark.parametrize("gap", [1.0, 2.0])
def test_turning_objects_are_followed_round_the_bend(gap):
    assert coasting_error(TURNS, gap) < 0.8 * coasting_error(NO_TURNS, gap)
