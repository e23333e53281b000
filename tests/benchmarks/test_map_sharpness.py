"""Sharpness of a map, against poses that are known to be wrong."""

import numpy as np
import pytest

from benchmarks.map_sharpness import scan_to_map_residual
from benchmarks.scans import drive, scans, street
from saga_fg.numerics.geometry import yaw_transform


def test_wrong_poses_make_a_duller_map() -> None:
    world, poses = street(1), drive(12, speed=4.0)
    clouds = [scan.points for scan in scans(world, poses, skewed=False)]
    wrong = poses @ np.array([yaw_transform(z=0.05 * (-1) ** k) for k in range(len(poses))])
    assert scan_to_map_residual(clouds, poses) < 0.7 * scan_to_map_residual(clouds, wrong)
    assert np.isnan(scan_to_map_residual(clouds[:1], poses[:1]))
    moved = yaw_transform(100.0, 50.0, 3.0, 1.0) @ poses
    assert scan_to_map_residual(clouds, moved) == pytest.approx(scan_to_map_residual(clouds, poses), rel=0.1)
