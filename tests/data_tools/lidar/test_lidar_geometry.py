"""Ground, walls, poles and objects, found in scans of a street whose every piece is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.scans import SENSOR_HEIGHT, ScannerSettings, StaticWorld, simulate_scan, street
from data_tools.lidar import (
    Scan,
    extract_poles,
    extract_walls,
    fit_plane,
    segment_ground,
)
from data_tools.lidar.scan import clusters_from_above
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes

FINE = ScannerSettings(rings=48, columns=1000)
NO_POLES = np.empty((0, 4))


def seen(world: StaticWorld, seed: int = 0, pose: np.ndarray | None = None) -> Scan:
    pose = yaw_transform(0.0, 0.0, SENSOR_HEIGHT, 0.0) if pose is None else pose
    return simulate_scan(world, pose, np.random.default_rng(seed), FINE)


def boxes(*rows: tuple[float, ...]) -> Boxes:
    """x, y, z, length, width, height, yaw of each."""
    table = np.array(rows)
    return Boxes.of(["thing"] * len(rows), table[:, :3], table[:, 3:6], table[:, 6], np.zeros((len(rows), 2)))


def test_ground_is_what_lies_at_height_zero(subtests: pytest.Subtests) -> None:
    for seed in range(3):
        with subtests.test(seed=seed):
            points = seen(street(seed), seed).points
            ground = segment_ground(points)
            height = points[:, 2] + SENSOR_HEIGHT
            assert np.mean(ground.is_ground[np.abs(height) < 0.08]) > 0.99
            assert np.mean(ground.is_ground[height > 0.5]) < 0.02  # far houses, whose feet are hidden
            near = np.hypot(points[:, 0], points[:, 1]) < 30
            assert np.median(np.abs(ground.height - height)[near]) < 0.05


def test_ground_follows_a_slope() -> None:
    """A road that rises by 8 % from 15 m on: no line of sight knows it in advance."""
    scan = seen(StaticWorld(Boxes.empty(), NO_POLES))
    points = scan.points.copy()
    points[:, 2] += 0.08 * np.maximum(points[:, 0] - 15.0, 0.0)
    ground = segment_ground(points)
    assert np.mean(ground.is_ground[np.abs(points[:, 0]) < 40]) > 0.98
    assert not len(segment_ground(np.empty((0, 3))).height)


@given(st.integers(0, 2**32 - 1))
def test_a_plane_faces_the_sensor_and_holds_its_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    d = rng.uniform(1.0, 30.0)
    u = np.linalg.svd(normal[None])[2][1:]
    points = -d * normal + rng.uniform(-5, 5, (40, 2)) @ u
    plane = fit_plane(points, 0.01)
    np.testing.assert_allclose(plane.coefficients, [*normal, d], atol=1e-8)


@pytest.mark.parametrize("seed", range(2))
def test_walls_are_the_fronts_of_houses(seed: int) -> None:
    """Each wall lies on a side of a house; distances and directions are off by no more than the covariance says."""
    world = street(seed)
    points = seen(world, seed).points
    walls = extract_walls(points[~segment_ground(points).is_ground])
    assert len(walls) >= 4
    houses = world.boxes.select(world.boxes.label == "house")
    fronts = np.concatenate([(houses.position - houses.size / 2)[:, 1], (houses.position + houses.size / 2)[:, 1]])
    along = [wall for wall in walls if abs(wall.coefficients[1]) > 0.98 and np.ptp(wall.extent[:, 0]) > 6]
    assert len(along) >= 3
    squares = []
    for wall in along:
        nx, ny, nz, d = wall.coefficients
        error = d - np.abs(fronts)[np.argmin(np.abs(fronts + np.sign(ny) * d))]
        off = np.array([nx, nz, error])
        squares.append(float(off @ np.linalg.solve(wall.covariance, off)))
    assert np.median(squares) < 7.8  # 95 % of a chi-square of three degrees of freedom


def test_poles_are_found_where_they_stand() -> None:
    poles = np.array([[10.0, 4.0, 0.1, 4.0], [-8.0, 6.0, 0.15, 3.0], [15.0, -7.0, 0.2, 5.0]])
    world = StaticWorld(boxes((5.0, -5.0, 0.75, 4.4, 1.8, 1.5, 0.0), (0.0, 14.0, 3.0, 30.0, 2.0, 6.0, 0.0)), poles)
    squares = []
    for seed in range(4):
        points = seen(world, seed).points
        ground = segment_ground(points)
        found = extract_poles(points, ground.height, extract_walls(points[~ground.is_ground]))
        assert len(found) == 3
        for place in poles[:, :2]:
            nearest = min(found, key=lambda pole: float(np.linalg.norm(pole.foot[:2] - place)))
            off = nearest.foot[:2] - place
            assert np.linalg.norm(off) < 0.12
            squares.append(float(off @ np.linalg.solve(nearest.covariance, off)))
    assert np.mean(squares) < 3 * 2
    assert extract_poles(np.empty((0, 3)), np.empty(0)) == []


def test_parts_are_joined_across_cells_and_apart_beyond() -> None:
    chain = np.array([[0.1, 0.1, 0], [0.4, 0.4, 5], [0.7, 0.1, 0], [3.0, 0.1, 0], [-5.0, -5.0, 0]])
    clusters = clusters_from_above(chain, 0.3)
    assert sorted(rows.tolist() for rows in clusters) == [[0, 1, 2], [3], [4]]
    assert clusters_from_above(np.empty((0, 3)), 0.3) == []
