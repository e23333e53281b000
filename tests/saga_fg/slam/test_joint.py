"""Objects and the vehicle's way in one graph. Path of the vehicle and objects around it, together."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model import CoordinatedTurn, NoiseModel, PoleLandmark
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.slam.joint import (
    JointSettings,
    OdometryIncrements,
    OdometryNoise,
    OnlinePath,
    estimate_jointly,
)
from saga_fg.slam.joint.record import record_epochs, stationary_probabilities
from saga_fg.slam.mapping import LandmarkObservations
from saga_fg.tracking import AssociationSettings, ClassSettings
from saga_fg.types import Observation
from tests.saga_fg.ego_drive import NOISE, drive, new_tracker

POOR = OdometryNoise(scale=0.02, bias=0.005)


def worse(odometry, rng, scale=0.02, bias=-0.004):
    """Increments with a scale error, a turning heading and noise as POOR says."""
    steps = odometry.a_T_b.copy()
    for k, dt in enumerate(odometry.dt):
        steps[k, :3, 3] = (1 + scale) * steps[k, :3, 3] + rng.normal(0, POOR.distance_noise * np.sqrt(6.0 * dt), 3)
        turn = yaw_transform(yaw=bias * dt + rng.normal(0, POOR.turn_noise * np.sqrt(dt)))
        steps[k, :3, :3] = turn[:3, :3] @ steps[k, :3, :3]
    return OdometryIncrements(odometry.timestamps, steps)


def frame_at(time, pose, boxes):
    """What a vehicle sees of boxes of the world."""
    detections = Detections(boxes.transformed(inverse_transform(pose)), np.full(len(boxes), 0.9))
    return Frame(time, "lidar", detections, np.eye(4), "ego")


def off_path(estimate, poses):
    """Distances of estimated poses from the true ones, m."""
    return np.linalg.norm((estimate - poses)[:, :2, 3], axis=1)


def seen_poles(poses, rng, noise=0.05):
    """Provider of observations of five poles, of those near each pose."""
    poles = np.column_stack([np.arange(4.0, 40, 8), np.tile([6.0, -6.0, 7.0], 2)[:5], np.full(5, 1.0)])
    kind, seen = PoleLandmark(), {}
    for k, pose in enumerate(poses):
        local = (inverse_transform(pose) @ np.column_stack([poles, np.ones(5)]).T).T[:, :3]
        local[:, :2] += rng.normal(0, noise, (5, 2))
        R = noise**2 * np.eye(2)
        seen[k] = [(n, Observation(kind, z, R)) for n, z in enumerate(local) if np.hypot(*z[:2]) < 20]
    return LandmarkObservations(seen, dict(enumerate(poles[:, :2] + 1.0)))


@pytest.fixture(scope="module")
def solved():
    frames, odometry, poses, cars = drive()
    reported = worse(odometry, np.random.default_rng(1))
    estimate = estimate_jointly(frames, reported, new_tracker, JointSettings(POOR), poses[0])
    return reported, poses, cars, estimate


def test_objects_that_stand_correct_the_odometry(solved):
    reported, poses, _, estimate = solved
    alone, joint = (off_path(found, poses) for found in (reported.path(poses[0]), estimate.world_T_ego))
    assert estimate.converged
    assert joint.max() < alone.max() / 2
    assert estimate.errors[-1, 0] == pytest.approx(0.02, abs=3 * estimate.slow_errors[0])
    assert estimate.errors[-1, 1] == pytest.approx(-0.004, abs=3 * estimate.slow_errors[1])


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


def test_without_objects_or_with_one_seen_once_the_odometry_remains():
    frames, odometry, poses, _ = drive(n=10, parked=0, moving=0)
    estimate = estimate_jointly(frames, odometry, new_tracker, start=poses[0])
    np.testing.assert_allclose(estimate.world_T_ego, poses, atol=1e-6)
    assert all(len(objects.id) == 0 for objects in estimate.objects)
    frames, odometry, poses, _ = drive(n=1)
    record = record_epochs(frames, poses, odometry, new_tracker())
    assert all(
        (p == 0).all() for p in stationary_probabilities(record, poses, np.array([0.01, 0.01, 0.01]), JointSettings())
    )


def test_what_stands_is_told_from_what_drives():
    frames, odometry, poses, cars = drive(parked=4, moving=2)
    record = record_epochs(frames, poses, odometry, new_tracker())
    p = stationary_probabilities(record, poses, np.array([1e-3, 1e-4, 1e-3]), JointSettings())
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
        frames.append(frame_at(time, pose, boxes))
    record = record_epochs(frames, poses, OdometryIncrements.of(t, poses), new_tracker())
    p = stationary_probabilities(record, poses, POOR.slow, JointSettings(POOR))
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
            frames.append(frame_at(time, pose, Boxes.of(["car"] * 7, places)))
        settings = JointSettings(POOR)
        record = record_epochs(frames, poses, OdometryIncrements.of(t, poses), new_tracker())
        p = stationary_probabilities(record, poses, settings.odometry.slow, settings)
        return float(p[10][np.argmax(np.hypot(*record[10].seen.z[:, :2].T))])

    assert far(speed=1.5) < 0.9 < far(speed=0.0)  # below 0.9 no factor holds it in place


def test_a_queue_that_creeps_does_not_pass_for_parked():
    """Ahead, far off, seen for less than a second: a turn of the vehicle explains no motion along the line of sight."""
    t = 0.2 * np.arange(5)
    poses = np.stack([yaw_transform(5.0 * s) for s in t])
    frames = []
    for time, pose in zip(t, poses, strict=True):
        frames.append(frame_at(time, pose, Boxes.of(["car"] * 2, [[45.0 + 1.2 * time, 0.0, 1.0], [8.0, 6.0, 1.0]])))
    record, settings = record_epochs(frames, poses, OdometryIncrements.of(t, poses), new_tracker()), JointSettings(POOR)
    batch = stationary_probabilities(record, poses, settings.odometry.slow, settings)[-1]
    creeps, parked = [int(np.argmin(abs(record[-1].seen.z[:, 1] - y))) for y in (0.0, 6.0)]
    assert batch[creeps] < 0.9
    assert batch[parked] > 0.9


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
    seen = seen_poles(poses, np.random.default_rng(3))
    estimate = estimate_jointly(frames, reported, new_tracker, JointSettings(POOR), poses[0], lambda: [seen])
    alone, joint = (off_path(found, poses) for found in (reported.path(poses[0]), estimate.world_T_ego))
    assert joint.max() < min(0.2, alone.max() / 3)


SETTINGS = JointSettings(POOR)


def driven_online(frames, reported, poses, settings):
    """The estimator after the frames, its poses, and whether it stepped aside at each."""
    online, found = OnlinePath(new_tracker(), settings, poses[0]), []
    stated = [None] * len(frames) if reported.covariances is None else [None, *reported.covariances]
    for k, frame in enumerate(frames):
        tracks = online.step(frame, reported.a_T_b[k - 1] if k else np.eye(4), stated[k])
        found.append((online.world_T_ego, online.aside))
    assert len(tracks) > 4
    return online, np.stack([pose for pose, _ in found]), np.array([aside for _, aside in found])


def turned_by(frames, angle):
    """Frames with detections that are turned about the vehicle, angle(t) rad."""
    return [
        replace(frame, detections=frame.detections.transformed(yaw_transform(yaw=angle(frame.timestamp))))
        for frame in frames
    ]


def test_slow_errors_of_the_odometry_are_found_online(caplog):
    frames, odometry, poses, _ = drive()
    reported = worse(odometry, np.random.default_rng(1))
    online, path, aside = driven_online(frames, reported, poses, SETTINGS)
    assert not aside.any()
    assert not caplog.messages
    assert off_path(path, poses).max() < 0.7 * off_path(reported.path(poses[0]), poses).max()
    deviations = online.covariance.diagonal() ** 0.5
    np.testing.assert_array_less(np.abs(online.errors[:2] - [0.02, -0.004]), 3 * deviations[:2])


def test_invalid_motions_are_refused_and_no_loss_is_a_setting():
    frames, odometry, poses, _ = drive(n=5)
    plain = replace(SETTINGS, outlier_scale=np.inf)
    online, path, _ = driven_online(frames[:4], odometry, poses, plain)
    with pytest.raises(InputError, match=r"a_T_b.*expected a finite number"):
        online.step(frames[4], np.full((4, 4), np.nan))
    with pytest.raises(InputError, match=r"covariance\[0\]: expected a positive definite matrix"):
        online.step(frames[4], np.eye(4), np.zeros((6, 6)))
    assert np.isfinite(path).all()


def test_objects_that_contradict_the_odometry_leave_it_as_it_is(caplog):
    """Odometry is exact, and what seems parked drifts as no odometry of such noise would make it."""
    frames, odometry, poses, _ = drive(moving=0)
    sure = JointSettings(OdometryNoise(scale=0.005, bias=0.001, course=0.001, course_drift=1e-5))
    turned = turned_by(frames, lambda t: 0.01 * t)
    _, path, aside = driven_online(turned, odometry, poses, sure)
    assert aside[-1]
    assert len(caplog.messages) == (np.diff(aside.astype(int)) > 0).sum()
    assert "stationary objects contradict its noise" in caplog.text
    steps = inverse_transform(path[:-1]) @ path[1:]
    np.testing.assert_allclose(steps[aside[:-1]], odometry.a_T_b[aside[:-1]], atol=1e-9)


def test_the_path_comes_back_from_the_odometry_when_objects_stand_again(monkeypatch):
    monkeypatch.setattr("saga_fg.slam.joint.online.LAG", 3.0)
    frames, odometry, poses, _ = drive(n=45, parked=10, moving=0)
    sure = JointSettings(OdometryNoise(scale=0.005, bias=0.001, course=0.001))
    _, _, aside = driven_online(turned_by(frames, lambda t: 0.02 * max(0.0, min(t, 6.0 - t))), odometry, poses, sure)
    assert aside.any()
    assert not aside[40:].any()


def test_frames_between_keyframes_are_tracked_alone():
    """Four times as many frames tell the same errors, and the path follows each of them."""
    frames, odometry, poses, _ = drive(n=81, dt=0.05)
    reported = worse(odometry, np.random.default_rng(1))
    stated = np.tile(np.diag([1e-6, 1e-6, 1e-5, 1e-3, 1e-3, 1e-3]), (80, 1, 1))
    every, path, _ = driven_online(frames, replace(reported, covariances=stated), poses, SETTINGS)
    thinned = OdometryIncrements.of(reported.timestamps[::4], reported.path(poses[0])[::4])
    thinned = replace(thinned, covariances=4 * stated[::4])
    fewer, _, _ = driven_online(frames[::4], thinned, poses, SETTINGS)
    np.testing.assert_allclose(every.covariance.diagonal(), fewer.covariance.diagonal(), rtol=0.05)
    np.testing.assert_allclose(every.errors, fewer.errors, atol=0.1 * fewer.covariance.diagonal().max() ** 0.5)
    assert off_path(path, poses).max() < off_path(reported.path(poses[0]), poses).max()


def test_a_pause_without_objects_leaves_the_errors_to_their_random_walk():
    frames, odometry, poses, _ = drive(n=20)
    online, _, _ = driven_online(frames, odometry, poses, SETTINGS)
    errors, before = online.errors, online.covariance
    pause = 30.0
    online.step(Frame(frames[-1].timestamp + pause, "lidar", Detections.empty(), np.eye(4), "ego"), np.eye(4))
    np.testing.assert_allclose(online.errors, errors)
    np.testing.assert_allclose(online.covariance, before + np.diag([0.002, 0.0005, 0.0003]) ** 2 * pause, rtol=1e-6)


# Uncertain identity and motion of objects beside a vehicle whose path is estimated


def test_a_wrong_association_does_not_bend_the_path():
    """Two parked cars in one line are taken for each other for a second, as if both had jumped."""
    frames, odometry, poses, _ = drive(n=40, parked=6, moving=0)

    class Confused(Tracker):
        """Exchanges the two first objects for five frames."""

        @property
        def assignment(self):  # type: ignore[no-untyped-def]
            found = super().assignment
            ids = found.id.copy()
            if 10 <= self._count < 15:
                a, b = (np.flatnonzero(found.id == name) for name in np.unique(found.id)[:2])
                ids[a], ids[b] = found.id[b], found.id[a]
            return replace(found, id=ids)

        def step(self, frame: Frame):  # type: ignore[no-untyped-def]
            self._count = getattr(self, "_count", -1) + 1
            return super().step(frame)

    def confused() -> Tracker:
        noise = {"default": NoiseModel(position=NOISE)}
        settings = TrackerSettings(
            {"default": ClassSettings()}, edges=(), association=AssociationSettings(clutter_area=5000.0)
        )
        return Confused(settings, {"default": Sensor(noise=noise)})

    right, wrong = (estimate_jointly(frames, odometry, new, SETTINGS, poses[0]) for new in (new_tracker, confused))
    off = [off_path(one.world_T_ego, poses).max() for one in (right, wrong)]
    assert off[1] < off[0] + 0.1


def test_objects_say_how_probably_they_are_stationary():
    frames, odometry, poses, cars = drive(parked=6, moving=2)
    estimate = estimate_jointly(frames, odometry, new_tracker, SETTINGS, poses[0])
    middle = estimate.objects[len(poses) // 2]
    nearest = np.linalg.norm(middle.position[:, None] - cars[len(poses) // 2][None], axis=2).argmin(axis=1)
    np.testing.assert_array_equal(middle.stationary > 0.5, nearest < 6)


def convoy(common: float, n: int = 40) -> tuple[list[Frame], OdometryIncrements, np.ndarray]:
    """Frames of a vehicle at constant speed and of eight cars ahead that all brake with `common`, m/s^2."""
    t, rng = 0.2 * np.arange(n), np.random.default_rng(0)
    poses = np.stack([yaw_transform(15.0 * s) for s in t])
    frames = []
    for time, pose in zip(t, poses, strict=True):
        x = np.linspace(15, 60, 8) + 15 * time - common * time**2 / 2
        places = np.column_stack([x, np.tile([-3.5, 0.0, 3.5, 7.0], 2), np.ones(8)])
        places[:, :2] += NOISE * rng.normal(size=(8, 2))
        boxes = Boxes.of(["car"] * 8, places, np.tile([4.0, 2, 1.5], (8, 1)), np.zeros(8))
        frames.append(frame_at(time, pose, boxes))
    return frames, OdometryIncrements.of(t, poses), poses


def test_traffic_that_brakes_as_one_bends_the_path_no_more_than_its_deviation():
    frames, odometry, poses = convoy(common=1.5)
    estimate = estimate_jointly(frames, odometry, new_tracker, SETTINGS, poses[0])
    sigma = np.sqrt(np.trace(estimate.pose_covariances[-1][3:5, 3:5]))
    assert off_path(estimate.world_T_ego, poses)[-1] < min(2 * sigma, 1.0)


def test_nonlinear_motion_takes_part():
    frames, odometry, poses, cars = drive(n=8, parked=1, moving=1)

    def turning() -> Tracker:
        return Tracker(TrackerSettings({"default": ClassSettings(motion=CoordinatedTurn())}, edges=()))

    estimate = estimate_jointly(frames, odometry, turning, SETTINGS, poses[0])
    off = np.linalg.norm(estimate.objects[-1].position[:, None] - cars[-1], axis=2).min(axis=1)
    assert len(off) == 2
    assert off.max() < 0.5
