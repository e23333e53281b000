"""The vehicle, landmarks and objects online: what a window loses against the batch, and what it must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from factors import prior_factor
from saga_fg import InputError
from saga_fg.graph import EGO_VELOCITY, LANDMARK, Additions, GraphView, NewVariable
from saga_fg.model.landmarks import PoleLandmark
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.slam.joint import JointSettings, OnlineEstimator, estimate_jointly, estimate_online
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.landmark import Observation
from tests.saga_fg.ego_drive import drive, new_tracker
from tests.saga_fg.slam.test_joint import POOR, worse

SETTINGS = JointSettings(POOR)


def rms(found, poses):
    return np.sqrt(np.mean(np.sum((found - poses)[:, :2, 3] ** 2, axis=1)))


def seen_poles(poses, rng, noise=0.05):
    poles = np.column_stack([np.arange(4.0, 40, 8), np.tile([6.0, -6.0, 7.0], 2)[:5], np.full(5, 1.0)])
    kind, seen = PoleLandmark(), []
    for pose in poses:
        local = (inverse_transform(pose) @ np.column_stack([poles, np.ones(5)]).T).T[:, :3]
        local[:, :2] += rng.normal(0, noise, (5, 2))
        seen.append([Observation(kind, z, noise**2 * np.eye(2)) for z in local if np.hypot(*z[:2]) < 20])
    return poles[:, :2], seen


def test_a_window_of_seconds_is_nearly_the_batch() -> None:
    frames, odometry, poses, _ = drive(n=35)
    reported = worse(odometry, np.random.default_rng(1))
    batch = estimate_jointly(frames, reported, new_tracker, SETTINGS, poses[0])
    online = estimate_online(frames, reported, OnlineEstimator(new_tracker(), 2.0, SETTINGS, start=poses[0]))
    alone = rms(reported.path(poses[0]), poses)
    assert rms(online.newest, poses) < alone / 3
    assert rms(online.settled, poses) < max(1.5 * rms(batch.world_T_ego, poses), 0.15)
    assert len(online.settled) == len(frames)
    P = online.covariances[-1]
    np.testing.assert_allclose(np.sqrt(np.diag(P)), np.sqrt(np.diag(batch.pose_covariances[-1])), rtol=0.1)
    errors = np.array([inverse_transform(f) @ p for f, p in zip(online.newest, poses, strict=True)])
    planar = np.stack([errors[:, 1, 0], errors[:, 0, 3], errors[:, 1, 3]], axis=1)
    squares = [e @ np.linalg.solve(P[2:5, 2:5], e) for e, P in zip(planar, online.covariances, strict=True)]
    assert np.mean(squares[5:]) < chi2.ppf(0.999, 3)


def test_variables_of_providers_leave_the_window_with_their_epoch() -> None:
    frames, odometry, poses, _ = drive(n=12)
    estimator = OnlineEstimator(new_tracker(), 1.0, SETTINGS, start=poses[0], providers=[_Speeds()])
    for k, frame in enumerate(frames):
        estimator.step(frame, odometry.a_T_b[k - 1] if k else None)
    graph, window = estimator._window._smoother.graph(), estimator._window.record
    assert all(graph.of(EGO_VELOCITY, now.epoch) for now in window)
    assert not any(graph.of(EGO_VELOCITY, k) for k in range(window[0].epoch))


class _Speeds:
    """A variable of its own at every epoch."""

    name = "speeds"

    def factors(self, view: GraphView) -> Additions:
        assert view.frame is not None
        prior = prior_factor(view.key(EGO_VELOCITY, 0), np.zeros(3), np.eye(3))
        return Additions([NewVariable(EGO_VELOCITY, 0, np.zeros(3))], [prior])


def test_what_leaves_the_window_stays_in_the_prior() -> None:
    """In a nearly linear problem a short window gives the newest pose and covariance of a long one."""
    frames, odometry, poses, _ = drive(n=14, parked=0, moving=3)
    reported = worse(odometry, np.random.default_rng(2))
    linear = replace(SETTINGS, outlier_scale=np.inf, moving_speed={DEFAULT: 1e-6})  # nobody stands, no robust loss
    _, seen = seen_poles(poses, np.random.default_rng(4))
    short, long = (
        estimate_online(frames, reported, OnlineEstimator(new_tracker(), lag, linear, start=poses[0]), seen)
        for lag in (0.5, 60.0)
    )
    sigma = np.sqrt(np.diag(long.covariances[-1]))[3:5]
    assert (np.abs((short.newest - long.newest)[-1, :2, 3]) < 0.1 * sigma).all()
    np.testing.assert_allclose(short.covariances[-1], long.covariances[-1], rtol=0.02, atol=1e-6)


def test_landmarks_are_told_apart_and_leave_with_the_window() -> None:
    frames, odometry, poses, _ = drive(n=30, parked=0, moving=0)
    reported = worse(odometry, np.random.default_rng(2))
    poles, seen = seen_poles(poses, np.random.default_rng(3))
    estimator = OnlineEstimator(new_tracker(), 1.0, SETTINGS, start=poses[0])
    online = estimate_online(frames, reported, estimator, seen)
    graph = estimator._window._smoother.graph()
    left = [graph.state(one.key) for one in graph.of(LANDMARK, None).values()]
    assert 0 < len(left) < len(poles)
    assert max(np.linalg.norm(poles - place, axis=1).min() for place in left) < 0.5
    assert rms(online.newest, poses) < rms(reported.path(poses[0]), poses) / 3


def test_every_moment_settles_once_and_the_window_holds_the_lag() -> None:
    frames, odometry, poses, _ = drive(n=9)
    estimator, times = OnlineEstimator(new_tracker(), 0.6, SETTINGS, start=poses[0]), []
    for k, frame in enumerate(frames):
        step = estimator.step(frame, odometry.a_T_b[k - 1] if k else None)
        assert step.newest.timestamps.tolist() == [frame.timestamp]
        if step.settled is not None:
            times += step.settled.timestamps.tolist()
        assert frame.timestamp - estimator.window().timestamps[0] < 0.6 + 0.2 + 1e-9
    times += estimator.window().timestamps.tolist()
    np.testing.assert_allclose(times, [frame.timestamp for frame in frames])
    assert estimator.window().object_covariances(0).shape[1:] == (4, 4)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="lag: expected a finite number"):
        OnlineEstimator(new_tracker(), -1.0)
    estimator = OnlineEstimator(new_tracker(), 1.0)
    with pytest.raises(InputError, match="expected a frame before"):
        estimator.window()
    frames, odometry, _, _ = drive(n=3)
    estimator.step(frames[1])
    with pytest.raises(InputError, match="expected one after"):
        estimator.step(frames[0], np.eye(4))
    with pytest.raises(InputError, match="expected observations at 3 times, got 1"):
        estimate_online(frames, odometry, OnlineEstimator(new_tracker(), 1.0), [()])


def test_a_motion_that_is_none_does_not_reach_the_graph(subtests: pytest.Subtests) -> None:
    for motion, covariance, message in [
        (None, None, "a_T_b: expected the motion since the last frame"),
        (np.full((4, 4), np.nan), None, "expected a finite number"),
        (2 * np.eye(4), None, "a_T_b: expected a rigid"),
        (np.eye(4), -np.eye(6), "covariance"),
    ]:
        with subtests.test(message):
            frames, odometry, *_ = drive(n=3)
            estimator = OnlineEstimator(new_tracker(), 1.0, SETTINGS)
            estimator.step(frames[0])
            with pytest.raises(InputError, match=message):
                estimator.step(frames[1], motion, covariance)
            estimator.step(frames[1], odometry.a_T_b[0])  # and leaves the estimator as it was
            assert len(estimator.window().world_T_ego) == 2
