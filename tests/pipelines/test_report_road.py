"""The road in the page's player: what it is told, and what it draws."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from data_tools.metrics import SceneBoxes
from pipelines.report import Report, ReportScene, report_page
from pipelines.report.scenes import scene_data
from saga_fg import Boxes, Frame, Scene
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.frame import Detections
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight
from tests.pipelines.page_in_browser import tried_in_browser

ORIGIN = (100.0, 50.0)
LIGHT = TrafficLight("north", (130.0, 50.0))
MAP = RoadMap(
    (LIGHT,),
    (StopLine("line", (120.0, 51.75), (120.0, 48.25), "north"),),
    (Lane("lane", ((90.0, 50.0), (120.0, 50.0), (150.0, 52.0)), 3.5),),
)
LATER = RoadMap((TrafficLight("south", (100.0, 90.0)), TrafficLight("north", (0.0, 0.0))))
RED, GREEN, CAR = "traffic_light_red", "traffic_light_green", "car"


def frame(time: float, *seen: tuple[str, float, float], road_map: RoadMap | None = None) -> Frame:
    """Detections in the coordinates of the vehicle, which is stationary at the origin of the scene."""
    boxes = Boxes.of([label for label, _, _ in seen], [[x, y, 0.0] for _, x, y in seen])
    pose = yaw_transform(*ORIGIN)
    return Frame(time, "camera", Detections(boxes, np.ones(len(seen))), pose, "ego", road_map=road_map)


def report(*frames: Frame) -> ReportScene:
    """A scene of five moments, each second, without tracks."""
    scene = Scene("s", np.arange(5.0), np.tile(yaw_transform(*ORIGIN), (5, 1, 1)), ("",) * 5, frames)
    none = SceneBoxes(np.empty(0, dtype=np.int64), np.empty(0, dtype="<U1"), Boxes.of([], []), np.empty(0))
    return ReportScene(scene, {"saga": none}, {})


SEEN = report(
    frame(0.0, (CAR, 30.0, 0.0), road_map=MAP),
    frame(1.5, (GREEN, 30.5, 1.0), (RED, 30.0, 4.5), road_map=MAP),
    frame(2.5, (GREEN, 30.0, 0.0)),
    frame(2.7, (RED, 29.0, 0.0), (CAR, 30.0, 0.0), road_map=LATER),
    frame(4.0),
)


def test_a_scene_without_a_map_has_no_road() -> None:
    assert scene_data(report(frame(0.0, (RED, 1.0, 1.0))))["road"] is None


def test_lanes_lines_and_lights_are_in_centimetres_about_the_start() -> None:
    road = scene_data(SEEN)["road"]
    assert road["lanes"] == [[350, -1000, 0, 2000, 0, 5000, 200]]
    assert road["lines"] == [[0, 2000, 175, 2000, -175]]
    assert road["lights"] == [[3000, 0], [0, 4000]]  # what the later map says of "north" is not news
    json.dumps(road)


def test_a_light_has_the_colour_last_reported_of_it() -> None:
    green, red = 2, 0
    assert scene_data(SEEN)["road"]["colours"] == [[None, None], [None, None], [green, None], [red, None], [red, None]]


TRY = """
  const view = document.getElementById("view"), time = document.getElementById("time");
  const scene = document.getElementById("scene"), toggle = document.getElementById("show-road");
  const count = (r, g, b) => {
    const data = view.getContext("2d").getImageData(0, 0, view.width, view.height).data;
    let n = 0;
    for (let i = 0; i < data.length; i += 4) if (data[i] === r && data[i + 1] === g && data[i + 2] === b) n++;
    return n;
  };
  const drawn = () => ({red: count(224, 32, 44), green: count(24, 160, 74), band: count(228, 233, 238)});
  const at = k => { time.value = k; time.oninput(); return drawn(); };
  found.toggles = [toggle.parentElement.checkVisibility()];
  scene.selectedIndex = 1; scene.onchange();
  found.toggles.push(toggle.parentElement.checkVisibility());
  found.moments = [0, 2, 4].map(at);
  toggle.click();
  found.off = drawn();
"""


def test_the_browser_draws_the_road_where_there_is_one(tmp_path: Path) -> None:
    page = report_page(Report("road", [], [report(frame(0.0)), SEEN]))
    found = tried_in_browser(page, TRY, tmp_path)
    assert found["faults"] == []
    assert found["toggles"] == [False, True]
    nothing, green, red = found["moments"]
    assert nothing["red"] == nothing["green"] == 0
    assert green["green"] > 50
    assert green["red"] == 0
    assert red["red"] > 50
    assert red["green"] == 0
    assert all(moment["band"] > 5000 for moment in found["moments"])
    assert set(found["off"].values()) == {0}
