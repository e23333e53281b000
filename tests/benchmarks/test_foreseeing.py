"""The floor of predictions: who knows how drivers drive errs by what nobody can know."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.foreseeing import Foreseeing
from benchmarks.foresight import foreseen
from benchmarks.predictions import prediction_errors
from data_tools.simulator.scenarios import scenario_settings
from data_tools.simulator.scene import scene_from_world
from data_tools.simulator.world import build_world
from pipelines.config import load_config

SETTINGS = replace(scenario_settings("red-light"), duration=5.0, warm_up=8.0)
EVEN = replace(SETTINGS.drivers, spread=0.0, acceleration_noise=0.0, desired_speed=(13.0, 13.0))


@pytest.fixture(scope="module")
def even():
    """A world of drivers who are all alike and never surprising."""
    settings = replace(SETTINGS, drivers=EVEN)
    return build_world(settings, 500), settings


def test_drivers_who_are_all_alike_are_foreseen(even):
    world, settings = even
    off = foreseen(world, settings, world.start + 1.0, 2.0, {})
    k, later = (round((1.0 + ahead) / settings.step) for ahead in (0.0, 2.0))
    straight = world.history.s[later] - world.history.s[k] - 2.0 * world.history.speed[k]
    assert np.mean(np.abs(off)) < 0.2 * np.mean(np.abs(straight))  # some change lanes, or decide to run the light
    assert np.median(np.abs(off)) < 0.05 * np.median(np.abs(straight))


def test_errors_of_estimates_are_carried_on(even):
    world, settings = even
    exact = foreseen(world, settings, world.start + 1.0, 2.0, {})
    number = int(np.argmax(world.history.s[0] * (world.layout.lanes.direction[world.history.lane[0]] > 0)))
    speed = float(world.history.speed[round(1.0 / settings.step), number])
    assert foreseen(world, settings, world.start + 1.0, 2.0, {number: (0.5, speed)})[number] > exact[number] + 0.2


def test_the_floor_starts_from_the_tracks_of_the_tracker():
    world = build_world(SETTINGS, 500)
    scene = scene_from_world(world, SETTINGS, 500)
    scene = replace(scene, frames=scene.frames[::3])
    offset = float(scene.timestamps[0]) - world.start
    config = load_config("heterogeneous")
    everybody = {25: scene.ground_truth[25].id[np.char.startswith(scene.ground_truth[25].id, "vehicle-")]}
    errors = [
        prediction_errors(scene, tracker, horizon, [25], everybody.__getitem__)
        for tracker in (config.new_tracker("saga"), Foreseeing(config.new_tracker("saga"), world, SETTINGS, offset))
        for horizon in (0.0, 2.0)
    ]
    now, full, now_again, floor = errors
    assert now == now_again
    common = sorted(full.keys() & floor.keys())
    assert len(common) > 5
    assert np.mean([floor[name] for name in common]) < np.mean([full[name] for name in common])
