"""Trajectories: files and errors. Trajectories, their alignment and their errors, against cases worked out by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from data_tools.trajectories import (
    Trajectory,
    absolute_errors,
    aligned,
    matched,
    read_kitti_poses,
    read_tum_poses,
    relative_errors,
    rigid_alignment,
    rotation_angle,
    trajectory_errors,
    write_kitti_poses,
    write_tum_poses,
)
from saga_fg import InputError
from saga_fg.numerics.geometry import yaw_transform


def straight(n: int, step: float = 1.0, drift: float = 0.0) -> Trajectory:
    """A drive along x with `step` m per second, moving `drift` m to the left with each."""
    return Trajectory(np.arange(n, dtype=float), np.stack([yaw_transform(step * k, drift * k) for k in range(n)]))


def random_motion(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    T[:3, 3] = rng.normal(0, 100, 3)
    return T


def test_absolute_errors_of_a_shift_and_relative_ones_wherever_the_world_lies():
    truth = straight(5)
    shifted = Trajectory(truth.timestamps, yaw_transform(3.0, 4.0) @ truth.world_T_ego)
    np.testing.assert_allclose(absolute_errors(shifted, truth, "none"), 5.0)
    np.testing.assert_allclose(absolute_errors(shifted, truth, "start"), 0.0, atol=1e-12)
    np.testing.assert_allclose(absolute_errors(shifted, truth, "rigid"), 0.0, atol=1e-12)
    rng = np.random.default_rng(0)
    truth, estimate = straight(30), straight(30, drift=0.02)
    moved = estimate.transformed(random_motion(rng))
    for a, b in zip(relative_errors(estimate, truth), relative_errors(moved, truth), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    angles = np.array([0.0, 1e-9, 0.5, 3.0, np.pi])
    R = Rotation.from_rotvec(angles[:, None] * np.array([0.6, 0.0, 0.8])).as_matrix()
    np.testing.assert_allclose(rotation_angle(R), angles, atol=1e-7)
    assert rotation_angle(R[1]) == pytest.approx(1e-9, rel=1e-3)


def umeyama_ape(reference: Path, estimate: Path, origin: bool) -> float:
    """What `evo_ape tum REFERENCE ESTIMATE` gives with --align_origin or with --align: RMSE of the translations, m."""
    rows = [np.loadtxt(file) for file in (reference, estimate)]
    (R, t), (Q, x) = ((Rotation.from_quat(table[:, 4:8]).as_matrix(), table[:, 1:4]) for table in rows)
    turn = R[0] @ Q[0].T
    if not origin:
        U, _, Vt = np.linalg.svd((t - t.mean(axis=0)).T @ (x - x.mean(axis=0)))
        turn = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    of, onto = (x[0], t[0]) if origin else (x.mean(axis=0), t.mean(axis=0))
    return float(np.sqrt(np.mean(np.sum((t - onto - (x - of) @ turn.T) ** 2, axis=1))))


def test_the_absolute_error_of_written_files_is_that_of_evo(tmp_path):
    rng = np.random.default_rng(0)
    truth = Trajectory(np.arange(50.0), np.stack([yaw_transform(k, np.sin(0.2 * k), 0.1, 0.1 * k) for k in range(50)]))
    off = random_motion(rng) @ truth.world_T_ego
    off[:, :3, 3] += rng.normal(0, 0.3, (50, 3)).cumsum(axis=0)
    estimate, files = Trajectory(truth.timestamps, off), (tmp_path / "reference.tum", tmp_path / "trajectory.tum")
    for file, path in zip(files, (truth, estimate), strict=True):
        write_tum_poses(file, path)
    for alignment in ("start", "rigid"):
        ours = trajectory_errors(estimate, truth, alignment).ate
        assert ours == pytest.approx(umeyama_ape(*files, origin=alignment == "start"), rel=1e-6)


def test_a_scale_error_stays_after_alignment():
    truth, longer = straight(5), straight(5, step=1.1)
    # -2, -1, 0, 1, 2 against 1.1 times that about the common centre
    np.testing.assert_allclose(absolute_errors(longer, truth, "rigid"), [0.2, 0.1, 0.0, 0.1, 0.2], atol=1e-12)
    figures = trajectory_errors(longer, truth, distance=2.0)
    assert figures.ate == pytest.approx(np.sqrt(0.1 / 5))
    assert figures.end_error == pytest.approx(0.2)
    assert figures.relative_translation == pytest.approx(0.2)  # 2.2 m where there were 2
    assert figures.relative_rotation == pytest.approx(0.0)
    assert figures.pieces == 3
    assert figures.path_length == pytest.approx(4.0)


def test_relative_errors_of_a_turning_estimate():
    truth = straight(11)
    turn = 0.01  # rad more with every metre
    pose, poses = np.eye(4), []
    for _ in range(11):
        poses.append(pose)
        pose = pose @ yaw_transform(1.0, 0.0, 0.0, turn)
    translation, rotation = relative_errors(Trajectory(truth.timestamps, np.stack(poses)), truth, 10.0)
    angles = turn * np.arange(10)
    x, y = np.cos(angles).sum(), np.sin(angles).sum()
    np.testing.assert_allclose(rotation, [0.1], atol=1e-12)
    np.testing.assert_allclose(translation, [np.hypot(10 - x, y)], atol=1e-12)


def test_relative_errors_are_those_of_stretches_as_long_as_asked():
    truth = Trajectory([0, 1, 2, 3], np.stack([yaw_transform(x) for x in (0.0, 4.0, 7.0, 12.0)]))
    estimate = Trajectory(truth.timestamps, np.stack([yaw_transform(x) for x in (0.0, 4.5, 8.0, 12.0)]))
    translation, _ = relative_errors(estimate, truth, 5.0)  # 0 -> 2, 1 -> 3, 2 -> 3
    np.testing.assert_allclose(translation, [1.0, 0.5, 1.0])
    figures = trajectory_errors(straight(3), straight(3), distance=10.0)
    assert figures.pieces == 0
    assert np.isnan(figures.relative_translation)


@given(st.integers(0, 2**32 - 1))
def test_alignment_undoes_any_rigid_motion_and_no_small_one_improves_on_it(seed):
    rng = np.random.default_rng(seed)
    points, motion = rng.normal(0, 10, (6, 3)), random_motion(rng)
    found = rigid_alignment(points, points @ motion[:3, :3].T + motion[:3, 3])
    np.testing.assert_allclose(found, motion, atol=1e-9)
    rng = np.random.default_rng(seed)
    source, target = rng.normal(0, 10, (8, 3)), rng.normal(0, 10, (8, 3))
    best = rigid_alignment(source, target)

    def cost(T: np.ndarray) -> float:
        return float(((source @ T[:3, :3].T + T[:3, 3] - target) ** 2).sum())

    for _ in range(5):
        nearby = np.eye(4)
        nearby[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
        nearby[:3, 3] = rng.normal(0, 0.1, 3)
        assert cost(best) <= cost(best @ nearby) + 1e-9
        assert cost(best) <= cost(nearby @ best) + 1e-9


def test_alignment_of_points_on_a_line_is_the_smallest_turn():
    line = np.outer(np.arange(4.0), [1, 0, 0])
    up = rigid_alignment(line, np.outer(np.arange(4.0), [0, 1, 0]))
    np.testing.assert_allclose(up, yaw_transform(yaw=np.pi / 2), atol=1e-12)
    back = rigid_alignment(line, -line)
    np.testing.assert_allclose(line @ back[:3, :3].T + back[:3, 3], -line, atol=1e-12)
    np.testing.assert_allclose(rigid_alignment(line[:1], [[1.0, 2, 3]])[:3, 3], [1, 2, 3])


def test_poses_are_matched_by_time_and_used_once():
    truth = straight(5)
    poses = np.stack([yaw_transform(k) for k in range(4)])
    estimate = Trajectory([0.004, 1.0, 1.006, 2.5], poses)
    found, true = matched(estimate, truth, tolerance=0.01)
    assert found.timestamps.tolist() == [0.004, 1.0]
    assert true.timestamps.tolist() == [0.0, 1.0]
    with pytest.raises(InputError, match=r"within 0\.01 s of the truth"):
        matched(Trajectory([7.5], poses[:1]), truth)
    single, _ = matched(straight(3), straight(1))
    assert len(single) == 1


def test_what_is_no_trajectory_is_refused():
    poses = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(InputError, match=r"timestamps\[2\]: expected increasing"):
        Trajectory([0, 1, 1], poses)
    skew = poses.copy()
    skew[1, 0, 0] = 1.1
    with pytest.raises(InputError, match=r"world_T_ego\[1\]: expected a rigid"):
        Trajectory([0, 1, 2], skew)
    with pytest.raises(InputError, match="at least one pose"):
        Trajectory([], np.empty((0, 4, 4)))
    with pytest.raises(InputError, match="expected 3 poses"):
        aligned(straight(2), straight(3))
    with pytest.raises(InputError, match="alignment: expected one of rigid, start, none"):
        aligned(straight(2), straight(2), "sim3")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="positive number of metres"):
        relative_errors(straight(2), straight(2), 0.0)


# Trajectories in KITTI's and TUM's format, from files written by hand and back

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


def test_poses_by_hand_in_either_format(tmp_path):
    path, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    path.write_text(KITTI)
    read = read_kitti_poses(path)
    np.testing.assert_allclose(read.world_T_ego, [np.eye(4), QUARTER_TURN], atol=1e-12)
    assert read.timestamps.tolist() == [0.0, 0.1]
    times.write_text("0.0\n0.25\n")
    assert read_kitti_poses(path, times).timestamps.tolist() == [0.0, 0.25]
    path = tmp_path / "groundtruth.txt"
    path.write_text(TUM)
    read = read_tum_poses(path)
    np.testing.assert_allclose(read.world_T_ego, [np.eye(4), QUARTER_TURN], atol=1e-12)
    assert read.timestamps.tolist() == [1305031102.1758, 1305031102.2758]


def test_written_poses_are_those_the_formats_ask_for_and_read_again(tmp_path):
    trajectory = wandering()
    write_tum_poses(tmp_path / "a.tum", trajectory)
    write_kitti_poses(tmp_path / "a.txt", trajectory, tmp_path / "times.txt")
    for read in (read_tum_poses(tmp_path / "a.tum"), read_kitti_poses(tmp_path / "a.txt", tmp_path / "times.txt")):
        assert read.timestamps.tolist() == trajectory.timestamps.tolist()
        np.testing.assert_allclose(read.world_T_ego, trajectory.world_T_ego, atol=1e-6)
    one = Trajectory([0.5], [QUARTER_TURN])
    write_tum_poses(tmp_path / "a.tum", one)
    comment, line = (tmp_path / "a.tum").read_text().splitlines()
    assert comment.startswith("#")
    assert line == "0.5 2.500000000 -1.000000000 0.250000000 0.000000000 0.000000000 0.707106781 0.707106781"
    write_kitti_poses(tmp_path / "a.txt", one)
    values = np.array((tmp_path / "a.txt").read_text().split(), dtype=float)
    np.testing.assert_allclose(values, [0, -1, 0, 2.5, 1, 0, 0, -1, 0, 0, 1, 0.25], atol=1e-15)
    (tmp_path / "poses.txt").write_text(KITTI)
    (tmp_path / "times.txt").write_text("0.0\n")
    with pytest.raises(InputError, match=r"times\.txt: expected 2 times, one per pose, got 1"):
        read_kitti_poses(tmp_path / "poses.txt", tmp_path / "times.txt")


def test_broken_kitti_poses_are_named(tmp_path, subtests):
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


def test_broken_tum_poses_are_named(tmp_path, subtests):
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
