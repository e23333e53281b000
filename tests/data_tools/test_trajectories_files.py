"""Trajectories in KITTI's and TUM's format, from files written by hand and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_tools.trajectories import (
    Trajectory,
    read_kitti_poses,
    read_tum_poses,
    write_kitti_poses,
    write_tum_poses,
)
from saga_fg import InputError
from saga_fg.numerics.geometry import yaw_transform

KITTI = """1 0 0 0 0 1 0 0 0 0 1 0
0 -1 0 2.5 1 0 0 -1 0 0 1 0.25
"""
TUM = """# ground truth
# timestamp tx ty tz qx qy qz qw
1305031102.1758 0 0 0 0 0 0 1

1305031102.2758 2.5 -1 0.25 0 0 0.70711 0.70711
"""
QUARTER_TURN = yaw_transform(2.5, -1.0, 0.25, np.pi / 2)


def wandering(n: int = 20) -> Trajectory:
    rng = np.random.default_rng(4)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, random_state=3).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 500, (n, 3))
    return Trajectory(1.7e9 + np.cumsum(rng.uniform(0.01, 1, n)), poses)


def test_kitti_poses_by_hand(tmp_path: Path) -> None:
    path, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    path.write_text(KITTI)
    read = read_kitti_poses(path)
    np.testing.assert_allclose(read.world_T_ego, [np.eye(4), QUARTER_TURN], atol=1e-12)
    assert read.timestamps.tolist() == [0.0, 0.1]
    times.write_text("0.0\n0.25\n")
    assert read_kitti_poses(path, times).timestamps.tolist() == [0.0, 0.25]


def test_tum_poses_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "groundtruth.txt"
    path.write_text(TUM)
    read = read_tum_poses(path)
    np.testing.assert_allclose(read.world_T_ego, [np.eye(4), QUARTER_TURN], atol=1e-12)
    assert read.timestamps.tolist() == [1305031102.1758, 1305031102.2758]


def test_both_formats_return_what_was_written(tmp_path: Path) -> None:
    trajectory = wandering()
    write_tum_poses(tmp_path / "a.tum", trajectory)
    write_kitti_poses(tmp_path / "a.txt", trajectory, tmp_path / "times.txt")
    for read in (read_tum_poses(tmp_path / "a.tum"), read_kitti_poses(tmp_path / "a.txt", tmp_path / "times.txt")):
        assert read.timestamps.tolist() == trajectory.timestamps.tolist()
        np.testing.assert_allclose(read.world_T_ego, trajectory.world_T_ego, atol=1e-6)


def test_a_written_pose_is_the_line_the_format_asks_for(tmp_path: Path) -> None:
    one = Trajectory([0.5], [QUARTER_TURN])
    write_tum_poses(tmp_path / "a.tum", one)
    comment, line = (tmp_path / "a.tum").read_text().splitlines()
    assert comment.startswith("#")
    assert line == "0.5 2.500000000 -1.000000000 0.250000000 0.000000000 0.000000000 0.707106781 0.707106781"
    write_kitti_poses(tmp_path / "a.txt", one)
    values = np.array((tmp_path / "a.txt").read_text().split(), dtype=float)
    np.testing.assert_allclose(values, [0, -1, 0, 2.5, 1, 0, 0, -1, 0, 0, 1, 0.25], atol=1e-15)


def test_broken_kitti_poses_are_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in [
        ("", "expected a pose per line, the file is empty"),
        ("1 0 0 0 0 1 0 0 0 0 1\n", "line 1: expected 12 columns"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n", "line 1: tz: expected a finite number, got 'x'"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", r"world_T_ego\[0\]: expected a rigid transform"),
    ]:
        with subtests.test(message):
            path = tmp_path / "poses.txt"
            path.write_text(text)
            with pytest.raises(InputError, match=message) as caught:
                read_kitti_poses(path)
            assert str(path) in str(caught.value)


def test_times_must_be_as_many_as_poses(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(KITTI)
    (tmp_path / "times.txt").write_text("0.0\n")
    with pytest.raises(InputError, match=r"times\.txt: expected 2 times, one per pose, got 1"):
        read_kitti_poses(tmp_path / "poses.txt", tmp_path / "times.txt")


def test_broken_tum_poses_are_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for text, message in [
        ("# nothing\n", "expected a pose per line, there is none"),
        ("0 0 0 0 0 0 0 0.5\n", "line 1: qx qy qz qw: expected a unit quaternion, got norm 0.5"),
        ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", r"timestamps\[1\]: expected increasing times"),
        ("0 0 nan 0 0 0 0 1\n", "line 1: ty: expected a finite number, got 'nan'"),
    ]:
        with subtests.test(message):
            path = tmp_path / "poses.tum"
            path.write_text(text)
            with pytest.raises(InputError, match=message):
                read_tum_poses(path)
