"""Shipped factor providers in a running graph: they err as they say, and refuse what makes no sense."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from saga_fg import ConstantVelocity, Detection, Detections, Frame, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import (
    EGO_BIAS,
    EGO_POSE,
    EGO_VELOCITY,
    LANDMARK,
    MAP_NODE,
    GraphError,
)
from saga_fg.model.landmarks import PointLandmark
from saga_fg.model.sensor import NoiseModel
from saga_fg.providers import Gps, Imu, Landmarks, LaneKeeping, Odometry, StartSettings
from saga_fg.providers.vehicle_sensors import GRAVITY
from saga_fg.tracking import ClassSettings
from saga_fg.types.frame import EgoMeasurements, GpsFix, ImuSamples, Observation, OdometryIncrement
from saga_fg.types.road_map import Lane

DT = 0.1
START = (5.0, -3.0, 0.4)
Pose = gtsam.Pose2 | gtsam.Pose3


def frame(k: int, ego: EgoMeasurements | None) -> Frame:
    return Frame(DT * k, "ego", Detections.empty(), ego=ego)


def now(smoother: IncrementalSmoother, kind: Any) -> int:
    return smoother.graph().of(kind, smoother.graph().epoch)[0].key


def nees(smoother: IncrementalSmoother, key: int, truth: Any) -> float:
    """Normalised squared error per dimension."""
    kind = smoother.graph().variable(key).type
    e = kind.local(smoother.state(key), truth)
    return float(e @ np.linalg.solve(smoother.covariance(key), e)) / len(e)


def drawn(rng: np.random.Generator, mean: Pose, covariance: np.ndarray) -> Pose:
    return mean.retract(rng.multivariate_normal(np.zeros(len(covariance)), covariance))


def first(planar: bool, start: StartSettings) -> Pose:
    pose = gtsam.Pose3(start.transform(None))
    return gtsam.Pose2(pose.x(), pose.y(), pose.rotation().yaw()) if planar else pose


@pytest.mark.parametrize("planar", [True, False])
def test_odometry_gps_and_landmarks_err_as_they_say(planar):
    start = StartSettings(START, 0.5, 0.1, 0.03, planar)
    sigmas = [0.05, 0.03, 0.01] if planar else [0.005, 0.005, 0.01, 0.05, 0.03, 0.03]
    P = [0.25, 0.25, 0.01] if planar else [0.0009, 0.0009, 0.01, 0.25, 0.25, 0.25]
    C, d = np.diag(np.square(sigmas)), 2 if planar else 3
    step = gtsam.Pose2(1.0, 0.0, 0.05) if planar else gtsam.Pose3(gtsam.Rot3.Ypr(0.05, 0.01, 0.0), [1.0, 0.0, 0.1])
    post, scores, place_scores = np.array([12.0, 4.0, 1.0])[:d], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        smoother = IncrementalSmoother([Odometry(start), Gps(gate=1), Landmarks()])
        pose = drawn(rng, first(planar, start), np.diag(P))
        for k in range(15):
            odometry = None
            if k:
                pose = pose.compose(step)
                odometry = OdometryIncrement(drawn(rng, step, C).matrix(), DT, C)
            gps = GpsFix(pose.translation() + rng.normal(0, 1, d), np.eye(d)) if k % 5 == 4 else None
            seen = Observation(PointLandmark(d), pose.transformTo(post) + rng.normal(0, 0.2, d), 0.04 * np.eye(d))
            smoother.step(DT * k, frame=frame(k, EgoMeasurements(odometry, gps, None, {3: seen})))
        scores.append(nees(smoother, now(smoother, EGO_POSE), pose))
        place_scores.append(nees(smoother, smoother.graph().of(LANDMARK, None)[3].key, post))
    assert 0.4 < np.mean(scores) < 1.7, scores
    assert 0.3 < np.mean(place_scores) < 2.2, place_scores
    assert [str(one) for one in smoother.graph().variables.values()] == ["point 3", "vehicle 0 at 1.40 s"]


def test_inertial_samples_find_velocity_and_biases():
    start = StartSettings((0.0, 0.0, 0.0), 0.1, 0.05, 0.02, planar=False)
    imu, h = Imu(start, start_velocity_deviation=1.0), 0.02
    scores = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        P = np.square([0.02, 0.02, 0.05, 0.1, 0.1, 0.1])
        pose, velocity = drawn(rng, gtsam.Pose3(), np.diag(P)), rng.normal(0, 1.0, 3)
        bias = np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, 0.01, 3)])
        smoother = IncrementalSmoother([imu, Gps(0.1, 0.1, gate=1)])
        for k in range(60):
            samples = []
            for i in range(5 if k else 0):
                a = np.array([np.cos(0.3 * k + i / 20), np.sin(0.2 * k), 0.0])
                w = np.array([0.0, 0.0, 0.5 * np.cos(0.1 * k)])
                force = pose.rotation().matrix().T @ (a + np.array([0.0, 0.0, GRAVITY]))
                noise = rng.normal(size=6) * np.repeat([imu.accelerometer_noise, imu.gyroscope_noise], 3) / np.sqrt(h)
                samples.append(np.concatenate([force, w]) + bias + noise)
                moved = pose.translation() + h * velocity + 0.5 * h * h * a
                pose, velocity = gtsam.Pose3(pose.rotation().compose(gtsam.Rot3.Expmap(h * w)), moved), velocity + h * a
            said = np.array(samples)
            ego = EgoMeasurements(
                gps=GpsFix(pose.translation() + rng.normal(0, 0.1, 3)),
                imu=ImuSamples(np.full(5, h), said[:, :3], said[:, 3:]) if k else None,
            )
            smoother.step(DT * k, frame=frame(k, ego))
        truths = {EGO_POSE: pose, EGO_VELOCITY: velocity, EGO_BIAS: gtsam.imuBias.ConstantBias(bias[:3], bias[3:])}
        scores.append([nees(smoother, now(smoother, kind), truth) for kind, truth in truths.items()])
    assert (np.abs(np.log(np.mean(scores, axis=0))) < np.log(3)).all(), scores
    spread = np.sqrt(np.diag(smoother.covariance(now(smoother, EGO_BIAS))))
    assert (spread < [0.095, 0.095, 0.03, 0.0095, 0.0095, 0.0095]).all(), spread


def test_a_vehicle_without_samples_goes_straight_on():
    imu = Imu(StartSettings((0.0, 0.0, 0.3), planar=False), start_velocity=(4.0, 1.0, 0.0))
    smoother = IncrementalSmoother([imu])
    for k in range(11):
        smoother.step(DT * k, frame=frame(k, None))
    pose = smoother.state(now(smoother, EGO_POSE))
    assert pose.translation() == pytest.approx([4.0, 1.0, 0.0], abs=1e-6)  # type: ignore[attr-defined]
    assert pose.rotation().yaw() == pytest.approx(0.3, abs=1e-9)  # type: ignore[attr-defined]
    assert np.sqrt(smoother.covariance(now(smoother, EGO_VELOCITY))[0, 0]) > 3.0


def test_an_increment_is_shared_out_over_the_epochs_it_covers():
    step, C = gtsam.Pose2(2.0, 0.1, 0.3), np.diag([0.04, 0.01, 1e-4])
    ends = []
    for epochs in (1, 4):
        smoother = IncrementalSmoother([Odometry(StartSettings((0.0, 0.0, 0.0), 1e-4, 1e-4))])
        smoother.step(0.0)
        for k in range(epochs):
            measured = EgoMeasurements(OdometryIncrement(step.matrix(), 0.4, C))
            smoother.step(0.4 * (k + 1) / epochs, frame=frame(k, measured))
        key = now(smoother, EGO_POSE)
        ends.append((smoother.state(key), smoother.covariance(key)))
    assert ends[0][0].localCoordinates(step) == pytest.approx(np.zeros(3), abs=1e-9)  # type: ignore[attr-defined]
    assert ends[1][0].localCoordinates(step) == pytest.approx(np.zeros(3), abs=1e-9)  # type: ignore[attr-defined]
    assert np.sqrt(np.diag(ends[1][1])) == pytest.approx(np.sqrt(np.diag(ends[0][1])), rel=0.25)


def test_a_fix_far_off_is_gated_or_given_up(subtests):
    for gps, heeds in [(Gps(), False), (Gps(gate=1), True), (Gps(gate=1, outlier_scale=2), False)]:
        with subtests.test(gps=gps, heeds=heeds):
            smoother = IncrementalSmoother([Odometry(StartSettings((0.0, 0.0, 0.0))), gps])
            for k in range(8):
                off = 60.0 if k == 7 else 0.0
                still = OdometryIncrement(np.eye(3), DT, 0.01 * np.eye(3))
                smoother.step(DT * k, frame=frame(k, EgoMeasurements(still if k else None, GpsFix([off, 0.0]))))
            assert (abs(smoother.state(now(smoother, EGO_POSE)).x()) > 1.0) == heeds  # type: ignore[attr-defined]


def test_the_antenna_says_where_the_vehicle_points():
    smoother = IncrementalSmoother([Odometry(StartSettings((0.0, 0.0, 0.0))), Gps(0.01, antenna=(2.0, 0.0, 1.5))])
    smoother.step(0.0, frame=frame(0, EgoMeasurements(gps=GpsFix([2.0, 0.0]))))
    loose = IncrementalSmoother([Odometry(StartSettings((0.0, 0.0, 0.0))), Gps(0.01)])
    loose.step(0.0, frame=frame(0, EgoMeasurements(gps=GpsFix([0.0, 0.0]))))
    heading, known = (s.covariance(now(s, EGO_POSE)) for s in (smoother, loose))
    assert known[2, 2] == pytest.approx(0.01)
    assert heading[1, 2] < -1e-3, "the place hangs on the heading"


IMU = ImuSamples([0.1], [[0, 0, 9.81]], [[0, 0, 0]])
LEFT_HANDED = np.diag([1.0, -1.0, 1.0])


def test_measurements_and_settings_that_make_no_sense(subtests):
    for make, message in [
        (lambda: GpsFix([np.nan, 0.0]), r"gps\[0\]: expected a finite number, got nan"),
        (lambda: GpsFix([1.0]), "gps: expected a place of 2 or 3 coordinates, got 1"),
        (lambda: GpsFix([1.0, 2.0], -np.eye(2)), r"gps: covariance\[0\]: expected a positive definite matrix"),
        (lambda: OdometryIncrement(np.eye(2), 0.1), "odometry: expected a 3 x 3 or 4 x 4 transform, got shape"),
        (lambda: OdometryIncrement(LEFT_HANDED, 0.1), "odometry: expected a rigid transform"),
        (lambda: OdometryIncrement(np.eye(3), 0.0), "odometry: dt: expected a finite number of seconds > 0, got 0.0"),
        (lambda: OdometryIncrement(np.eye(3), 0.1, np.zeros((3, 3))), "odometry: covariance.*positive definite"),
        (lambda: ImuSamples([], np.empty((0, 3)), np.empty((0, 3))), "imu: expected at least one sample, got none"),
        (lambda: ImuSamples([0.1], [[0, 0]], [[0, 0, 0]]), r"imu: acceleration: expected shape \(1, 3\)"),
        (lambda: ImuSamples([-0.1], [[0, 0, 9]], [[0, 0, 0]]), r"imu: dt\[0\]: expected a number of seconds > 0"),
        (lambda: ImuSamples([0.1], [[0, 0, 9]], [[0, np.inf, 0]]), "imu: angular_rate.*expected a finite number"),
        (lambda: EgoMeasurements(gps=(1.0, 2.0)), "gps: expected GpsFix, got tuple"),
        (lambda: EgoMeasurements(landmarks=[3]), "landmarks: expected Observations by the ids"),
        (lambda: Frame(0.0, "s", Detections.empty(), ego="gps"), "ego: expected EgoMeasurements, got str"),
        (lambda: Gps(deviation=0.0), "deviation: expected a finite number > 0"),
        (lambda: Gps(gate=2.0), "gate: expected a number from 0 to 1"),
        (lambda: Odometry(place_drift=np.nan), "place_drift: expected a finite number > 0"),
        (lambda: Imu(StartSettings()), "start.planar: expected false"),
        (lambda: StartSettings((0.0, np.nan, 0.0)), "place: expected finite numbers"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            make()


SPACE = StartSettings((0.0, 0.0, 0.0), planar=False)


def test_what_does_not_fit_is_one_error_and_the_smoother_goes_on(subtests):
    for providers, ego, message in [
        (
            [Odometry()],
            EgoMeasurements(OdometryIncrement(np.eye(4), 0.1)),
            "provider odometry: odometry: expected a 3 x 3 transform, as poses are, got 4 x 4",
        ),
        (
            [Odometry(SPACE)],
            EgoMeasurements(OdometryIncrement(np.eye(3), 0.1)),
            "provider odometry: odometry: expected a 4 x 4 transform, as poses are, got 3 x 3",
        ),
        (
            [Odometry(SPACE), Gps()],
            EgoMeasurements(gps=GpsFix([1.0, 2.0])),
            "provider gps: gps: expected a place of 3 coordinates, as poses are in space, got 2",
        ),
        ([Odometry(), Imu()], EgoMeasurements(imu=IMU), "provider imu: imu: expected the vehicle's pose in space"),
        (
            [Odometry(), Landmarks()],
            EgoMeasurements(landmarks={1: Observation(PointLandmark(3), [1.0, 2.0, 0.0], np.eye(3))}),
            "provider landmarks: ",
        ),
    ]:
        with subtests.test(message):
            smoother = IncrementalSmoother(providers)
            smoother.step(0.0)
            with pytest.raises(GraphError, match=message):
                smoother.step(DT, frame=frame(1, ego))
            assert smoother.time == 0.0
            if ego.imu is None:
                smoother.step(DT, frame=frame(1, replace(ego, odometry=None, gps=None, landmarks={})))
                assert smoother.time == DT


def test_vehicles_keep_to_a_lane_that_the_map_has_too_far_left():
    """The map is off by 0.6 m: three cars that are seen well tell so, and a fourth, seen badly, is held to the lane."""
    lane = Lane("main", ((100.0, 50.6), (400.0, 50.6)), 4.0)
    settings = TrackerSettings(estimator="isam2", edges=(), classes={"default": ClassSettings(motion=STEADY)})
    sensors = {"sharp": Sensor(noise={"default": NoiseModel(position=0.1)})}
    sensors["dull"] = Sensor(noise={"default": NoiseModel(position=2.0)}, use_velocity=False)
    off = {}
    for providers in ((), (LaneKeeping((lane,), deviation=0.3, map_deviation=1.0),)):
        rng = np.random.default_rng(2)
        tracker = Tracker(settings, sensors, providers=providers)
        for k in range(60):
            cars = np.stack([110 + 0.8 * k + 30 * np.arange(4.0), np.full(4, 50.0)], axis=1)
            tracker.step(seen_at(0.1 * k, "sharp", cars[:3] + rng.normal(0, 0.1, (3, 2))))
            tracks = tracker.step(seen_at(0.1 * k, "dull", cars[3:] + rng.normal(0, 1.0, (1, 2))))
        off[len(providers)] = np.abs(tracks.boxes.position[:, 1] - 50.0)
    assert off[1][3] < 0.5 * off[0][3]
    assert off[1][:3].max() < 0.15
    graph = tracker.snapshot().joint[0].graph
    (line,) = graph.of(MAP_NODE, None).values()
    assert str(line) == "lane main 0"
    assert graph.state(line.key) == pytest.approx([-0.6], abs=0.15)


STEADY = ConstantVelocity(acceleration_noise=0.2)


def seen_at(time: float, sensor: str, places: np.ndarray) -> Frame:
    return Frame(time, sensor, Detections.of([Detection("car", (x, y, 0.8), score=0.9) for x, y in places]))
