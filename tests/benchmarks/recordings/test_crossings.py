"""Simulated crossings without signals."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.recording_sets import recording_set
from benchmarks.recordings.crossings import LENGTH, LINE, RULES, simulated_crossings


@pytest.mark.parametrize("row", range(len(RULES)))
def test_nobody_collides_and_somebody_waits(row: int) -> None:
    recordings = simulated_crossings(len(RULES))
    vehicles = recordings.read(recordings.names[row]).vehicles
    speed = np.hypot(*np.moveaxis(vehicles.velocity, -1, 0))
    pairs = vehicles.present[:, :, None] & vehicles.present[:, None] & ~np.eye(len(vehicles.id), dtype=bool)
    apart = np.linalg.norm(vehicles.position[:, :, None] - vehicles.position[:, None], axis=-1)
    assert apart[pairs].min() > 0.7 * LENGTH
    stands = (speed < 0.3) & vehicles.present
    assert 0.02 < stands.sum() / vehicles.present.sum() < 0.7
    major = np.abs(np.sin(vehicles.yaw)) < 0.1
    near = np.abs(vehicles.position).max(axis=-1) < 120 - LINE + 3
    assert (stands & near & major).any() == (RULES[row] == "all-way")


def test_a_name_and_a_seed_make_one_recording() -> None:
    one, same, other = (simulated_crossings(2, seed).read("priority-0").vehicles for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.position, same.position)
    assert one.position.shape != other.position.shape or (one.position != other.position).any()


def test_the_middle_of_a_crossing_is_what_is_asked_for() -> None:
    whole, middle = (recording_set("crossings", None, 1, longest=longest) for longest in (np.inf, 5.0))
    (name,) = whole.dataset.scenes
    assert middle.scene(name).timestamps[-1] == pytest.approx(5.0)
    assert whole.scene(name).timestamps[-1] == pytest.approx(40.0)
