"""Path of the vehicle and objects around it, together."""

import numpy as np
import pytest
from scipy.stats import chi2

from saga_fg import Boxes, Detections, Frame, InputError
from saga_fg.model.landmarks import PoleLandmark
from saga_fg.numerics.geometry import inverse_transform, yaw_transform
from saga_fg.slam.joint import JointSettings, OdometryIncrements, OdometryNoise, estimate_jointly
from saga_fg.slam.joint.association import SlowErrors, stationary_probabilities
from saga_fg.slam.joint.record import record_epochs
from saga_fg.types.landmark import Observation
from tests.saga_fg.ego_drive import drive, new_tracker

POOR = OdometryNoise(scale=0.02, bias=0.005)


def worse(odometry, rng, scale=0.02, bias=-0.004):
    """Increments with a scale error, a turning heading and noise as POOR says."""
    steps = odometry.a_T_b.copy()
    for k, dt in enumerate(odometry.dt):
        steps[k, :3, 3] = (1 + scale) * steps[k, :3, 3] + rng.normal(0, POOR.distance_noise * np.sqrt(6.0 * dt), 3)
        turn = yaw_transform(yaw=bias * dt + rng.normal(0, POOR.turn_noise * np.sqrt(dt)))
        steps[k, :3, :3] = turn[:3, :3] @ steps[k, :3, :3]
    return OdometryIncrements(odometry.timestamps, steps)


@pytest.fixture(scope="module")
def solved():
    frames, odometry, poses, cars = drive()
    reported = worse(odometry, np.random.default_rng(1))
    estimate = estimate_jointly(frames, reported, new_tracker, JointSettings(POOR), poses[0])
    return reported, poses, cars, estimate


def test_objects_that_stand_correct_the_odometry(solved):
    reported, poses, _, estimate = solved
    alone = np.linalg.norm((reported.path(poses[0]) - poses)[:, :2, 3], axis=1)
    joint = np.linalg.norm((estimate.world_T_ego - poses)[:, :2, 3], axis=1)
    assert estimate.converged
    assert joint.max() < alone.max() / 2
    assert estimate.errors[-1, 0] == pytest.approx(0.02, abs=3 * estimate.slow_errors.scale)
    assert estimate.errors[-1, 1] == pytest.approx(-0.004, abs=3 * estimate.slow_errors.bias)


def test_errors_are_as_large_as_the_covariances_say(solved):
    _, poses, _, estimate = solved
    squares = []
    for pose, found, P in zip(poses, estimate.world_T_ego, estimate.pose_covariances, strict=True):
        error = inverse_transform(found) @ pose
        e = np.array([error[1, 0], error[0, 3], error[1, 3]])  # heading and place in the plane
        part = P[np.ix_([2, 3, 4], [2, 3, 4])]
        squares.append(e @ np.linalg.solve(part, e))
    assert np.mean(squares[5:]) < chi2.ppf(0.999, 3)
    assert np.mean(squares[5:]) > 0.05  # nor far too careful


def test_objects_lie_where_they_are_beside_the_vehicle(solved):
    _, poses, cars, estimate = solved
    last = estimate.objects[-1]
    true = cars[-1] @ poses[-1, :2, :2] - poses[-1, :2, 3] @ poses[-1, :2, :2]
    pose = estimate.world_T_ego[-1]
    found = last.position @ pose[:2, :2] - pose[:2, 3] @ pose[:2, :2]
    off = np.linalg.norm(true[None] - found[:, None], axis=2).min(axis=1)
    assert len(last.id) >= 5
    assert off.max() < 0.5
    speeds = np.hypot(*last.velocity.T)
    assert (speeds < 1.0).sum() >= 5  # parked
    assert (speeds > 3).sum() == 2  # moving
    P = estimate.object_covariances(len(estimate.objects) - 1)
    assert P.shape == (len(last.id), 4, 4)
    assert (np.linalg.eigvalsh(P) > 0).all()


