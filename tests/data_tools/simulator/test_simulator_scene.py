"""Simulated worlds and scenes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_tools.simulator import SimulatedTraffic, camera, lidar, simulate_scene, traffic
from data_tools.simulator.road import curved_road
from data_tools.simulator.scene_layout import sample_layout
from data_tools.simulator.sensed_world import recently_visible, without_short_runs
from data_tools.simulator.settings import SensorSettings, SimulatorSettings, TrafficSettings
from data_tools.simulator.traffic import SimulatedTrajectories, simulate_pedestrians
from data_tools.simulator.world import World, build_world, simulate_traffic
from saga_fg.errors import InputError
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.frame import Frame

SETTINGS = SimulatorSettings()
MERGES = SimulatorSettings(merge_probability=1.0)


@cache
def world(seed: int) -> World:
    return build_world(SETTINGS, seed)


def overlapping(boxes: Boxes) -> list[tuple[int, int]]:
    """Pairs of footprints that no axis separates."""
    place = boxes.position[:, :2]
    reach = np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2
    near = np.linalg.norm(place[:, None] - place[None], axis=-1) < reach[:, None] + reach[None]
    first, second = np.nonzero(np.triu(near, 1))
    corners = boxes.corners()
    bad = np.ones(len(first), dtype=np.bool_)
    for rows in (first, second):
        for turn in (0.0, np.pi / 2):
            axis = np.stack([np.cos(boxes.yaw[rows] + turn), np.sin(boxes.yaw[rows] + turn)], axis=-1)
            a, b = (np.einsum("pcx,px->pc", corners[pair], axis) for pair in (first, second))
            bad &= (a.max(axis=1) > b.min(axis=1)) & (b.max(axis=1) > a.min(axis=1))
    return list(zip(first[bad].tolist(), second[bad].tolist(), strict=True))


@pytest.mark.parametrize("seed", range(4))
def test_no_vehicle_touches_another_or_what_stands_beside_the_road(seed):
    here = world(seed) if seed < 2 else build_world(MERGES, seed)
    vehicles = here.objects.select(np.flatnonzero(here.objects.label != "pedestrian"))
    occluders = here.occluders
    for time in vehicles.time[:-1:10]:
        boxes, present = vehicles.at(float(time))
        moving = boxes.select(present)
        pairs = overlapping(Boxes.concatenate([moving, occluders, here.ego.at(float(time))[0]]))
        beside = range(len(moving), len(moving) + len(occluders))
        assert not [pair for pair in pairs if not (pair[0] in beside and pair[1] in beside)]


@pytest.mark.parametrize("seed", range(2))
def test_all_motion_is_smooth_and_velocities_are_its_derivative(seed):
    objects = world(seed).objects
    step = objects.time[1] - objects.time[0]
    difference = (objects.position[2:] - objects.position[:-2]) / (2 * step)
    there = (objects.present[2:] & objects.present[:-2])[..., None]
    assert np.abs((difference - objects.velocity[1:-1]) * there).max() < 0.3
    turn = np.abs(np.diff(objects.yaw, axis=0))
    assert turn.max() < 0.15  # rad in one step
    vehicles = objects.label != "pedestrian"
    speed = np.linalg.norm(objects.velocity, axis=-1)[:, vehicles]
    assert np.abs(np.diff(speed, axis=0)).max() / step < 9.5
    heading = np.stack([np.cos(objects.yaw), np.sin(objects.yaw)], axis=-1)[:, vehicles]
    aligned = (heading * objects.velocity[:, vehicles]).sum(axis=-1)
    assert aligned == pytest.approx(speed, abs=1e-6)  # vehicles move along their heading


def test_traffic_merges_out_of_the_lane_that_ends_and_changes_its_offset_gradually():
    merged = changes = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scenario = sample_layout(MERGES, rng)
        history = simulate_traffic(scenario, MERGES, rng)
        in_ending = history.lane == scenario.lanes.ending
        front = history.s + scenario.fleet.length / 2
        assert (front[in_ending] < scenario.lanes.end + 1.0).all()
        assert not (in_ending[1:] & ~in_ending[:-1]).any()  # nobody enters it
        merged += int((in_ending[0] & ~in_ending[-1]).sum())
        changes += int((np.diff(history.lane, axis=0) != 0).sum())
        sideways = np.abs(np.diff(history.offset, axis=0))
        assert (sideways <= 0.6 * np.diff(history.s, axis=0) + 1e-9).all()
    assert merged >= 4
    assert changes >= 8


def test_the_ego_vehicle_is_a_car_in_traffic_and_no_object():
    for seed in range(2):
        here = world(seed)
        assert here.ego.label.tolist() == ["car"]
        assert here.ego.present.all()
        assert here.ego.id[0] not in here.objects.id
        pose = here.ego_pose(here.start)
        assert pose[:2, 3] == pytest.approx(here.ego.position[0, 0])
        assert np.abs(pose[:2, 3]).max() > 100.0  # like on the map of a city
        distance = np.linalg.norm(here.objects.position[0] - pose[:2, 3], axis=1)
        assert (distance < 60).sum() >= 8


def people(monkeypatch: pytest.MonkeyPatch, groups: int, **constants: object) -> SimulatedTrajectories:
    for name, value in constants.items():
        monkeypatch.setattr(traffic, name, value)
    road = curved_road(1000.0, [], np.zeros(2), 0.0)
    time = 0.05 * np.arange(800)
    rng = np.random.default_rng(0)
    return simulate_pedestrians(road, [(-9.0, -7.0)], (300.0, 500.0), time, (groups, groups), rng)


def test_people_walk_on_the_pavement_in_groups_that_sway_and_pause(monkeypatch):
    walkers = people(monkeypatch, 20, PAUSE_INTERVAL=1e9, PAUSE_DURATION=1.0)
    assert walkers.position[..., 1].max() < -5.5
    assert walkers.position[..., 1].min() > -10.5
    speed = np.abs(walkers.velocity[100:, :, 0]).mean(axis=0)
    assert ((speed > 0.9) & (speed < 1.8)).all()
    walkers = people(
        monkeypatch, 60, GROUP_SIZE=(1, 1), JITTER=0.3, PAUSE_INTERVAL=1e9, PAUSE_DURATION=1.0, WALKING_SPEED=(1.0, 1.0)
    )
    sideways = walkers.position[..., 1]
    # against the mean over 40 s, which itself moves by the correlation time of 4 s: about 0.3 sqrt(1 - 4 / 40)
    assert (sideways - sideways.mean(axis=0)).std() == pytest.approx(0.285, abs=0.02)
    walkers = people(monkeypatch, 1, GROUP_SIZE=(4, 4), PAUSE_INTERVAL=5.0, PAUSE_DURATION=5.0, JITTER=0.0)
    speed = np.linalg.norm(walkers.velocity, axis=-1)
    assert np.ptp(speed, axis=1).max() < 1e-9
    assert speed.min() < 0.1
    assert speed.max() > 0.9
    assert np.ptp(walkers.position[..., 0] - walkers.position[:, :1, 0], axis=0).max() < 1e-6


def test_settings_no_world_can_have_are_refused(subtests):
    for make, text in [
        (lambda: SimulatorSettings(lanes=(3, 2)), "lanes: expected ascending numbers"),
        (lambda: SimulatorSettings(duration=0.0), "duration: expected a finite number > 0"),
        (lambda: SimulatorSettings(warm_up=-1.0), "warm_up: expected a finite number >= 0"),
        (lambda: SimulatorSettings(roadworks_probability=-0.1), "roadworks_probability: expected a number from 0 to 1"),
        (lambda: TrafficSettings(truck_share=0.7), "truck_share and bus_share: expected at most 0.75 together"),
        (lambda: SensorSettings(field_of_view=7.0), "field_of_view: expected a number above 0 to 6.28"),
        (lambda: SensorSettings(colour_accuracy=2.0), "colour_accuracy: expected a number from 0 to 1"),
    ]:
        with subtests.test(text=text), pytest.raises(InputError, match=text):
            make()


# Simulated scenes: the same for the same seed, consistent in themselves, with hidden objects worth tracking

SHORT = SimulatorSettings(duration=4.0, warm_up=5.0)


@cache
def scene(seed: int) -> Scene:
    return simulate_scene(SHORT, seed)


@cache
def long_scene(seed: int) -> Scene:
    return simulate_scene(replace(SimulatorSettings(), sensors={"lidar": lidar()}), seed)


def same_frames(first: list[Frame], second: list[Frame]) -> bool:
    return len(first) == len(second) and all(
        a.timestamp == b.timestamp
        and a.sensor == b.sensor
        and np.array_equal(a.detections.score, b.detections.score)
        and np.array_equal(a.detections.boxes.position, b.detections.boxes.position)
        and np.array_equal(a.detections.boxes.velocity, b.detections.boxes.velocity, equal_nan=True)
        for a, b in zip(first, second, strict=True)
    )


def test_the_seed_decides_everything():
    again = simulate_scene(SHORT, 3)
    first = scene(3)
    assert again.name == first.name == "simulated-3"
    assert np.array_equal(again.world_T_ego, first.world_T_ego)
    assert same_frames(list(again.frames), list(first.frames))
    assert first.ground_truth is not None
    for a, b in zip(again.ground_truth, first.ground_truth, strict=True):
        assert a.id.tolist() == b.id.tolist()
        assert np.array_equal(a.boxes.position, b.boxes.position)
        assert np.array_equal(a.visible, b.visible)
    assert not np.array_equal(scene(4).world_T_ego, first.world_T_ego)


def test_a_sensor_more_changes_nothing_for_the_others():
    alone = simulate_scene(replace(SHORT, sensors={"lidar": lidar()}), 3)
    assert alone.sensors == ("lidar",)
    assert same_frames(list(alone.frames), [frame for frame in scene(3).frames if frame.sensor == "lidar"])


def test_every_sensor_keeps_its_own_clock():
    here = scene(3)
    start = here.timestamps[0]
    for name, sensor, count in (("lidar", lidar(), 40), ("camera", camera(), 48)):
        times = np.array([frame.timestamp for frame in here.frames if frame.sensor == name]) - start
        assert times == pytest.approx(sensor.offset + np.arange(count) / sensor.rate, abs=2e-6)
    assert here.timestamps - start == pytest.approx(np.arange(40) / 10, abs=2e-6)
    slow = simulate_scene(replace(SHORT, keyframe_rate=2.0), 3)
    assert slow.timestamps - slow.timestamps[0] == pytest.approx(np.arange(8) / 2, abs=2e-6)
    assert slow.world_T_ego == pytest.approx(here.world_T_ego[::5], abs=1e-9)


def test_hidden_objects_were_in_view_not_long_ago():
    glimpses_count = replace(SimulatorSettings(), shortest_view=0.0, sensors={"lidar": lidar()})
    hidden = lasting_views = 0
    for seed in (1,):
        here = simulate_scene(glimpses_count, seed)
        last_seen: dict[str, float] = {}
        for k, (time, moment) in enumerate(zip(here.timestamps.tolist(), here.ground_truth, strict=True)):
            last_seen.update(dict.fromkeys(moment.id[moment.visible].tolist(), time))
            assert all(time - last_seen[name] <= 4.0 + 1e-5 for name in moment.id.tolist())
            hidden += int((~moment.visible).sum())
            distance = np.linalg.norm(moment.boxes.position[:, :2] - here.world_T_ego[k, :2, 3], axis=1)
            assert (distance <= 60.0).all()
        stricter = long_scene(seed).ground_truth
        assert stricter is not None
        for a, b in zip(here.ground_truth, stricter, strict=True):
            assert a.id.tolist() == b.id.tolist()
            assert not (b.visible & ~a.visible).any()
            lasting_views += int(b.visible.sum())
    assert hidden > 100
    assert lasting_views > 1500


def test_hidden_objects_are_not_detected():
    """At no time is a detection nearer to a hidden vehicle than to all visible ones and clutter could explain."""
    here = long_scene(1)
    assert here.ground_truth is not None
    hits = {True: [0, 0], False: [0, 0]}
    frames = {frame.timestamp: frame for frame in here.frames}
    for time, moment in zip(here.timestamps.tolist(), here.ground_truth, strict=True):
        found = frames[time].detections.boxes.position[:, :2]
        away = np.linalg.norm(moment.boxes.position[:, None, :2] - found[None], axis=-1).min(axis=1, initial=np.inf)
        for visible in (True, False):
            hits[visible][0] += int((away[moment.visible == visible] < 0.8).sum())
            hits[visible][1] += int((moment.visible == visible).sum())
    assert hits[True][0] / hits[True][1] > 0.8
    assert hits[False][0] / hits[False][1] < 0.25


def test_objects_are_remembered_for_a_while_and_glimpses_are_no_sightings():
    time = np.arange(7.0) / 2
    visible = np.array([[0, 1, 0, 0, 0, 0, 1], [1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0]], dtype=np.bool_).T
    expected = np.array([[0, 1, 1, 1, 0, 0, 1], [1, 1, 1, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0]], dtype=np.bool_).T
    assert np.array_equal(recently_visible(time, visible, 1.0), expected)
    assert np.array_equal(recently_visible(time, visible, 0.0), visible)
    assert recently_visible(time, visible, 9.0)[:, 0].tolist() == [False] + 6 * [True]
    visible = np.array([[1, 0, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 0, 0, 1, 0]], dtype=np.bool_).T
    two = np.array([[0, 0, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 0, 0, 0, 0]], dtype=np.bool_).T
    three = np.array([[0, 0, 0, 0, 0, 1, 1, 1], [0, 1, 1, 1, 0, 0, 0, 0]], dtype=np.bool_).T
    assert np.array_equal(without_short_runs(visible, 1), visible)
    assert np.array_equal(without_short_runs(visible, 2), two)
    assert np.array_equal(without_short_runs(visible, 3), three)
    assert not without_short_runs(visible, 9).any()


def test_the_dataset_makes_its_scenes_on_demand():
    tiny = replace(SHORT, duration=1.0, warm_up=1.0)
    dataset: Dataset = SimulatedTraffic(tiny, scenes=3, seed=1)
    assert dataset.scenes == ("scene-0001", "scene-0002", "scene-0003")
    first = dataset.scene("scene-0002")
    assert first.name == "scene-0002"
    larger = SimulatedTraffic(tiny, scenes=5, seed=1)
    assert np.array_equal(larger.scene("scene-0002").world_T_ego, first.world_T_ego)
    other = SimulatedTraffic(tiny, scenes=3, seed=2)
    assert not np.array_equal(other.scene("scene-0002").world_T_ego, first.world_T_ego)


def test_what_the_dataset_cannot_give_is_refused():
    with pytest.raises(InputError, match="scene 'scene-0009': expected one of scene-0001"):
        SimulatedTraffic(SHORT, scenes=2).scene("scene-0009")
    with pytest.raises(InputError, match="scenes: expected a number of at least 1, got 0"):
        SimulatedTraffic(SHORT, scenes=0)
    with pytest.raises(InputError, match="seed: expected a number of at least 0, got -1"):
        SimulatedTraffic(SHORT, seed=-1)
    with pytest.raises(InputError, match="seed: expected a number of at least 0"):
        simulate_scene(SHORT, -5)
