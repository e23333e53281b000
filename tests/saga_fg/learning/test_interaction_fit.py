"""Rates and widths of edge rules, found from the places at which hidden objects reappear."""

import dataclasses
import math

import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.learning import HiddenObjects, fit_interactions, hidden_objects
from saga_fg.learning.interaction_fit import RuleParameters
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.motion import ConstantVelocity
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
