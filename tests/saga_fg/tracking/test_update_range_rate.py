"""Range rates: one component of the velocity, taken in alike by every estimator, refused where it has no meaning."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Boxes, Detection, Detections, Frame, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import Extrinsics, NoiseModel
from saga_fg.numerics.geometry import yaw_transform
from tests.saga_fg.traffic_frames import at_pose, frame, straight, turning_vehicle

NAN = float("nan")
RADAR = Sensor(noise={"default": NoiseModel(position=0.5, range_rate=0.1)})
SENSORS = {"radar": RADAR, "lidar": Sensor(noise={"default": NoiseModel(position=0.3)})}
TRUTH = straight([(30, 5), (-15, 30), (40, -20)], [(12, 0), (3, -9), (0, 6)])
VELOCITY = TRUTH(1) - TRUTH(0)


def with_rates(plain, rate, pose=None):
    detections = replace(plain.detections, range_rate=rate)
    return Frame(plain.timestamp, plain.sensor, detections, np.eye(4) if pose is None else pose)


def radar_frame(timestamp, position, rate, pose=None, **fields):
    return with_rates(frame(timestamp, position, "radar", size=(NAN,) * 3, yaw=NAN, **fields), rate, pose)


def traffic(seed):
    """A radar on a moving vehicle and a LiDAR, in order of time."""
    rng = np.random.default_rng(seed)
    frames = []
    for t in np.arange(0, 3, 0.1):
        where = TRUTH(t)
        pose = turning_vehicle(t)
        sight = where - pose[:2, 3]
        rate = np.sum(VELOCITY * sight, axis=1) / np.hypot(*sight.T) + 0.1 * rng.normal(size=3)
        frames.append(radar_frame(t, where + 0.5 * rng.normal(size=(3, 2)), rate, pose))
        frames.append(frame(t + 0.04, where + 0.04 * VELOCITY + 0.3 * rng.normal(size=(3, 2))))
    return frames


def tracker(estimator="kalman", sensors=SENSORS):
    return Tracker(TrackerSettings(estimator=estimator), sensors)


def test_a_new_track_takes_the_component_along_the_line_of_sight():
    tracks = tracker().step(radar_frame(0.0, [(30, 40)], [10.0]))
    sight = np.array([0.6, 0.8])
    assert tracks.boxes.velocity[0] == pytest.approx(10.0 * sight, abs=0.05)
    across = np.array([-0.8, 0.6])
    P = tracks.velocity_covariance[0]
    assert sight @ P @ sight < 0.2**2
    assert across @ P @ across > 1.0


def test_the_line_of_sight_begins_at_the_sensor():
    mounted = replace(RADAR, extrinsics=Extrinsics(x=10.0))
    pose = yaw_transform(100.0, 0.0, 0.0, np.pi / 2)  # the sensor is at (100, 10)
    tracks = tracker(sensors={"radar": mounted}).step(radar_frame(0.0, [(130, 10)], [7.0], pose))
    assert tracks.boxes.velocity[0] == pytest.approx([7.0, 0.0], abs=0.05)


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_every_estimator_gives_the_same_tracks(estimator):
    reference, other = tracker(), tracker(estimator)
    for f in traffic(0):
        first, second = reference.step(f), other.step(f)
        assert first.id.tolist() == second.id.tolist()
        assert second.boxes.position == pytest.approx(first.boxes.position, abs=1e-8)
        assert second.boxes.velocity == pytest.approx(first.boxes.velocity, abs=1e-8)
        assert second.velocity_covariance == pytest.approx(first.velocity_covariance, rel=1e-7, abs=1e-8)


def test_velocities_are_consistent_and_better_than_without():
    deaf = {**SENSORS, "radar": replace(RADAR, use_velocity=False)}
    errors, without, surprise = [], [], []
    for seed in range(8):
        hearing, not_hearing = tracker(), tracker(sensors=deaf)
        for f in traffic(seed):
            last, other = hearing.step(f), not_hearing.step(f)
            if f.timestamp > 0.5 and len(last) == len(other) == 3:
                errors.append(last.boxes.velocity - VELOCITY)
                without.append(other.boxes.velocity - VELOCITY)
                surprise.append(
                    np.einsum("ni,nij,nj->n", errors[-1], np.linalg.inv(last.velocity_covariance), errors[-1])
                )
    assert len(errors) > 300
    assert np.sqrt(np.mean(np.square(errors))) < 0.8 * np.sqrt(np.mean(np.square(without)))
    assert np.mean(surprise) < 3.0  # 2 in a model that is right; the objects here keep their velocities


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_a_late_range_rate_is_taken_in(estimator):
    t = Tracker(TrackerSettings(estimator=estimator, edges=(), max_delay=0.5, lag=1.0), SENSORS)
    for time in (0.0, 0.2, 0.4):
        before = t.step(frame(time, [(30, 40)]))
    after = t.step(radar_frame(0.3, [(30, 40)], [-2.0]))
    sight = np.array([0.6, 0.8])
    assert abs(after.boxes.velocity[0] @ sight + 2.0) < abs(before.boxes.velocity[0] @ sight + 2.0)
    assert sight @ after.velocity_covariance[0] @ sight < sight @ before.velocity_covariance[0] @ sight


def test_an_object_at_the_sensor_itself_keeps_its_velocity():
    tracks = tracker().step(radar_frame(0.0, [(0, 0)], [9.0]))
    assert tracks.boxes.velocity[0].tolist() == [0.0, 0.0]


def test_detections_carry_range_rates_through_selection_and_transformation():
    table = Detections.of([Detection("car", (1, 0, 0), range_rate=-3.0), Detection("car", (2, 0, 0))])
    assert np.isnan(table.range_rate).tolist() == [False, True]
    assert table.select([1, 0]).transformed(yaw_transform(5, 5, 0, 1.0)).range_rate[1] == -3.0
    assert table[0].range_rate == -3.0
    ego = at_pose(Frame(0.0, "radar", table, np.eye(4)), turning_vehicle(1.0), "ego")
    assert ego.detections.range_rate[0] == -3.0


def test_wrong_range_rates_are_refused(subtests):
    for rate, message in [
        (np.inf, r"range_rate\[0\]: expected a finite number, or NaN for unknown, got inf"),
        ("fast", "range_rate: expected numbers"),
        ([1.0, 2.0], r"range_rate: expected shape \(1,\), got \(2,\)"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            Detections(Boxes.of(["car"], [(0, 0, 0)]), [0.5], rate if isinstance(rate, list) else [rate])


def test_a_range_rate_needs_to_be_seen_from_somewhere():
    table = Detections.of([Detection("car", (1, 0, 0), range_rate=1.0)])
    with pytest.raises(InputError, match="world_T_ego: expected a pose, since range_rate is along the line of sight"):
        Frame(0.0, "radar", table)
    with pytest.raises(InputError, match="range_rate: expected a finite number > 0"):
        NoiseModel(range_rate=0.0)
