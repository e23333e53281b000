"""Trajectories, their alignment and their errors, against cases worked out by hand."""

from __future__ import annotations

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
    relative_errors,
    rigid_alignment,
    rotation_angle,
    trajectory_errors,
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


def test_absolute_errors_of_a_shifted_drive() -> None:
    truth = straight(5)
    shifted = Trajectory(truth.timestamps, yaw_transform(3.0, 4.0) @ truth.world_T_ego)
    np.testing.assert_allclose(absolute_errors(shifted, truth, "none"), 5.0)
    np.testing.assert_allclose(absolute_errors(shifted, truth, "start"), 0.0, atol=1e-12)
    np.testing.assert_allclose(absolute_errors(shifted, truth, "rigid"), 0.0, atol=1e-12)


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


def test_the_absolute_error_of_written_files_is_that_of_evo(tmp_path: Path) -> None:
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


def test_a_scale_error_stays_after_alignment() -> None:
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


def test_relative_errors_of_a_turning_estimate() -> None:
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


def test_a_stretch_ends_at_the_first_pose_that_is_far_enough() -> None:
    truth = Trajectory([0, 1, 2, 3], np.stack([yaw_transform(x) for x in (0.0, 4.0, 7.0, 12.0)]))
    estimate = Trajectory(truth.timestamps, np.stack([yaw_transform(x) for x in (0.0, 4.5, 8.0, 12.0)]))
    translation, _ = relative_errors(estimate, truth, 5.0)  # 0 -> 2, 1 -> 3, 2 -> 3
    np.testing.assert_allclose(translation, [1.0, 0.5, 1.0])


def test_a_drive_shorter_than_the_distance_has_no_relative_error() -> None:
    figures = trajectory_errors(straight(3), straight(3), distance=10.0)
    assert figures.pieces == 0
    assert np.isnan(figures.relative_translation)


@given(st.integers(0, 2**32 - 1))
def test_alignment_undoes_any_rigid_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, motion = rng.normal(0, 10, (6, 3)), random_motion(rng)
    found = rigid_alignment(points, points @ motion[:3, :3].T + motion[:3, 3])
    np.testing.assert_allclose(found, motion, atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_no_small_motion_improves_on_the_alignment(seed: int) -> None:
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


def test_alignment_of_points_on_a_line_is_the_smallest_turn() -> None:
    line = np.outer(np.arange(4.0), [1, 0, 0])
    up = rigid_alignment(line, np.outer(np.arange(4.0), [0, 1, 0]))
    np.testing.assert_allclose(up, yaw_transform(yaw=np.pi / 2), atol=1e-12)
    back = rigid_alignment(line, -line)
    np.testing.assert_allclose(line @ back[:3, :3].T + back[:3, 3], -line, atol=1e-12)
    np.testing.assert_allclose(rigid_alignment(line[:1], [[1.0, 2, 3]])[:3, 3], [1, 2, 3])


def test_relative_errors_ignore_where_the_world_lies() -> None:
    rng = np.random.default_rng(0)
    truth, estimate = straight(30), straight(30, drift=0.02)
    moved = estimate.transformed(random_motion(rng))
    for a, b in zip(relative_errors(estimate, truth), relative_errors(moved, truth), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_rotation_angle() -> None:
    angles = np.array([0.0, 1e-9, 0.5, 3.0, np.pi])
    R = Rotation.from_rotvec(angles[:, None] * np.array([0.6, 0.0, 0.8])).as_matrix()
    np.testing.assert_allclose(rotation_angle(R), angles, atol=1e-7)
    assert rotation_angle(R[1]) == pytest.approx(1e-9, rel=1e-3)


def test_poses_are_matched_by_time_and_used_once() -> None:
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


def test_what_is_no_trajectory_is_refused() -> None:
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
