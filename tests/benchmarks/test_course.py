"""The simulated course: a closed drive that comes back to three stretches, and repeats with its seed."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.course import SimulatedCourse, revisits
from benchmarks.scans import SENSOR_HEIGHT
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import yaw_of


@pytest.mark.parametrize("seed", range(3))
def test_three_stretches_are_passed_again_in_both_directions(seed: int) -> None:
    course = SimulatedCourse(seed, period=0.25)
    poses = course.world_T_ego
    runs = revisits(poses)
    assert len(runs) == 3
    assert 1500.0 < course.lap < 2300.0
    headings, places = yaw_of(poses[:, :3, :3]), poses[:, :2, 3]
    facing = []
    for first, last in runs:
        rows = np.arange(first, last)
        old = [np.argmin(np.linalg.norm(places[: row - 40] - places[row], axis=1)) for row in rows]
        facing.append(np.cos(headings[rows] - headings[old]))
    assert min(each.min() for each in facing[:2]) < -0.9
    assert np.median(facing[-1]) > 0.9  # the next lap
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert 0.9 < steps.min() < steps.max() < 2.01  # 4 to 8 m/s


def test_a_lap_closes_and_scans_repeat() -> None:
    course = SimulatedCourse(3, length=5000.0)
    assert len(course) > 6000
    one, other = (course.world_T_ego[np.searchsorted(course.distance, lap * course.lap + 30.0)] for lap in (0, 1))
    np.testing.assert_allclose(one, other, atol=1.0)
    np.testing.assert_array_equal(course[40].points, SimulatedCourse(3, length=200.0)[40].points)
    assert course[40].points[:, 2].min() == pytest.approx(-SENSOR_HEIGHT, abs=0.15)
    assert len(course[-1]) > 5000


def test_cars_leave_and_come() -> None:
    town = SimulatedCourse(0, length=10.0).town
    before, after = (len(town.at(time).boxes) for time in (0.0, 2.0))
    assert before < len(town.world.boxes)
    assert after < len(town.world.boxes)


def test_a_course_without_length_is_refused() -> None:
    with pytest.raises(InputError, match="length > 0 m"):
        SimulatedCourse(0, length=0.0)
