"""A road in several maps: elements that come again are known, others of a name that is taken get one of their own."""

from __future__ import annotations

from dataclasses import replace

from saga_fg.model.sensor import Sensor
from saga_fg.model.stop_lines import RedLight
from saga_fg.tracking import Tracker, TrackerSettings
from saga_fg.tracking.map_nodes import Element, elements, in_known_names
from saga_fg.types.frame import Detection, Detections, Frame
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight, Wall


def tile(x: float, prefix: str = "") -> RoadMap:
    """A crossing at x with the names that every tile uses."""
    return RoadMap(
        lights=(TrafficLight(f"{prefix}light", (x + 10.0, 0.0)),),
        stop_lines=(StopLine(f"{prefix}line", (x, 2.0), (x, -2.0), f"{prefix}light"),),
        lanes=(Lane(f"{prefix}lane", ((x - 50.0, 0.0), (x + 10.0, 0.0))),),
        walls=(Wall(f"{prefix}wall", ((x, 8.0), (x + 5.0, 8.0))),),
    )


def known(*maps: RoadMap) -> dict[str, Element]:
    return {each.name: each for road_map in maps for each in elements(road_map)}


def test_other_elements_of_a_name_get_one_of_their_own():
    named = in_known_names(tile(500.0), known(tile(0.0)))
    assert [each.name for each in elements(named)] == ["light (2)", "line (2)", "lane (2)", "wall (2)"]
    assert named.stop_lines[0].light == "light (2)"
    third = in_known_names(tile(1000.0), known(tile(0.0), named))
    assert third.lights[0].name == "light (3)"
    assert in_known_names(tile(500.4), known(tile(0.0), named)).lights[0].name == "light (2)"  # corrected


def test_elements_of_one_place_are_one_whatever_their_names():
    first = tile(0.0, "west/")
    assert in_known_names(tile(0.0, "east/"), known(first)) == first
    twins = (TrafficLight("a", (0.0, 0.0)), TrafficLight("b", (0.0, 0.0)))  # two heads of one mast
    assert in_known_names(RoadMap(lights=twins), known(RoadMap(lights=twins))).lights == twins
    others = (TrafficLight("c", (0.0, 0.0)), TrafficLight("d", (0.0, 0.0)))
    assert in_known_names(RoadMap(lights=others), known(RoadMap(lights=twins))).lights == twins


def test_a_name_of_another_class_is_not_the_same():
    named = in_known_names(RoadMap(lanes=(Lane("light", ((9.0, 0.0), (11.0, 0.0))),)), known(tile(0.0)))
    assert named.lanes[0].name == "light (2)"


def test_lights_of_two_tiles_have_beliefs_of_their_own():
    """Red is reported at the second crossing, whose light has the name of the first one's."""
    settings = TrackerSettings(edges=(RedLight(),), road_map=tile(0.0))
    tracker = Tracker(settings, {"default": Sensor(colour_accuracy=0.9)})
    corrected = replace(tile(0.0), lights=(TrafficLight("light", (10.3, 0.0)),))
    for time, road_map in ((0.0, tile(300.0)), (0.1, corrected), (0.2, tile(0.0, "again/"))):
        red = Detections.of([Detection("traffic_light_red", (310.0, 0.0, 5.0))])
        tracker.step(Frame(time, "camera", red, road_map=road_map))
    nodes = tracker.map_nodes
    assert nodes.name == ("light", "line", "light (2)", "line (2)")
    assert nodes.light == ("light", "light", "light (2)", "light (2)")
    assert len(set(tracker.snapshot().traffic.lanes.points.id.tolist())) == 2  # that lead traffic, by the same names
    assert nodes.belief("light (2)")["red"] > 0.9 > 0.6 > nodes.belief("light")["red"]
