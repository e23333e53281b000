"""The warning of lanes in the settings that nothing reads."""

from dataclasses import replace

import pytest

from pipelines.checks import Checks
from pipelines.config import TrackConfig
from saga_fg import Curvilinear, TrackerSettings
from saga_fg.model.lanes import InLane
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.types.road_map import Lane, RoadMap

ROAD = RoadMap(lanes=(Lane("lane", ((0.0, 0.0), (50.0, 0.0))),))
FOLLOWS = {"car": ClassSettings(Curvilinear(course_time=0.7))}


def said(caplog, method="saga", **tracker):
    config = TrackConfig(tracker=replace(TrackerSettings(), **{"road_map": ROAD, **tracker}))
    doubts = Checks(config.of_method(method))
    doubts.finish()
    doubts.finish()
    return [each.getMessage() for each in caplog.records if "lanes" in each.getMessage()]


def test_lanes_that_nothing_reads_are_said_once(caplog):
    (message,) = said(caplog)
    assert "tracker.road_map.lanes: no class follows them (motion.course_time)" in message


def test_lanes_without_a_reach_lead_nobody(caplog):
    assert len(said(caplog, classes=FOLLOWS, traffic=TrafficSettings(reach=0.0))) == 1


@pytest.mark.parametrize(
    "tracker", [{"classes": FOLLOWS}, {"edges": (InLane(),)}, {"road_map": None}], ids=["course", "rule", "no map"]
)
def test_lanes_that_are_read_are_not_doubted(caplog, tracker):
    assert said(caplog, **tracker) == []


def test_methods_without_lanes_say_nothing(caplog):
    assert said(caplog, method="kf") == []
