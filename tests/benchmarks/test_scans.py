"""The simulated LiDAR: ranges as geometry says, noise as asked for, skew that de-skew takes away."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scans import ScannerSettings, StaticWorld, ranges, simulate_scan
from data_tools.lidar import deskewed
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import transform_points, yaw_transform
from saga_fg.types.boxes import Boxes

NOTHING = Boxes.empty()
WORLD = StaticWorld(
    Boxes.of(["car"], [(10.0, 0.0, 1.0)], [(4.0, 2.0, 2.0)], [np.pi / 2], [(0.0, 0.0)]),
    np.array([[0.0, 5.0, 0.5, 3.0]]),
)


def test_ranges_are_those_of_geometry() -> None:
    for direction, expected in [
        ((1.0, 0.0, 0.0), 9.0),  # the car, turned: its side is 1 m before its centre
        ((0.0, 1.0, 0.0), 4.5),  # the pole
        ((0.0, 0.0, -1.0), 1.5),  # the ground
        ((0.0, 0.6, 0.8), np.inf),  # over the pole
        ((-1.0, 0.0, 0.0), np.inf),
    ]:
        ((distance,),) = ranges(WORLD, np.array([[0.0, 0.0, 1.5]]), np.array([[direction]]))
        assert distance == pytest.approx(expected)


def test_scans_repeat_with_their_seed_and_have_the_noise_asked_for() -> None:
    settings = ScannerSettings(noise=0.05)
    pose = yaw_transform(z=2.0)
    world = StaticWorld(NOTHING, np.empty((0, 4)))
    a, b, c = (simulate_scan(world, pose, np.random.default_rng(seed), settings) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.points, b.points)
    assert not np.array_equal(a.points, c.points)
    distance = np.linalg.norm(a.points, axis=1)
    elevation = np.arcsin(a.points[:, 2] / distance)
    assert np.std(distance - 2.0 / np.sin(-elevation)) == pytest.approx(0.05, rel=0.05)


def test_deskewed_points_lie_where_things_are() -> None:
    velocity = np.array([0.0, 0.0, 0.5, 10.0, 0.0, 0.0])
    pose = yaw_transform(1.0, -1.0, 1.5, 0.2)
    scan = simulate_scan(WORLD, pose, np.random.default_rng(0), ScannerSettings(noise=1e-4), velocity)
    points = transform_points(pose, deskewed(scan, velocity).points)
    at_pole = points[(np.hypot(points[:, 0], points[:, 1] - 5) < 1) & (points[:, 2] > 0.2)]
    assert len(at_pole) > 50
    np.testing.assert_allclose(np.hypot(at_pole[:, 0], at_pole[:, 1] - 5), 0.5, atol=2e-3)


def test_poles_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match=r"poles: expected shape \(any, 4\)"):
        StaticWorld(NOTHING, np.zeros((1, 3)))
