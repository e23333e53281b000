"""Registration and search of planar scans, against what is known."""

from __future__ import annotations

import numpy as np
import pytest

from data_tools.laser import LineMap, OccupancyGrid, ScoreGrid
from saga_fg.numerics.arrays import FloatArray


def room(rng: np.random.Generator, n: int = 600) -> FloatArray:
    """Points on the walls of an L-shaped room, noisy."""
    corners = np.array([(0, 0), (6, 0), (6, 3), (4, 3), (4, 5), (0, 5), (0, 0)], dtype=float)
    part, share = rng.integers(0, 6, n), rng.uniform(size=(n, 1))
    return corners[part] * (1 - share) + corners[part + 1] * share + 0.01 * rng.normal(size=(n, 2))


def seen_from(points: FloatArray, pose: FloatArray) -> FloatArray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (points - pose[:2]) @ np.array([[c, -s], [s, c]])


def test_point_to_line_finds_the_pose(subtests: pytest.Subtests) -> None:
    for seed in range(3):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            true = np.array([2.0, 2.0, 0.3])
            lines = LineMap.of(room(rng))
            fit = lines.fit(seen_from(room(rng, 180), true), true + np.array([0.15, -0.1, 0.05]), np.eye(3), reach=0.5)
            assert (np.abs(fit.pose - true) < [0.01, 0.01, 0.005]).all()
            assert fit.share > 0.97  # the sampled walls have gaps
            assert np.linalg.eigvalsh(fit.information[:2, :2])[0] > 0


def test_along_a_bare_corridor_odometry_decides() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-8, 8, 400)
    walls = np.column_stack([x, np.where(rng.uniform(size=400) < 0.5, 1.0, -1.0)]) + 0.01 * rng.normal(size=(400, 2))
    start = np.array([0.7, 0.1, 0.0])
    fit = LineMap.of(walls).fit(walls[np.abs(x) < 3], start, np.diag([1e4, 1.0, 1.0]), reach=0.5)
    np.testing.assert_allclose(fit.pose, [0.7, 0, 0], atol=0.02)
    values = np.linalg.eigvalsh(fit.information[:2, :2])
    assert values[0] < 0.02 * values[1]


def test_branch_and_bound_finds_what_all_poses_of_the_window_would(subtests: pytest.Subtests) -> None:
    for seed in range(3):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            true = np.array([2.2, 1.7, 0.4])
            grid = ScoreGrid.of(room(rng))
            scan = seen_from(room(rng, 150), true)
            found = grid.search(scan, true + np.array([1.3, -0.9, 0.25]), 2.0, 0.4, 0.5)
            assert found is not None
            assert (np.abs(found.pose - true) < [0.11, 0.11, 0.06]).all()
            assert found.rival < 0.9 * found.score
            assert grid.search(scan, true + np.array([4.0, 3.0, 0.0]), 1.0, 0.1, 0.8) is None


def test_bounds_hold_on_every_level() -> None:
    rng = np.random.default_rng(5)
    grid = ScoreGrid.of(room(rng))
    fine = grid.levels[0]
    for k, level in enumerate(grid.levels):
        pad = 2**k - 1
        for i, j in rng.integers(-pad, fine.shape[0] - 10, size=(50, 2)).tolist():
            if not -pad <= j < fine.shape[1]:
                continue
            block = fine[max(i, 0) : max(i + 2**k, 0), max(j, 0) : max(j + 2**k, 0)]
            assert level[i + pad, j + pad] == pytest.approx(block.max(initial=0.0))


def test_a_map_that_is_drawn_twice_has_the_larger_entropy() -> None:
    rng = np.random.default_rng(1)
    scans = [seen_from(room(rng, 180), np.array([2.0, 2.0, 0.0])) for _ in range(6)]
    poses = np.tile(np.eye(3), (6, 1, 1))
    apart = poses.copy()
    apart[3:, :2, 2] = 0.3
    assert OccupancyGrid.of(scans, apart).entropy > 1.1 * OccupancyGrid.of(scans, poses).entropy


@pytest.mark.parametrize("edge", [-0.4, 0.4])
def test_the_window_ends_at_its_reach_on_both_sides(edge: float) -> None:
    rng = np.random.default_rng(2)
    true = np.array([2.0, 2.0, 0.0])
    grid = ScoreGrid.of(room(rng))
    scan = seen_from(room(rng, 150), true)
    at_the_edge = grid.search(scan, true - np.array([edge, edge, 0.0]), 0.4, 0.02, 0.5)
    assert at_the_edge is not None
    assert (np.abs(at_the_edge.pose[:2] - true[:2]) < 0.06).all()
    start = true - np.array([2 * edge, 2 * edge, 0.0])
    beyond = grid.search(scan, start, 0.4, 0.02, 0.01)
    assert beyond is not None
    assert (np.abs(beyond.pose[:2] - start[:2]) < 0.41).all()


def test_the_share_is_of_points_near_the_map_even_where_too_few_pair() -> None:
    lines = LineMap.of(room(np.random.default_rng(0)))
    scan = np.array([[0.5, 0.1], [1.0, 0.1], [1.5, 0.4], [2.0, 0.4]])
    fit = lines.fit(scan, np.zeros(3), np.eye(3), reach=0.5)
    assert fit.share == 0.5
    assert not fit.information.any()
