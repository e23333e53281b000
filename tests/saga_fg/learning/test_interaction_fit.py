"""Rates and widths of edge rules, found from the places at which hidden objects reappear."""

import dataclasses
import math

import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.learning import HiddenObjects, fit_interactions, hidden_objects, negative_log_likelihood
from saga_fg.learning.interaction_fit import RuleParameters
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.motion import ConstantVelocity
from saga_fg.model.nonlinear_interactions import IntelligentDriver
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.tracking import ClassSettings, TrackerSettings
from tests.saga_fg.following_pairs import GAP, RATE, following_pairs

SENSORS = {"default": Sensor(noise={"default": NoiseModel(position=0.01)})}
CLASSES = {"default": ClassSettings(motion=ConstantVelocity(0.5), initial_speed_deviation=8.0, max_distance=20.0)}
SETTINGS = TrackerSettings(classes=CLASSES, edges=())
SHORT = 1.5
FOLLOW = Following(CarFollowing(time_constant=math.inf), rate=0.3, gap_scale=20.0)


def gaps_of(seed, **how):
    return hidden_objects(following_pairs(seed=seed, **how), SETTINGS, SENSORS, SHORT)


def last_error(sample, rules):
    apart = sample.place[:, -1] - sample.predict(SETTINGS, rules).position[:, -1]
    return float(np.nanmean(np.hypot(*apart.T)))


def test_the_known_rate_is_found_again_and_lowers_errors_on_other_recordings():
    fitted = fit_interactions(gaps_of(1), SETTINGS, (FOLLOW,), iterations=10, prior=0.02)
    rule = fitted.rules[0]
    assert rule.rate * math.exp(-GAP / rule.gap_scale) == pytest.approx(RATE, rel=0.5)
    other = gaps_of(2)
    assert last_error(other, fitted.rules) < 0.9 * last_error(other, ())


def test_templates_pull_and_are_left_out_where_their_classes_do_not_occur():
    sample = gaps_of(1, pairs=2)
    away = [
        abs(math.log(fit_interactions(sample, SETTINGS, (FOLLOW,), 4, prior).rules[0].rate / FOLLOW.rate))
        for prior in (0.02, 0.4, 10.0)
    ]
    assert away[0] > away[1] > away[2]
    walking = Neighbours(SharedVelocity(), classes=("pedestrian",))
    assert fit_interactions(gaps_of(1, pairs=1), SETTINGS, (FOLLOW, walking), iterations=1).rules[0].classes[0] == "car"


def test_a_search_can_begin_where_another_ended():
    sample = gaps_of(1, pairs=3)
    first = fit_interactions(sample, SETTINGS, (FOLLOW,), iterations=8, prior=0.0)
    again, anew = (fit_interactions(sample, SETTINGS, rules, 1, prior=0.0) for rules in (first.rules, (FOLLOW,)))
    assert again.loss <= first.loss + 1e-9
    assert again.loss < anew.loss - 1e-3, "one iteration from the template does not get there"


def test_where_nobody_follows_rules_change_nothing():
    scene = following_pairs(pairs=2, moments=60, seed=3, apart=500.0)
    truth = [each.boxes.position + [[0], [0], [900.0], [900.0]] * np.array([[0, 1, 0]]) for each in scene.ground_truth]
    truth = [
        dataclasses.replace(each, boxes=dataclasses.replace(each.boxes, position=places))
        for each, places in zip(scene.ground_truth, truth, strict=True)
    ]
    frames = [
        dataclasses.replace(frame, detections=dataclasses.replace(frame.detections, boxes=each.boxes))
        for frame, each in zip(scene.frames, truth, strict=True)
    ]
    lonely = hidden_objects(dataclasses.replace(scene, ground_truth=truth, frames=frames), SETTINGS, SENSORS, SHORT)
    assert (lonely.neighbours < 0).all()
    rules = fit_interactions(lonely, SETTINGS, (FOLLOW,), iterations=2).rules
    np.testing.assert_allclose(
        lonely.predict(SETTINGS, rules).position, lonely.predict(SETTINGS, ()).position, atol=1e-9
    )


def test_how_wide_the_process_noise_is_does_not_matter():
    sample = gaps_of(1, pairs=3)
    prediction = sample.predict(SETTINGS, (FOLLOW,))
    wide = prediction._replace(P=4 * prediction.P + 0.03 * np.eye(2))  # with the noise of the places four times as wide
    assert negative_log_likelihood(sample, wide) == pytest.approx(negative_log_likelihood(sample, prediction))


def test_all_finite_rates_and_widths_of_rules_are_parameters():
    @dataclasses.dataclass(frozen=True)
    class Ahead:
        interaction: SharedVelocity = SharedVelocity()
        rate: float = 0.4
        path_scale: float = 2.0
        gap_scale: float = math.inf
        max_gap: float = 50.0

    parameters = RuleParameters.from_rules((FOLLOW, Ahead()))
    of_following = [(0, name) for name in ("rate", "gap_scale", "lateral_scale", "heading_scale")]
    assert parameters.names == (*of_following, (1, "rate"), (1, "path_scale"))
    np.testing.assert_allclose(np.exp(parameters.bounds[-1]), (0.2, 20.0))
    first, second = parameters.valued(parameters.start + math.log(2))
    assert (first.rate, first.gap_scale, second.path_scale) == pytest.approx((0.6, 40.0, 4.0))
    assert (first.max_gap, second.gap_scale) == (FOLLOW.max_gap, math.inf)


def test_learning_from_nothing_is_an_error():
    sample = gaps_of(1, pairs=1)
    with pytest.raises(InputError, match="at least one object that is followed"):
        fit_interactions(HiddenObjects.pooled([sample]).select(slice(0, 0)), SETTINGS, (FOLLOW,))


def test_the_law_of_drivers_is_learned():
    driver = IntelligentDriver(headway=1.1, free_speed=20.0)
    parameters = RuleParameters.from_rules((Following(driver, rate=1.0, gap_scale=math.inf),))
    names = [name for _, name in parameters.names]
    laws = {
        f"interaction.{name}" for name in ("headway", "standstill_gap", "acceleration", "deceleration", "free_speed")
    }
    assert laws <= set(names)
    assert "interaction.time_constant" not in names, "scales the rate alone"
    x = parameters.start.copy()
    x[names.index("interaction.headway")] = math.log(2.0)
    (rule,) = parameters.valued(x)
    assert rule.interaction.headway == pytest.approx(2.0)
    assert rule.interaction.free_speed == pytest.approx(20.0)
