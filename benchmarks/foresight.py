"""What the drivers of a scene would do next if nothing surprised them: a floor for predictions of vehicles.

The simulator's own traffic from a moment on, without the random part of the accelerations. Whoever asks says where
vehicles are and how fast; all others, in view or not, are where they are. The drivers are average ones, who know each
other and when the lights change, and the path of each is the true one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from data_tools.simulator.fleet import KINDS, Fleet
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.traffic import Traffic
from data_tools.simulator.world import World
from saga_fg.numerics.arrays import FloatArray


def foreseen(
    world: World, settings: SimulatorSettings, time: float, horizon: float, believed: Mapping[int, tuple[float, float]]
) -> FloatArray:
    """How far ahead along their lanes of the truth `horizon` s after `time` vehicles (N,) are foreseen, m.

    believed  by number of a vehicle: how far ahead of the truth it is thought to be at `time`, m, and its speed, m/s
    """
    history, scenario = world.history, world.layout
    k, later = (int(np.argmin(np.abs(history.time - moment))) for moment in (time, time + horizon))
    metric = scenario.lanes.metric(history.lane[k], history.s[k], history.offset[k], history.slope[k])
    s, speed = history.s[k].copy(), history.speed[k].copy()
    for number, (ahead, now) in believed.items():
        s[number] += ahead / metric[number]
        speed[number] = max(now, 0.0)
    traffic = Traffic(
        scenario.lanes,
        _average(scenario.fleet, settings, speed),
        history.lane[k],
        s,
        speed,
        replace(settings.drivers, acceleration_noise=0.0),
        np.random.default_rng(0),
        scenario.stop_lines,
        scenario.slow_zones,
        settings.step,
        float(history.time[k]),
    )
    traffic.settle()
    for _ in range(later - k):
        traffic.step()
    return np.asarray((traffic.s - history.s[later]) * metric)


def _average(fleet: Fleet, settings: SimulatorSettings, speed: FloatArray) -> Fleet:
    """The fleet with the average driver of each kind of vehicle, who wants to be as fast as he is at least."""
    drivers = settings.drivers
    wanted, headway, acceleration = (
        np.array([getattr(kind, name) for kind in KINDS])[fleet.kind] for name in ("speed", "headway", "acceleration")
    )
    average = replace(
        fleet.drivers,
        desired_speed=np.maximum(np.mean(drivers.desired_speed) * wanted, speed),
        time_headway=drivers.time_headway * headway,
        minimum_gap=np.full(len(fleet), drivers.minimum_gap),
        max_acceleration=drivers.max_acceleration * acceleration,
        comfortable_deceleration=np.full(len(fleet), drivers.comfortable_deceleration),
    )
    return replace(fleet, drivers=average)
