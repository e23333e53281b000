"""KITTI's LiDAR scans: which there are, when and where they were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import KittiScans
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import inverse_transform
from tests.data_tools.kitti_example import write_sequence


def with_scans(root: Path, *frames: int) -> Path:
    folder = write_sequence(root) / "training" / "velodyne" / "0007"
    folder.mkdir(parents=True)
    for frame in frames:
        np.array([[frame + 1.0, 0.0, 0.0, 0.5], [0.0, 2.0, 0.0, 0.1]], dtype="<f4").tofile(folder / f"{frame:06d}.bin")
    return root


def test_scans_have_the_time_and_pose_of_their_frame(tmp_path: Path) -> None:
    scans = KittiScans(with_scans(tmp_path, 0, 2), "0007")
    assert len(scans) == 2
    assert scans.frames.tolist() == [0, 2]
    np.testing.assert_allclose(scans.timestamps, [0.0, 0.2])
    np.testing.assert_allclose(scans.world_T_ego[1][:3, 3], [2.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(scans.ego_T_lidar[:3, 3], [1.0, 0.0, 2.0])
    np.testing.assert_allclose(inverse_transform(scans.ego_T_lidar)[:3, 3], [-1.0, 0.0, -2.0])
    second = list(scans)[1]
    np.testing.assert_allclose(second.points, [[3, 0, 0], [0, 2, 0]])
    np.testing.assert_allclose(second.time, [0.0, -0.025])  # looking ahead at its moment, left a quarter turn before
    assert KittiScans(tmp_path, "0007", timed=False)[0].time is None
    assert len(KittiScans(tmp_path, "0007", most=1)) == 1


def test_a_sequence_without_scans_and_scans_without_records_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"velodyne.0007: expected LiDAR scans KKKKKK\.bin, there are none"):
        KittiScans(write_sequence(tmp_path / "a"), "0007")
    with pytest.raises(InputError, match=r"000003\.bin: expected frames 0 to 2"):
        KittiScans(with_scans(tmp_path / "b", 3), "0007")
