"""The simulated world: nobody overlaps, motion is smooth, and the moving parts do what they are there for."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from data_tools.simulator import road_users
from data_tools.simulator.road import curved_road
from data_tools.simulator.road_users import SimulatedTrajectories, simulate_pedestrians, static_objects
from data_tools.simulator.scene_layout import sample_layout
from data_tools.simulator.settings import SensorSettings, SimulatorSettings, TrafficSettings
from data_tools.simulator.world import World, build_world, simulate_traffic
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.boxes import Boxes

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


@pytest.mark.parametrize("seed", range(8))
def test_no_vehicle_touches_another_or_what_stands_beside_the_road(seed: int) -> None:
    here = world(seed) if seed < 3 else build_world(MERGES, seed)
    vehicles = here.objects.select(np.flatnonzero(here.objects.label != "pedestrian"))
    occluders = here.occluders
    for time in vehicles.time[:-1:10]:
        boxes, present = vehicles.at(float(time))
        moving = boxes.select(present)
        pairs = overlapping(Boxes.concatenate([moving, occluders, here.ego.at(float(time))[0]]))
        beside = range(len(moving), len(moving) + len(occluders))
        assert not [pair for pair in pairs if not (pair[0] in beside and pair[1] in beside)]


@pytest.mark.parametrize("seed", range(2))
def test_all_motion_is_smooth_and_velocities_are_its_derivative(seed: int) -> None:
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


def test_traffic_merges_out_of_the_lane_that_ends_and_changes_its_offset_gradually() -> None:
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


def test_every_scene_has_queues_that_stop_and_go() -> None:
    ranges = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scenario = sample_layout(SETTINGS, rng)
        history = simulate_traffic(scenario, SETTINGS, rng)
        near = (np.abs(history.s[0] - scenario.focus) < 120) & history.on_road[-1]
        speed = history.speed[:, near]
        ranges.append(float(np.median(speed.max(axis=0) - speed.min(axis=0))))
    assert np.median(ranges) > 3.0  # m/s within 20 s


def test_the_ego_vehicle_is_a_car_in_traffic_and_no_object() -> None:
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
        monkeypatch.setattr(road_users, name, value)
    road = curved_road(1000.0, [], np.zeros(2), 0.0)
    time = 0.05 * np.arange(800)
    rng = np.random.default_rng(0)
    return simulate_pedestrians(road, [(-9.0, -7.0)], (300.0, 500.0), time, (groups, groups), rng)


def test_people_stay_on_the_pavement_and_walk_at_their_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    walkers = people(monkeypatch, 20, PAUSE_INTERVAL=1e9, PAUSE_DURATION=1.0)
    assert walkers.position[..., 1].max() < -5.5
    assert walkers.position[..., 1].min() > -10.5
    speed = np.abs(walkers.velocity[100:, :, 0]).mean(axis=0)
    assert ((speed > 0.9) & (speed < 1.8)).all()


def test_people_sway_about_their_place_in_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    walkers = people(
        monkeypatch, 60, GROUP_SIZE=(1, 1), JITTER=0.3, PAUSE_INTERVAL=1e9, PAUSE_DURATION=1.0, WALKING_SPEED=(1.0, 1.0)
    )
    sideways = walkers.position[..., 1]
    # against the mean over 40 s, which itself moves by the correlation time of 4 s: about 0.3 sqrt(1 - 4 / 40)
    assert (sideways - sideways.mean(axis=0)).std() == pytest.approx(0.285, abs=0.02)


def test_a_group_pauses_together(monkeypatch: pytest.MonkeyPatch) -> None:
    walkers = people(monkeypatch, 1, GROUP_SIZE=(4, 4), PAUSE_INTERVAL=5.0, PAUSE_DURATION=5.0, JITTER=0.0)
    speed = np.linalg.norm(walkers.velocity, axis=-1)
    assert np.ptp(speed, axis=1).max() < 1e-9
    assert speed.min() < 0.1
    assert speed.max() > 0.9
    assert np.ptp(walkers.position[..., 0] - walkers.position[:, :1, 0], axis=0).max() < 1e-6


def straight(position: FloatArray, velocity: FloatArray, time: FloatArray) -> SimulatedTrajectories:
    shape = (len(time), 1)
    return SimulatedTrajectories(
        np.array(["a"]),
        np.array(["car"]),
        np.array([[4.0, 2.0, 1.5]]),
        time,
        position[:, None],
        velocity[:, None],
        np.zeros(shape),
        np.ones(shape, dtype=np.bool_),
    )


def test_between_samples_motion_is_a_cubic() -> None:
    time = np.array([1.0, 1.5, 2.0])

    def place(t: FloatArray) -> FloatArray:
        return np.stack([t**3 - t, 2 * t**2], axis=-1)

    path = straight(place(time), np.stack([3 * time**2 - 1, 4 * time], axis=-1), time)
    for t in (1.0, 1.2, 1.7, 2.0):
        boxes, present = path.at(t)
        assert boxes.position[0] == pytest.approx([*place(np.array(t)), 0.75])
        assert present.all()


def test_standing_objects_stand() -> None:
    boxes = Boxes.of(["car"], [[5.0, 6.0, 0.8]], [[4.0, 2.0, 1.6]], [0.3], [[0.0, 0.0]])
    found, present = static_objects(np.array(["x"]), boxes, np.array([0.0, 0.1, 0.2])).at(0.13)
    assert found.position == pytest.approx(boxes.position)
    assert found.velocity == pytest.approx(np.zeros((1, 2)))
    assert present.all()


def test_settings_no_world_can_have_are_refused(subtests: pytest.Subtests) -> None:
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
