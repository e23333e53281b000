"""The warning of settings that the chosen estimator does not have."""

from dataclasses import replace

import pytest

from pipelines.checks import Checks
from pipelines.config import TrackConfig, load_config
from saga_fg import TrackerSettings


def said(caplog, **tracker):
    usual = TrackConfig()
    Checks(replace(usual, tracker=TrackerSettings(**tracker)), usual)
    return [each.getMessage() for each in caplog.records]


@pytest.mark.parametrize(
    ("tracker", "named"),
    [
        ({"estimator": "isam2", "lag": 5.0}, "lag: 5"),
        ({"estimator": "kalman", "lag": 5.0}, "lag: 5"),
        ({"estimator": "isam2", "tolerance": 0.5, "max_component": 1}, "tolerance: 0.5, max_component: 1"),
        ({"estimator": "fixed-lag", "max_component": 32}, "max_component: 32"),
    ],
)
def test_a_setting_without_effect_is_said_once(caplog, tracker, named):
    (message,) = said(caplog, **tracker)
    assert message.startswith(f"tracker: {named}: without effect with estimator: {tracker['estimator']}")


@pytest.mark.parametrize(
    "tracker",
    [
        {"estimator": "isam2"},
        {"estimator": "isam2", "tolerance": 0.0, "max_component": 10_000},  # exact, as asked for
        {"estimator": "fixed-lag", "lag": 5.0},
        {"estimator": "kalman", "tolerance": 0.5, "max_component": 1},
    ],
)
def test_settings_that_act_are_not_doubted(caplog, tracker):
    assert said(caplog, **tracker) == []


@pytest.mark.parametrize("family", ["nuscenes", "kitti", "file"])
def test_shipped_settings_are_not_doubted(caplog, family):
    Checks(load_config(family), load_config("file"))
    assert [each for each in caplog.records if "without effect" in each.getMessage()] == []