def test_with_no_objects_the_odometry_remains():
    frames, odometry, poses, _ = drive(n=10, parked=0, moving=0)
    estimate = estimate_jointly(frames, odometry, new_tracker, start=poses[0])
    np.testing.assert_allclose(estimate.world_T_ego, poses, atol=1e-6)
    assert all(len(objects.id) == 0 for objects in estimate.objects)


def test_what_stands_is_told_from_what_drives():
    frames, odometry, poses, cars = drive(parked=4, moving=2)
    record = record_epochs(frames, poses, odometry, new_tracker())
    p = stationary_probabilities(record, poses, SlowErrors(1e-3, 1e-4, 1e-3), JointSettings())
    middle = len(record) // 2
    seen = record[middle].seen
    for name, z in zip(seen.id, seen.z, strict=True):
        place = (poses[middle] @ np.append(z, 1))[:2]
        car = int(np.argmin(np.linalg.norm(cars[middle] - place, axis=1)))
        probability = p[middle][np.searchsorted(record[middle].objects.id, name)]
        assert (probability > 0.5) == (car < 4)


def test_who_walks_far_away_does_not_stand():
    """A second of walking at 40 m is within the errors of poor odometry; it says nothing of cars."""
    t = 0.2 * np.arange(20)
    poses = np.stack([yaw_transform(10.0 * s) for s in t])
    frames = []
    for time, pose in zip(t, poses, strict=True):
        boxes = Boxes.of(["pedestrian", "car"], [[20.0 + time, 45.0, 1.0], [20.0, -8.0, 1.0]])
        ahead = boxes.transformed(inverse_transform(pose))
        frames.append(Frame(time, "lidar", Detections(ahead, np.full(2, 0.9)), np.eye(4), "ego"))
    record = record_epochs(frames, poses, OdometryIncrements.of(t, poses), new_tracker())
    p = stationary_probabilities(record, poses, SlowErrors.at_start(JointSettings(POOR)), JointSettings(POOR))
    middle = record[len(record) // 2]
    says = dict(zip(middle.objects.label, p[len(record) // 2], strict=True))
    assert says["car"] > 0.9
    assert says["pedestrian"] < 0.6


def test_a_car_far_away_is_taken_for_parked_only_beside_cars_that_are():
    """Poor odometry explains its motion; whether the cars nearby creep or stand decides."""

    def far(speed: float) -> float:
        t, rng = 0.2 * np.arange(20), np.random.default_rng(0)
        poses = np.stack([yaw_transform(8.0 * s) for s in t])
        frames = []
        for time, pose in zip(t, poses, strict=True):
            near = [[5.0 + 6 * k + speed * time, 4.0 * (-1) ** k, 1.0] for k in range(6)]
            places = np.array([*near, [60.0 + 0.4 * time, 30.0, 1.0]])
            places[:, :2] += 0.1 * rng.normal(size=(7, 2))
            detections = Detections(Boxes.of(["car"] * 7, places).transformed(inverse_transform(pose)), np.full(7, 0.9))
            frames.append(Frame(time, "lidar", detections, np.eye(4), "ego"))
        settings = JointSettings(POOR)
        record = record_epochs(frames, poses, OdometryIncrements.of(t, poses), new_tracker())
        p = stationary_probabilities(record, poses, SlowErrors.at_start(settings), settings)
        return float(p[10][np.argmax(np.hypot(*record[10].seen.z[:, :2].T))])

    assert far(speed=1.5) < 0.9 < far(speed=0.0)  # below 0.9 no factor holds it in place


def test_a_queue_that_creeps_does_not_pass_for_parked():
    """Ahead, far off, seen for less than a second: a turn of the vehicle explains no motion along the line of sight."""
    t = 0.2 * np.arange(5)
    poses = np.stack([yaw_transform(5.0 * s) for s in t])
    frames = []
    for time, pose in zip(t, poses, strict=True):
        ahead = Boxes.of(["car", "car"], [[45.0 + 1.2 * time, 0.0, 1.0], [8.0, 6.0, 1.0]])
        detections = Detections(ahead.transformed(inverse_transform(pose)), np.full(2, 0.9))
        frames.append(Frame(time, "lidar", detections, np.eye(4), "ego"))
    record, settings = record_epochs(frames, poses, OdometryIncrements.of(t, poses), new_tracker()), JointSettings(POOR)
    slow = SlowErrors.at_start(settings)
    batch, online = (stationary_probabilities(record, poses, slow, settings, online)[-1] for online in (False, True))
    creeps, parked = [int(np.argmin(abs(record[-1].seen.z[:, 1] - y))) for y in (0.0, 6.0)]
    assert batch[creeps] < 0.9
    assert batch[parked] > 0.9
    assert online[creeps] < 0.5
    assert online[parked] > 0.8


def test_nothing_is_said_of_an_object_seen_once():
    frames, odometry, poses, _ = drive(n=1)
    record = record_epochs(frames, poses, odometry, new_tracker())
    assert all(
        (p == 0).all() for p in stationary_probabilities(record, poses, SlowErrors(0.01, 0.01, 0.01), JointSettings())
    )


def test_frames_and_odometry_must_fit():
    frames, odometry, _, _ = drive(n=5)
    with pytest.raises(InputError, match="expected one at each of the 5 times of the odometry, got 4"):
        estimate_jointly(frames[:4], odometry, new_tracker)
    blind = [Frame(f.timestamp, f.sensor, f.detections) for f in frames]
    with pytest.raises(InputError, match="expected a pose, or detections in ego or sensor coordinates"):
        estimate_jointly(blind, odometry, new_tracker)


def test_odometry_is_put_together_and_apart():
    _, odometry, poses, _ = drive(n=12)
    np.testing.assert_allclose(odometry.path(poses[0]), poses, atol=1e-9)
    assert odometry.dt.tolist() == pytest.approx([0.2] * 11)
    P = OdometryNoise().covariances(np.array([4.0]), np.array([0.25]))[0]
    assert P[2, 2] == pytest.approx(0.01**2 * 0.25)
    assert P[3, 3] == pytest.approx(0.03**2 * 4 + 0.01**2 * 0.25)
    with pytest.raises(InputError, match="strictly increasing"):
        OdometryIncrements([0.0, 0.0], np.eye(4)[None])


def test_poles_correct_the_odometry_where_nothing_else_stands():
    frames, odometry, poses, _ = drive(n=25, parked=0, moving=0)
    reported = worse(odometry, np.random.default_rng(2))
    rng = np.random.default_rng(3)
    poles = np.column_stack([np.arange(4.0, 40, 8), np.tile([6.0, -6.0, 7.0], 2)[:5], np.full(5, 1.0)])
    kind, seen = PoleLandmark(), []
    for pose in poses:
        local = (inverse_transform(pose) @ np.column_stack([poles, np.ones(5)]).T).T[:, :3]
        local[:, :2] += rng.normal(0, 0.05, (5, 2))
        seen.append([Observation(kind, z, 0.05**2 * np.eye(2)) for z in local if np.hypot(*z[:2]) < 20])
    estimate = estimate_jointly(frames, reported, new_tracker, JointSettings(POOR), poses[0], seen)
    alone = np.linalg.norm((reported.path(poses[0]) - poses)[:, :2, 3], axis=1)
    joint = np.linalg.norm((estimate.world_T_ego - poses)[:, :2, 3], axis=1)
    assert joint.max() < min(0.2, alone.max() / 3)
    with pytest.raises(InputError, match="landmarks: expected observations at 25 times, got 24"):
        estimate_jointly(frames, reported, new_tracker, landmarks=seen[1:])
