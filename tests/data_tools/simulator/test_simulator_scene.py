"""Simulated scenes: the same for the same seed, consistent in themselves, with hidden objects worth tracking."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_tools.simulator import SimulatedTraffic, SimulatorSettings, camera, lidar, simulate_scene
from data_tools.simulator.sensed_world import recently_visible, without_short_runs
from data_tools.simulator.world import build_world
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.frame import Frame

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


def test_the_seed_decides_everything() -> None:
    again = simulate_scene(SHORT, 3)
    first = scene(3)
    assert again.name == first.name == "simulated-3"
    assert np.array_equal(again.world_T_ego, first.world_T_ego)
    assert same_frames(list(again.frames), list(first.frames))
    assert again.ground_truth is not None
    assert first.ground_truth is not None
    for a, b in zip(again.ground_truth, first.ground_truth, strict=True):
        assert a.id.tolist() == b.id.tolist()
        assert np.array_equal(a.boxes.position, b.boxes.position)
        assert np.array_equal(a.visible, b.visible)
    assert not np.array_equal(scene(4).world_T_ego, first.world_T_ego)


def test_a_sensor_more_changes_nothing_for_the_others() -> None:
    alone = simulate_scene(replace(SHORT, sensors={"lidar": lidar()}), 3)
    assert alone.sensors == ("lidar",)
    assert same_frames(list(alone.frames), [frame for frame in scene(3).frames if frame.sensor == "lidar"])


def test_every_sensor_keeps_its_own_clock() -> None:
    here = scene(3)
    start = here.timestamps[0]
    for name, sensor, count in (("lidar", lidar(), 40), ("camera", camera(), 48)):
        times = np.array([frame.timestamp for frame in here.frames if frame.sensor == name]) - start
        assert times == pytest.approx(sensor.offset + np.arange(count) / sensor.rate, abs=2e-6)
    assert here.timestamps - start == pytest.approx(np.arange(40) / 10, abs=2e-6)
    slow = simulate_scene(replace(SHORT, keyframe_rate=2.0), 3)
    assert slow.timestamps - slow.timestamps[0] == pytest.approx(np.arange(8) / 2, abs=2e-6)
    assert slow.world_T_ego == pytest.approx(here.world_T_ego[::5], abs=1e-9)


def test_detections_lie_near_true_objects_or_are_few() -> None:
    here = scene(3)
    world = build_world(SHORT, 3)
    strays = 0
    frames = [frame for frame in here.frames if frame.sensor == "lidar"]
    for frame in frames:
        truth, _ = world.objects.at(frame.timestamp - here.timestamps[0] + world.start)
        place = frame.detections.boxes.position[:, :2]
        away = np.linalg.norm(place[:, None] - truth.position[None, :, :2], axis=-1).min(axis=1)
        strays += int((away > 1.5).sum())
    assert 0.5 < strays / len(frames) < 4.0  # two false ones a frame


def test_ground_truth_velocity_is_the_derivative_of_position() -> None:
    truth = scene(3).ground_truth
    assert truth is not None
    for a, b, c in zip(truth[:-2], truth[1:-1], truth[2:], strict=True):
        _, i, k = np.intersect1d(a.id, c.id, return_indices=True)
        both, j, rows = np.intersect1d(b.id, a.id[i], return_indices=True)
        difference = (c.boxes.position[k[rows]] - a.boxes.position[i[rows]])[:, :2] / 0.2
        assert len(both) > 0
        assert np.abs(difference - b.boxes.velocity[j]).max() < 0.8  # accelerations of up to 8 m/s^2


def test_hidden_objects_were_in_view_not_long_ago() -> None:
    glimpses_count = replace(SimulatorSettings(), shortest_view=0.0, sensors={"lidar": lidar()})
    hidden = lasting_views = 0
    for seed in (1,):
        here = simulate_scene(glimpses_count, seed)
        last_seen: dict[str, float] = {}
        assert here.ground_truth is not None
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


def test_hidden_objects_are_not_detected() -> None:
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


def test_objects_are_remembered_for_a_while() -> None:
    time = np.arange(7.0) / 2
    visible = np.array([[0, 1, 0, 0, 0, 0, 1], [1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0]], dtype=np.bool_).T
    expected = np.array([[0, 1, 1, 1, 0, 0, 1], [1, 1, 1, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0]], dtype=np.bool_).T
    assert np.array_equal(recently_visible(time, visible, 1.0), expected)
    assert np.array_equal(recently_visible(time, visible, 0.0), visible)
    assert recently_visible(time, visible, 9.0)[:, 0].tolist() == [False] + 6 * [True]


def test_glimpses_are_no_sightings() -> None:
    visible = np.array([[1, 0, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 0, 0, 1, 0]], dtype=np.bool_).T
    two = np.array([[0, 0, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 0, 0, 0, 0]], dtype=np.bool_).T
    three = np.array([[0, 0, 0, 0, 0, 1, 1, 1], [0, 1, 1, 1, 0, 0, 0, 0]], dtype=np.bool_).T
    assert np.array_equal(without_short_runs(visible, 1), visible)
    assert np.array_equal(without_short_runs(visible, 2), two)
    assert np.array_equal(without_short_runs(visible, 3), three)
    assert not without_short_runs(visible, 9).any()


def test_the_dataset_makes_its_scenes_on_demand() -> None:
    dataset: Dataset = SimulatedTraffic(SHORT, scenes=3, seed=1)
    assert dataset.scenes == ("scene-0001", "scene-0002", "scene-0003")
    first = dataset.scene("scene-0002")
    assert first.name == "scene-0002"
    larger = SimulatedTraffic(SHORT, scenes=5, seed=1)
    assert np.array_equal(larger.scene("scene-0002").world_T_ego, first.world_T_ego)
    other = SimulatedTraffic(SHORT, scenes=3, seed=2)
    assert not np.array_equal(other.scene("scene-0002").world_T_ego, first.world_T_ego)


def test_what_the_dataset_cannot_give_is_refused() -> None:
    with pytest.raises(InputError, match="scene 'scene-0009': expected one of scene-0001"):
        SimulatedTraffic(SHORT, scenes=2).scene("scene-0009")
    with pytest.raises(InputError, match="scenes: expected a number of at least 1, got 0"):
        SimulatedTraffic(SHORT, scenes=0)
    with pytest.raises(InputError, match="seed: expected a number of at least 0, got -1"):
        SimulatedTraffic(SHORT, seed=-1)
    with pytest.raises(InputError, match="seed: expected a number of at least 0"):
        simulate_scene(SHORT, -5)
