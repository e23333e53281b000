"""LiDAR odometry on simulated drives, where the true poses are known."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from benchmarks.scans import ScannerSettings, drive, scans, street
from data_tools.lidar import Scan
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.odometry import LOST_ROTATION, LOST_TRANSLATION, LidarOdometry, OdometrySettings, OdometryStep
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from tests.data_tools.featureless import tunnel

PERIOD = 0.1


def run(taken: list[Scan]) -> list[OdometryStep]:
    odometry = LidarOdometry()
    return [odometry.step(scan, PERIOD * k) for k, scan in enumerate(taken)]


def trajectory(poses: FloatArray) -> Trajectory:
    return Trajectory(PERIOD * np.arange(len(poses)), poses)


def test_a_drive_is_followed_to_centimetres() -> None:
    poses = drive(30)
    steps = run(scans(street(0), poses))
    estimate = poses[0] @ np.array([step.map_T_lidar for step in steps])
    errors = trajectory_errors(trajectory(estimate), trajectory(poses))
    assert errors.relative_translation < 0.03
    assert errors.relative_rotation < 0.002
    assert all(step.registration is not None and step.registration.converged for step in steps[1:])
    assert steps[0].keyframe
    assert sum(step.keyframe for step in steps) == len(steps)
    for step in steps[1:]:
        assert np.linalg.eigvalsh(step.covariance)[0] > 0


def test_a_start_at_full_speed_is_caught_up_with() -> None:
    """As long as the speed is not known, no prediction is held on to."""
    poses = drive(8, speed=16.0, turn_rate=0.0)
    steps = run(scans(street(1), poses, 1))
    estimate = poses[0] @ np.array([step.map_T_lidar for step in steps])
    assert np.linalg.norm(np.diff(estimate[4:, 0, 3]) - 1.6) < 0.1


def test_poses_stay_rigid_however_long_the_chain() -> None:
    """A rotation a little off, fed back through the predicted motion, would be off by everything within forty scans."""
    world, poses = street(0), np.repeat(drive(2, speed=0.5)[:1], 45, axis=0)
    last = run(scans(world, poses, skewed=False))[-1].map_T_lidar
    np.testing.assert_allclose(last[:3, :3] @ last[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(last, np.eye(4), atol=0.02)


def test_a_scan_without_points_lies_where_it_was_predicted(caplog: pytest.LogCaptureFixture) -> None:
    poses = drive(8)
    taken = scans(street(0), poses)
    taken[5] = Scan.of(np.empty((0, 3)))
    with caplog.at_level(logging.WARNING):
        steps = run(taken)
    assert "the motion of the one before goes on" in caplog.text
    assert steps[5].registration is None
    assert not steps[5].keyframe
    deviations = [LOST_ROTATION] * 3 + [LOST_TRANSLATION] * 3
    np.testing.assert_allclose(steps[5].covariance, np.diag(np.square(deviations)))
    assert [step.lost for step in steps] == [0] * 6 + [1, 0]
    estimate = poses[0] @ np.array([step.map_T_lidar for step in steps])
    assert np.linalg.norm(estimate[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.1


def test_through_a_tunnel_odometry_says_what_it_does_not_see(caplog: pytest.LogCaptureFixture) -> None:
    """A street, then a tunnel: along it other sensors decide, and the covariance leaves room for them."""
    poses = drive(36, speed=16.0, turn_rate=0.0)
    world = tunnel(poses[10, 0, 3], poses[10, 0, 3] + 200.0, seed=0)
    taken = scans(world, poses, settings=ScannerSettings(rings=24, columns=360, reach=25.0))
    odometry, wheels = LidarOdometry(), np.array([np.nan] * 3 + [16.0, np.nan, np.nan])
    with caplog.at_level(logging.WARNING):
        steps = [odometry.step(scan, PERIOD * k, wheels) for k, scan in enumerate(taken)]
    assert not any(step.degenerate for step in steps[:10])
    inside = steps[-6:]
    assert all("along the road" in step.degenerate for step in inside)
    assert all(step.covariance[3, 3] > 0.5 > 0.05 > step.covariance[4, 4] for step in inside)
    assert "do not determine the motion along the road" in caplog.text
    estimate = poses[0] @ np.array([step.map_T_lidar for step in steps])
    assert np.linalg.norm(estimate[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.3
    with pytest.raises(InputError, match="velocity: expected"):
        odometry.step(taken[0], 10.0, np.zeros(3))


def test_time_runs_forwards_and_settings_are_checked() -> None:
    odometry = LidarOdometry()
    scan = scans(street(0), drive(2))[0]
    odometry.step(scan, 1.0)
    with pytest.raises(InputError, match="timestamp: expected a finite number of seconds, got nan"):
        LidarOdometry().step(scan, float("nan"))
    with pytest.raises(InputError, match=r"timestamp: expected one after 1\.0"):
        odometry.step(scan, 1.0)
    with pytest.raises(InputError, match="surfel_size: expected"):
        OdometrySettings(surfel_size=0.0)
