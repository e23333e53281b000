"""OdometryIncrements made worse has the errors its model speaks of."""

import numpy as np
import pytest

from data_tools.trajectories import degraded_odometry
from saga_fg.numerics.geometry import yaw_of, yaw_transform
from saga_fg.slam.joint import OdometryIncrements, OdometryNoise

STRAIGHT = OdometryIncrements.of(0.5 * np.arange(41.0), np.stack([yaw_transform(2.0 * k) for k in range(41)]))


def test_errors_have_the_deviations_of_the_model():
    noise = OdometryNoise(scale_drift=1e-9, bias_drift=1e-9, course_drift=1e-9)
    drawn = [degraded_odometry(STRAIGHT, noise, np.random.default_rng(seed)) for seed in range(400)]
    ends = np.stack([one.path()[-1] for one in drawn])
    distance, time = 80.0, 20.0
    expected = np.hypot(
        noise.scale * distance, np.sqrt(noise.distance_noise**2 * distance + noise.time_noise**2 * time)
    )
    assert np.std([one.distance.sum() for one in drawn]) == pytest.approx(expected, rel=0.15)
    first = np.stack([one.a_T_b[0, :2, 3] for one in drawn])
    expected = np.hypot(noise.course, noise.distance_noise / np.sqrt(2.0))
    assert np.std(np.arctan2(first[:, 1], first[:, 0])) == pytest.approx(expected, rel=0.15)
    expected = np.hypot(noise.bias * time, noise.turn_noise * np.sqrt(time))
    assert np.std(yaw_of(ends[:, :3, :3])) == pytest.approx(expected, rel=0.15)


def test_the_same_seed_gives_the_same_errors():
    a, b = (degraded_odometry(STRAIGHT, OdometryNoise(), np.random.default_rng(3)) for _ in range(2))
    assert a.a_T_b.tolist() == b.a_T_b.tolist()
    one = OdometryIncrements([0.0], np.empty((0, 4, 4)))
    assert len(degraded_odometry(one, OdometryNoise(), np.random.default_rng(0))) == 1
