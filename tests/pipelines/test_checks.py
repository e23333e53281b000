"""Warnings of settings that have no effect: those of another estimator, and lanes that nothing reads."""

from dataclasses import replace

from pipelines.checks import Checks
from pipelines.config import TrackConfig, load_config
from saga_fg import Curvilinear, TrackerSettings
from saga_fg.model.lanes import InLane
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.types.road_map import Lane, RoadMap

ROAD = RoadMap(lanes=(Lane("lane", ((0.0, 0.0), (50.0, 0.0))),))
FOLLOWS = {"car": ClassSettings(Curvilinear(course_time=0.7))}


def said(caplog, method="saga", **tracker):
    config = TrackConfig(tracker=replace(TrackerSettings(), **{"road_map": ROAD, **tracker}))
    caplog.clear()
    checks = Checks(config.of_method(method))
    checks.finish()
    checks.finish()
    return [each.getMessage() for each in caplog.records if "lanes" in each.getMessage()]


def test_lanes_that_nothing_reads_are_said_once(caplog):
    (message,) = said(caplog)
    assert "tracker.road_map.lanes: no class follows them (motion.course_time)" in message


def test_lanes_without_a_reach_lead_nobody(caplog):
    assert len(said(caplog, classes=FOLLOWS, traffic=TrafficSettings(reach=0.0))) == 1


def test_lanes_that_are_read_are_not_doubted(caplog):
    for tracker in [{"classes": FOLLOWS}, {"edges": (InLane(),)}, {"road_map": None}]:
        assert said(caplog, **tracker) == []


def test_methods_without_lanes_say_nothing(caplog):
    assert said(caplog, method="kf") == []


def said_of(caplog, **tracker):
    caplog.clear()
    usual = TrackConfig()
    Checks(replace(usual, tracker=TrackerSettings(**tracker)), usual)
    return [each.getMessage() for each in caplog.records]


def test_a_setting_without_effect_is_said_once(caplog):
    for tracker, named in [
        ({"estimator": "isam2", "lag": 5.0}, "lag: 5"),
        ({"estimator": "kalman", "lag": 5.0}, "lag: 5"),
        ({"estimator": "isam2", "tolerance": 0.5, "max_component": 1}, "tolerance: 0.5, max_component: 1"),
        ({"estimator": "fixed-lag", "max_component": 32}, "max_component: 32"),
    ]:
        (message,) = said_of(caplog, **tracker)
        assert message.startswith(f"tracker: {named}: without effect with estimator: {tracker['estimator']}")


def test_settings_that_act_are_not_doubted(caplog):
    for tracker in [
        {"estimator": "isam2"},
        {"estimator": "isam2", "tolerance": 0.0, "max_component": 10_000},  # exact, as asked for
        {"estimator": "fixed-lag", "lag": 5.0},
        {"estimator": "kalman", "tolerance": 0.5, "max_component": 1},
    ]:
        assert said_of(caplog, **tracker) == []


def test_shipped_settings_are_not_doubted(caplog):
    for family in ["nuscenes", "kitti", "file"]:
        Checks(load_config(family), load_config("file"))
        assert [each for each in caplog.records if "without effect" in each.getMessage()] == []
