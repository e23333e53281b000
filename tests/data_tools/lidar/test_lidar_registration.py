"""Thinning, de-skew, surfels and registration: laws of each, and poses recovered on simulated scans."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.scans import StaticWorld, drive, scans, street
from data_tools.lidar import (
    RegistrationError,
    Scan,
    SurfelMap,
    azimuth_times,
    constant_velocity,
    deskewed,
    register,
    scan_to_map_residual,
    surfels_of,
    voxel_downsample,
    voxel_keys,
)
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_transform
from saga_fg.types.boxes import Boxes


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 5.0))
def test_downsampling_leaves_one_point_in_each_voxel(seed: int, size: float) -> None:
    points = np.random.default_rng(seed).normal(0, 10, (200, 3))
    rows = voxel_downsample(points, size)
    keys = voxel_keys(points, size)
    assert len(set(keys[rows].tolist())) == len(rows)
    assert set(keys[rows].tolist()) == set(keys.tolist())
    assert (np.diff(rows) > 0).all()


def test_voxels_off_the_grid_and_without_size_are_refused() -> None:
    with pytest.raises(InputError, match="expected coordinates within"):
        voxel_keys(np.array([[1e6, 0.0, 0.0]]), 0.1)
    with pytest.raises(InputError, match="voxel size > 0"):
        voxel_keys(np.zeros((1, 3)), 0.0)


@given(st.integers(0, 2**32 - 1))
def test_deskew_is_the_exponential_of_the_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, time, xi = rng.normal(0, 20, (5, 3)), rng.uniform(-0.05, 0.05, 5), rng.normal(0, 3, 6)
    moved = deskewed(Scan(points, np.zeros(5), time), xi)
    for point, t, got in zip(points, time, moved.points, strict=True):
        np.testing.assert_allclose(got, gtsam.Pose3.Expmap(t * xi).transformFrom(point), atol=1e-9)
    assert moved.time is not None
    assert not moved.time.any()


def test_deskew_needs_times_and_azimuths_give_them() -> None:
    with pytest.raises(InputError, match="the scan has none"):
        deskewed(Scan.of(np.zeros((1, 3))), np.zeros(6))
    ahead_left_right = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(azimuth_times(ahead_left_right, 0.1), [0.0, -0.025, 0.025])


def test_deskewed_scans_show_straight_walls() -> None:
    wall = StaticWorld(
        Boxes.of(["wall"], [(0.0, 10.0, 5.0)], [(60.0, 1.0, 10.0)], [0.0], [(0.0, 0.0)]), np.empty((0, 4))
    )
    poses = np.array([yaw_transform(0, 0, 2.0), yaw_transform(0.5, 0.3, 2.0, 0.03)])
    scan = scans(wall, poses)[0]
    velocity = constant_velocity(inverse_transform(poses[0]) @ poses[1], 0.1)

    def bent(points: np.ndarray) -> float:
        on_wall = points[(points[:, 2] > -1.5) & (np.abs(points[:, 0]) < 25)]
        return float(np.std(on_wall[:, 1]))

    assert bent(deskewed(scan, velocity).points) < 0.025 < 0.05 < bent(scan.points)


@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_surfels_taken_in_parts_are_those_of_all_points(seed: int, cut: int) -> None:
    points = np.random.default_rng(seed).uniform(-2, 2, (60, 3))
    parts = SurfelMap(1.0, reach=50.0)
    parts.add(points[:cut], np.zeros(3))
    parts.add(points[cut:], np.zeros(3))
    whole = surfels_of(points, 1.0)
    for name in ("voxel", "count", "mean", "scatter", "flat"):
        np.testing.assert_allclose(getattr(parts.surfels, name), getattr(whole, name), atol=1e-12)


def test_surfels_know_their_normals_and_lines_are_not_flat() -> None:
    rng = np.random.default_rng(0)
    plane = rng.uniform([0, 0, 0.49], [1, 1, 0.51], (50, 3))
    line = rng.uniform([5, 0.49, 0.49], [6, 0.51, 0.51], (50, 3))
    surfels = surfels_of(np.concatenate([plane, line]), 1.0)
    assert surfels.flat.tolist() == [True, False]
    assert abs(surfels.normal[0, 2]) > 0.99


def test_the_map_forgets_what_is_far_behind() -> None:
    surfels = SurfelMap(1.0, reach=20.0)
    surfels.add(np.random.default_rng(0).uniform(-5, 5, (500, 3)), np.zeros(3))
    surfels.add(np.random.default_rng(1).uniform([95, -5, -5], [105, 5, 5], (500, 3)), np.array([100.0, 0, 0]))
    assert len(surfels.surfels)
    assert (surfels.surfels.mean[:, 0] > 80).all()


def test_a_scan_is_registered_to_a_centimetre_and_the_covariance_says_so() -> None:
    """Errors in the covariance's own measure: mean of a chi-square of six degrees, over independent scans."""
    world, poses = street(3), drive(2, speed=4.0)
    squares = []
    for seed in range(6):
        first, second = scans(world, poses, seed, skewed=False)
        surfels = SurfelMap(1.0, reach=100.0)
        surfels.add(first.points[voxel_downsample(first.points, 0.25)], np.zeros(3))
        truth = inverse_transform(poses[0]) @ poses[1]
        points = second.points[voxel_downsample(second.points, 1.5)]
        found = register(points, surfels, np.eye(4), 3.0, 0.1)
        error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse_transform(truth) @ found.map_T_scan))
        assert found.converged
        assert np.linalg.norm(error[3:]) < 0.04
        assert np.linalg.norm(error[:3]) < 0.002
        squares.append(float(error @ np.linalg.solve(found.covariance, error)))
    assert 1.5 < np.mean(squares) < 24  # 6 if the map were exact; it is one noisy scan


def test_what_cannot_be_registered_is_said() -> None:
    surfels = SurfelMap(1.0, reach=100.0)
    ground = np.random.default_rng(0).uniform([-20, -20, 0], [20, 20, 0.02], (20000, 3))
    surfels.add(ground, np.zeros(3))
    with pytest.raises(RegistrationError, match="leave a direction of motion unconstrained"):
        register(ground[::20], surfels, np.eye(4), 1.0, 0.1)
    with pytest.raises(RegistrationError, match="expected 12 points near the map at least, got 0"):
        register(transform_points(yaw_transform(z=50.0), ground[::20]), surfels, np.eye(4), 1.0, 0.1)


def test_wrong_poses_make_a_duller_map() -> None:
    world, poses = street(1), drive(12, speed=4.0)
    clouds = [scan.points for scan in scans(world, poses, skewed=False)]
    wrong = poses @ np.array([yaw_transform(z=0.05 * (-1) ** k) for k in range(len(poses))])
    assert scan_to_map_residual(clouds, poses) < 0.7 * scan_to_map_residual(clouds, wrong)
    assert np.isnan(scan_to_map_residual(clouds[:1], poses[:1]))
    moved = yaw_transform(100.0, 50.0, 3.0, 1.0) @ poses
    assert scan_to_map_residual(clouds, moved) == pytest.approx(scan_to_map_residual(clouds, poses), rel=0.1)
