"""Submaps: their frame, and what they refuse."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from data_tools.lidar import Submap, upright
from saga_fg.errors import InputError


def test_the_frame_stands_upright_and_looks_where_the_sensor_does() -> None:
    world_T_sensor = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, 0.2, -0.1), np.array([3.0, 4.0, 1.0])).matrix()
    world_T_submap = world_T_sensor @ upright(world_T_sensor)
    np.testing.assert_allclose(world_T_submap[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(world_T_submap[1, 0], world_T_submap[0, 0]), 0.7)
    np.testing.assert_allclose(world_T_submap[:3, 3], [3, 4, 1])


def test_points_are_small_and_finite() -> None:
    submap = Submap(0, (0, 5), 0, np.eye(4), np.ones((3, 3)), (0.0, 4.0))
    assert submap.points.dtype == np.float32
    with pytest.raises(InputError, match="points: expected finite coordinates"):
        Submap(0, (0, 5), 0, np.eye(4), np.full((3, 3), np.nan), (0.0, 4.0))
