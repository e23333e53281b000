"""Motions that surfaces leave open: a plane, a tunnel, a street; and what registration makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scans import StaticWorld, drive, scans, street
from data_tools.lidar import Registration, RegistrationError, SurfelMap, observability, register, voxel_downsample
from data_tools.lidar.registration import Undetermined
from saga_fg.numerics.geometry import yaw_transform
from tests.data_tools.featureless import open_field, tunnel


def registered(world: StaticWorld, start: np.ndarray, undetermined: Undetermined = "hold") -> Registration:
    first, second = scans(world, drive(2, speed=4.0, turn_rate=0.0), skewed=False)
    surfels = SurfelMap(1.0, reach=100.0)
    surfels.add(first.points[voxel_downsample(first.points, 0.25)], np.zeros(3))
    points = second.points[voxel_downsample(second.points, 1.5)]
    return register(points, surfels, start, 3.0, 0.1, undetermined)


def test_a_street_determines_the_whole_motion() -> None:
    found = registered(street(0), np.eye(4))
    assert found.observed.names() == ()
    np.testing.assert_array_equal(found.covariance, registered(street(0), np.eye(4), undetermined="refuse").covariance)


def test_along_a_tunnel_the_prediction_stays() -> None:
    start = yaw_transform(0.3, 0.1, 0.05, 0.01)
    found = registered(tunnel(), start)
    assert "along the road" in found.observed.names()
    assert "across the road" not in found.observed.names()
    assert found.map_T_scan[0, 3] == pytest.approx(0.3, abs=0.03)  # as predicted; 0.4 is the truth
    assert abs(found.map_T_scan[1, 3]) < 0.03
    assert abs(found.map_T_scan[2, 3]) < 0.03
    lost = found.observed.lost * found.observed.scale  # nothing is claimed there
    np.testing.assert_allclose(lost @ found.covariance @ lost.T, 0.0, atol=1e-9)
    assert found.observed.names(np.array([0.0, 1.0, 0.0]))[-1] == "across the road"  # of a way to the left


def test_in_an_open_field_height_and_tilt_are_left() -> None:
    start = yaw_transform(0.4, 0.0, 0.1, 0.02)
    found = registered(open_field(), start)
    assert found.observed.names() == ("heading", "along the road", "across the road")
    np.testing.assert_allclose(found.map_T_scan[:3, 3], [0.4, 0.0, 0.0], atol=0.01)


def test_a_whole_registration_refuses(subtests: pytest.Subtests) -> None:
    for world in [tunnel(), open_field()]:
        with (
            subtests.test(world=world),
            pytest.raises(RegistrationError, match="leave a direction of motion unconstrained"),
        ):
            registered(world, np.eye(4), undetermined="refuse")


def test_rough_surfaces_see_less() -> None:
    """Grass shows normals in all directions, but none that can be trusted."""
    rng = np.random.default_rng(0)
    needed = []
    for roughness in (0.01, 0.06):
        surfels = SurfelMap(1.0, reach=100.0)
        ground = rng.uniform([-20, -20, 0.5], [20, 20, 0.5], (20000, 3))
        ground[:, 2] += rng.normal(0, roughness, len(ground))
        surfels.add(ground, np.zeros(3))
        rows, paired = surfels.nearest(ground[::20], 1.0)
        found = observability(ground[::20][rows], paired, paired.normal, np.ones(len(rows)))
        assert set(found.names()) >= {"heading", "along the road", "across the road"}
        needed.append(found.needed)
    assert needed[0] < needed[1]
