"""Recordings that hold the same traffic at a shift of time and place, and the middle of long ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.recordings.traffic import SHARED_MOMENTS, RecordedTraffic, Recordings, overlapping
from data_tools.simulator.road_users import SimulatedTrajectories
from saga_fg.numerics.arrays import FloatArray


def traffic(name: str, seed: int, moments: int = 30, vehicles: int = 4) -> RecordedTraffic:
    rng = np.random.default_rng(seed)
    velocity = 10 + rng.normal(0, 0.3, (moments, vehicles, 2)).cumsum(axis=0)
    names = np.array([str(n) for n in range(vehicles)])
    states = SimulatedTrajectories(
        names,
        np.full(vehicles, "car"),
        np.tile([4.5, 1.8, 1.5], (vehicles, 1)),
        0.1 * np.arange(moments),
        np.cumsum(0.1 * velocity, axis=0),
        velocity,
        np.arctan2(velocity[..., 1], velocity[..., 0]),
        np.ones((moments, vehicles), dtype=np.bool_),
    )
    return RecordedTraffic(name, states)


def with_velocity(recording: RecordedTraffic, velocity: FloatArray) -> RecordedTraffic:
    return replace(recording, vehicles=replace(recording.vehicles, velocity=velocity))


def test_windows_with_the_same_motion_are_one_group() -> None:
    whole = traffic("whole", seed=1)
    late = replace(whole.moments(slice(15, None)), name="late")
    late = replace(late, vehicles=replace(late.vehicles, position=late.vehicles.position + 100.0))
    early = replace(whole.moments(slice(0, SHARED_MOMENTS + 2)), name="early")
    found = overlapping([late, traffic("other", seed=2), whole, early])
    assert found == {"late": "late", "other": "other", "whole": "late", "early": "late"}


def test_one_vehicle_or_a_constant_speed_in_common_is_chance() -> None:
    one, other = traffic("one", seed=1), traffic("other", seed=2)
    velocity = other.vehicles.velocity.copy()
    velocity[:, 0] = one.vehicles.velocity[:, 0]
    assert overlapping([one, with_velocity(other, velocity)]) == {"one": "one", "other": "other"}
    steady = [with_velocity(each, np.ones_like(velocity)) for each in (one, other)]
    assert overlapping(steady) == {"one": "one", "other": "other"}
    assert overlapping([traffic("short", seed=3, moments=SHARED_MOMENTS - 1)]) == {"short": "short"}


def test_the_middle_of_a_recording() -> None:
    one = Recordings(("one",), lambda name: traffic(name, seed=1, moments=101))
    whole = one.read("one").vehicles.position
    for longest, moments, first in ((4.0, 41, 30), (np.inf, 101, 0)):
        found = one.middle(longest).read("one")
        assert len(found) == moments
        assert (found.vehicles.position == whole[first : first + moments]).all()
        assert found.vehicles.time[0] == 0.0
