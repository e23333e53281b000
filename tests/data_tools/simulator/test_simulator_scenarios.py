"""The simulator's scenarios: lights, cones, trailers and cyclists."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_tools.simulator import SimulatorSettings
from data_tools.simulator.settings import (
    ScenarioName,
    scenario_settings,
)
from data_tools.simulator.world import World, build_world, scene_from_world
from saga_fg.types.road_map import COLOUR_LABELS

SHORT = 6.0  # s


def settings(name: ScenarioName) -> SimulatorSettings:
    return replace(scenario_settings(name), duration=SHORT)


@cache
def world(name: ScenarioName) -> World:
    return build_world(settings(name), 3)


def test_by_default_there_is_nothing_new() -> None:
    """Scenes of the plain simulator are what they were: no maps, no cones, no lights among the detections."""
    plain = build_world(replace(SimulatorSettings(), duration=2.0), 3)
    assert plain.road_map is None
    assert set(plain.objects.label.tolist()) <= {"car", "truck", "bus", "pedestrian"}
    assert scenario_settings("traffic") == SimulatorSettings()


def test_colours_are_reported_as_often_rightly_as_the_camera_can() -> None:
    here = world("red-light")
    scene = scene_from_world(here, settings("red-light"), 3)
    offset = scene.timestamps[0] - here.start
    right = total = 0
    for frame in scene.frames:
        assert frame.road_map is here.road_map
        labels = frame.detections.boxes.label
        for row in np.flatnonzero(np.isin(labels, COLOUR_LABELS)).tolist():
            assert frame.sensor == "camera"
            distance = [np.hypot(*(s.position - frame.detections.boxes.position[row, :2])) for s in here.signals]
            nearest = here.signals[int(np.argmin(distance))]
            right += labels[row] == f"traffic_light_{nearest.colour(frame.timestamp - offset)}"
            total += 1
    assert total > 30
    assert 0.75 < right / total < 0.99


def test_a_map_tells_which_lanes_a_light_stops() -> None:
    """Every stop line lies across the lanes it closes, and its travellers go the way it looks."""
    here = world("red-light")
    assert here.road_map is not None
    lanes = here.layout.lanes
    mapped = {line.name: line for line in here.road_map.stop_lines}
    lines = [(n, line) for n, line in enumerate(here.layout.stop_lines) if len(line.lanes)]
    assert len(mapped) == len(lines)
    for number, line in lines:
        found = mapped[f"line-{number}"]
        for lane in line.lanes:
            one = np.array([lane])
            offset, slope = lanes.lateral(one, np.array([line.s]))
            place, heading = lanes.pose(one, np.array([line.s]), offset, slope)
            across = found.ends[0] - found.ends[1]
            share = (place[0] - found.ends[1]) @ across / (across @ across)
            assert 0 < share < 1
            assert np.cos(heading[0] - found.heading) > 0.99


def test_amber_comes_before_red_and_green_after() -> None:
    signal = world("red-light").signals[0]
    start, end = signal.red[len(signal.red) // 2]
    times = (start - 0.1, start + 0.1, start + signal.amber_duration + 0.1, end + 0.1)
    assert [signal.colour(time) for time in times] == ["green", "amber", "red", "green"]


def test_cones_push_the_traffic_of_their_lane_into_the_one_beside() -> None:
    here = world("road-works")
    lanes, history = here.layout.lanes, here.history
    pushed = np.flatnonzero(history.lane[0] == lanes.ending)
    for row in pushed.tolist():
        past = history.s[:, row] >= lanes.end
        assert (history.lane[past, row] != lanes.ending).all()
        assert np.allclose(history.offset[past, row][:1], lanes.offset[lanes.adjacent])
        assert np.abs(np.diff(history.offset[:, row])).max(initial=0) < 0.25  # m in a twentieth of a second
    cones = here.objects.select(np.flatnonzero(here.objects.label == "traffic_cone"))
    assert len(cones) > 8
    assert (cones.position == cones.position[0]).all()


def test_nobody_drives_over_a_cone() -> None:
    here = world("road-works")
    for time in here.objects.time[:-1:20]:
        boxes, present = here.objects.at(float(time))
        cones = boxes.position[boxes.label == "traffic_cone", :2]
        for row in np.flatnonzero(present & np.isin(boxes.label, ("car", "truck", "bus"))).tolist():
            turn = boxes.yaw[row]
            R = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
            along, across = np.abs((cones - boxes.position[row, :2]) @ R.T).T
            assert not ((along < boxes.size[row, 0] / 2) & (across < boxes.size[row, 1] / 2)).any()


def test_trailers_hang_on_their_trucks() -> None:
    here = world("towing")
    ids = here.objects.id.tolist()
    trailers = [k for k, name in enumerate(ids) if name.startswith("trailer")]
    assert len(trailers) > 5
    for row in trailers:
        truck = ids.index(ids[row].replace("trailer", "vehicle"))
        apart = np.linalg.norm(here.objects.position[:, row] - here.objects.position[:, truck], axis=1)
        half = (here.objects.size[row, 0] + here.objects.size[truck, 0]) / 2
        assert here.objects.label[truck] == "truck"
        assert (np.abs(apart - half - 0.9) < 0.5).all()
        assert np.allclose(
            np.linalg.norm(here.objects.velocity[:, row], axis=1),
            np.linalg.norm(here.objects.velocity[:, truck], axis=1),
        )


def test_riders_sit_on_their_bicycles() -> None:
    here = world("cycling")
    bicycles = here.objects.select(np.flatnonzero(here.objects.label == "bicycle"))
    riders = here.objects.select(np.flatnonzero(np.char.startswith(here.objects.id, "rider")))
    assert len(bicycles) == len(riders) >= 10
    assert np.linalg.norm(bicycles.position - riders.position, axis=-1).max() < 0.1
    moved = np.diff(bicycles.position, axis=0) / 0.05
    assert np.abs(moved - bicycles.velocity[:-1]).max() < 0.6


@pytest.mark.parametrize("name", ["red-light", "two-sensors"])
def test_a_scene_is_the_same_for_the_same_seed(name: ScenarioName) -> None:
    short = replace(scenario_settings(name), duration=0.5, warm_up=2.0)
    one, other = (scene_from_world(build_world(short, 5), short, 5) for _ in range(2))
    for a, b in zip(one.frames, other.frames, strict=True):
        assert np.array_equal(a.detections.boxes.position, b.detections.boxes.position)
        assert a.road_map == b.road_map
