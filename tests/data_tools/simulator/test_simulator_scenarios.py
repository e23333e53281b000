"""Simulated traffic. The Intelligent Driver Model: its equilibrium, and what a queue of such drivers does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.simulator import SimulatorSettings
from data_tools.simulator.road import (
    CAR,
    KINDS,
    Drivers,
    Fleet,
    Lanes,
    curved_road,
    equilibrium_gap,
    following_acceleration,
    free_acceleration,
)
from data_tools.simulator.scene_layout import ClosingLine, SceneLayout, SlowZone, sample_intervals
from data_tools.simulator.settings import ScenarioName, scenario_settings
from data_tools.simulator.traffic import Traffic, record_traffic
from data_tools.simulator.world import World, build_world, scene_from_world
from saga_fg.types.road_map import COLOUR_LABELS


def drivers(count: int, desired_speed: float = 14.0) -> Drivers:
    return Drivers(*(np.full(count, value) for value in (desired_speed, 1.2, 2.0, 1.5, 2.0)))


def fleet(count: int, leader_desires: float) -> Fleet:
    size = np.tile(KINDS[CAR].size, (count, 1))
    behind = drivers(count)
    desired_speed = np.where(np.arange(count) == 0, leader_desires, behind.desired_speed)
    return Fleet(np.full(count, CAR), size, replace(behind, desired_speed=desired_speed))


def queue(
    count: int,
    speed: float,
    stop_lines: tuple[ClosingLine, ...] = (),
    slow_zones: tuple[SlowZone, ...] = (),
    length: float = 2000.0,
    leader_desires: float = 14.0,
    noise: float = 0.0,
    reaction: float = 0.0,
) -> Traffic:
    """`count` cars one behind the other in equilibrium at `speed`, the first, row 0, at 1000 m."""
    road = curved_road(length, [], np.zeros(2), 0.0)
    lanes = Lanes(road, np.array([-1.75]), np.array([1]))
    cars = fleet(count, leader_desires)
    spacing = float(equilibrium_gap(speed, drivers(1))[0]) + KINDS[CAR].size[0]
    s = 1000.0 - spacing * np.arange(count)
    lane, trailer = np.zeros(count, dtype=np.int64), np.zeros(count)
    layout = SceneLayout(
        lanes, 0.0, None, cars, lane, s, np.full(count, speed), tuple(stop_lines), tuple(slow_zones), trailer
    )
    return Traffic(layout, np.random.default_rng(0), noise=noise, reaction=reaction)


@given(speed=st.floats(0.0, 13.5), lead=st.floats(-3.0, 3.0))
def test_acceleration_vanishes_at_the_equilibrium_gap_alone(speed, lead):
    driver, v = drivers(1), np.array([speed])
    gap = equilibrium_gap(speed, driver)
    assert gap == pytest.approx((2.0 + 1.2 * speed) / np.sqrt(1 - (speed / 14.0) ** 4))
    total = free_acceleration(v, driver) + following_acceleration(v, gap, v, driver)
    assert total[0] == pytest.approx(0.0, abs=1e-9)
    wider = free_acceleration(v, driver) + following_acceleration(v, gap + abs(lead) + 0.1, v, driver)
    assert wider[0] > 0


def test_followers_settle_at_the_equilibrium_gap_of_a_steady_leader():
    traffic = queue(6, 5.0, length=4000.0, leader_desires=8.0)
    for _ in range(4000):
        traffic.step()
    assert traffic.speed == pytest.approx(np.full(6, 8.0), abs=0.01)
    gap = traffic.s[:-1] - traffic.s[1:] - KINDS[CAR].size[0]
    assert gap == pytest.approx(equilibrium_gap(8.0, drivers(5)), rel=0.01)


def test_a_slow_down_runs_backwards_through_the_queue_as_a_wave():
    zone = SlowZone(np.array([0]), 1010.0, 1100.0, 2.0, np.array([[0.0, 8.0]]))
    history = record_traffic(queue(12, 10.0, slow_zones=(zone,)), 600)
    lowest = history.speed.argmin(axis=0)
    when, where = history.time[lowest], history.s[lowest, np.arange(12)]
    in_wave = slice(2, 10)  # the first two meet the slow zone itself
    assert (history.speed.min(axis=0)[in_wave] < 6.0).all()  # everybody brakes,
    assert (np.diff(when[in_wave]) > 0.2).all()  # one after the other,
    assert (np.diff(where[in_wave]) < 0).all()  # and further back
    wave_speed = np.polyfit(when[in_wave], where[in_wave], 1)[0]
    assert -9.0 < wave_speed < -2.0  # m/s; in real traffic about -4


def test_a_red_light_stops_the_queue_before_the_line_and_green_lets_it_go():
    line = ClosingLine(np.array([0]), 1100.0, np.array([[0.0, 40.0]]))
    history = record_traffic(queue(8, 10.0, stop_lines=(line,)), 1600)
    half = KINDS[CAR].size[0] / 2
    red = history.time < 40.0
    assert (history.s[red] + half < 1100.0).all()
    just_before = int(np.flatnonzero(red)[-1])
    assert history.speed[just_before].max() < 0.2
    assert (history.s[-1, :4] > 1100.0).all()


def test_who_cannot_stop_any_more_passes_the_light():
    line = ClosingLine(np.array([0]), 1012.0, np.array([[0.0, 40.0]]))
    history = record_traffic(queue(3, 12.0, stop_lines=(line,)), 600)
    assert history.s[-1, 0] > 1100.0  # was 10 m before the line
    assert history.s[-1, 1] < 1012.0
    assert np.diff(history.speed, axis=0).min() / 0.05 > -6.0


@pytest.mark.parametrize("seed", range(3))
def test_reaction_time_and_noise_cause_no_collision(seed):
    rng = np.random.default_rng(seed)
    active = sample_intervals((4.0, 8.0), (4.0, 8.0), 60.0, rng)
    zone = SlowZone(np.array([0]), 900.0, 1500.0, 1.0, active)
    history = record_traffic(queue(15, 11.0, slow_zones=(zone,), noise=0.4, reaction=0.4), 1200)
    gap = history.s[:, :-1] - history.s[:, 1:] - KINDS[CAR].size[0]
    assert gap.min() > 0.3
    assert history.speed.min() >= 0.0


# The simulator's scenarios: lights, cones and trailers

SHORT = 6.0  # s


def settings(name: ScenarioName) -> SimulatorSettings:
    return replace(scenario_settings(name), duration=SHORT)


@cache
def world(name: ScenarioName) -> World:
    return build_world(settings(name), 3)


def test_lights_have_amber_between_and_by_default_there_is_nothing_new():
    """Scenes of the plain simulator are what they were: no maps, no cones, no lights among the detections."""
    plain = build_world(replace(SimulatorSettings(), duration=2.0), 3)
    assert plain.road_map is None
    assert set(plain.objects.label.tolist()) <= {"car", "truck", "bus", "pedestrian"}
    assert scenario_settings("traffic") == SimulatorSettings()
    signal = world("red-light").signals[0]
    start, end = signal.red[len(signal.red) // 2]
    times = (start - 0.1, start + 0.1, start + signal.amber_duration + 0.1, end + 0.1)
    assert [signal.colour(time) for time in times] == ["green", "amber", "red", "green"]


def test_colours_are_reported_as_often_rightly_as_the_camera_can():
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


def test_a_map_tells_which_lanes_a_light_stops():
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


def test_takers_let_nobody_in_and_the_mast_stands():
    """Without takers some brake for those who merge that do not brake for a taker."""
    merge = settings("merge")
    polite = replace(merge, traffic=replace(merge.traffic, takers=0.0))
    one, other = (build_world(each, 3) for each in (merge, polite))
    lanes = one.layout.lanes
    near = np.isin(other.history.lane, [lanes.ending, lanes.adjacent]) & (other.history.s < lanes.end)
    before = near & (other.history.s > lanes.opening)
    assert one.history.speed[before].max() > other.history.speed[before].max() + 1.0
    assert np.array_equal(one.ego_pose(0.0), one.ego_pose(5.0))
    assert one.ego.id[0] in one.objects.id, "no vehicle carries the sensors"


def test_cones_push_the_traffic_of_their_lane_into_the_one_beside():
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


def test_trailers_hang_on_their_trucks():
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
