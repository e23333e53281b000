"""Uncertain identity and motion of objects beside a vehicle whose path is estimated."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.sensor import NoiseModel
from saga_fg.model.turning import CoordinatedTurn
from saga_fg.numerics.geometry import inverse_transform, yaw_transform
from saga_fg.slam.joint import JointSettings, OdometryIncrements, OdometryNoise, OnlineEstimator, estimate_jointly
from saga_fg.slam.joint.association import with_identities
from saga_fg.slam.joint.graph import motion_factors, new_streams
from saga_fg.slam.joint.record import RecordedDetections, RecordedEpoch, RecordedObjects, record_epochs
from saga_fg.tracking import AssociationSettings, ClassSettings
from tests.saga_fg.ego_drive import NOISE, drive, new_tracker

POOR = JointSettings(OdometryNoise(scale=0.02, bias=0.005))


def epoch(z: list[list[float]], names: list[int], labels: tuple[str, ...]) -> RecordedEpoch:
    """Detections at `z` of the objects `names`, in order."""
    node_type = NodeType("car", ConstantVelocity())
    objects = RecordedObjects(np.arange(len(labels)), (node_type,) * len(labels), labels)
    places = np.column_stack([z, np.zeros(len(z))])
    R, ones = np.tile(0.01 * np.eye(2), (len(z), 1, 1)), np.ones(len(z))
    seen = RecordedDetections(np.array(names), places, R, ones, np.arange(len(z)))
    return RecordedEpoch(0, 0.0, np.eye(4), objects, seen, None)


def test_a_detection_is_of_the_object_that_it_fits() -> None:
    pose = yaw_transform(5.0, 2.0, 0.0, 0.3)
    places = np.array([[10.0, 0.0], [10.0, 0.5], [10.0, 5.0]]) @ pose[:2, :2].T + pose[:2, 3]
    seen = [[10.0, 0.0], [10.0, 0.25], [10.0, 5.0]]
    p = with_identities(epoch(seen, [0, 1, 2], ("car",) * 3), pose, places, 5000.0).seen.probability
    assert p[0] > 0.75
    assert 0.45 < p[1] < 0.55  # between two
    assert p[2] > 0.999
    others = with_identities(epoch(seen, [0, 1, 2], ("car", "pedestrian", "car")), pose, places, 5000.0)
    assert (others.seen.probability > 0.99).all()  # rivals are of one class
    wrong = with_identities(epoch([[10.0, 5.0]], [0], ("car",) * 3), pose, places, np.inf).seen.probability
    assert wrong[0] == 0.01  # but it is not without information
    clutter = with_identities(epoch([[13.0, 0.0]], [0], ("car",)), pose, places[:1], 5000.0).seen.probability
    assert clutter[0] == 0.01


def test_a_wrong_association_does_not_bend_the_path() -> None:
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

    right, wrong = (estimate_jointly(frames, odometry, new, POOR, poses[0]) for new in (new_tracker, confused))
    off = [np.linalg.norm((one.world_T_ego - poses)[:, :2, 3], axis=1).max() for one in (right, wrong)]
    assert off[1] < off[0] + 0.1
    seen = [now.seen.probability for now in wrong._record]
    assert all((p[:2] < 0.1).all() for p in seen[10:15])
    online = OnlineEstimator(confused(), 3.0, POOR, start=poses[0])
    for k, frame in enumerate(frames):
        step = online.step(frame, odometry.a_T_b[k - 1] if k else None)
    assert np.linalg.norm((step.newest.world_T_ego[-1] - poses[-1])[:2, 3]) < off[0] + 0.3


def test_objects_say_how_probably_they_are_stationary() -> None:
    frames, odometry, poses, cars = drive(parked=6, moving=2)
    estimate = estimate_jointly(frames, odometry, new_tracker, POOR, poses[0])
    middle = estimate.objects[len(poses) // 2]
    nearest = np.linalg.norm(middle.position[:, None] - cars[len(poses) // 2][None], axis=2).argmin(axis=1)
    np.testing.assert_array_equal(middle.stationary > 0.5, nearest < 6)
    online = OnlineEstimator(new_tracker(), 3.0, POOR, start=poses[0])
    for k, frame in enumerate(frames):
        last = online.step(frame, odometry.a_T_b[k - 1] if k else None).newest.objects[-1]
    assert (last.stationary > 0.5).sum() >= 3
    assert (last.stationary[np.hypot(*last.velocity.T) > 3] < 0.1).all()


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
        detections = Detections(boxes.transformed(inverse_transform(pose)), np.full(8, 0.9))
        frames.append(Frame(time, "lidar", detections, np.eye(4), "ego"))
    return frames, OdometryIncrements.of(t, poses), poses


def test_traffic_that_brakes_as_one_does_not_bend_the_path() -> None:
    frames, odometry, poses = convoy(common=1.5)
    record = record_epochs(frames, poses, odometry, new_tracker())
    assert [len(new_streams(now)) for now in record[3:6]] == [1, 1, 1]
    assert len(motion_factors(record[5])) == 8 + 1
    estimate = estimate_jointly(frames, odometry, new_tracker, POOR, poses[0])
    off = np.linalg.norm((estimate.world_T_ego - poses)[:, :2, 3], axis=1)
    assert off.max() < 0.5


def test_nonlinear_motion_is_refused() -> None:
    frames, odometry, poses, _ = drive(n=4, parked=1, moving=1)

    def turning() -> Tracker:
        return Tracker(TrackerSettings({"default": ClassSettings(motion=CoordinatedTurn())}, edges=()))

    with pytest.raises(InputError, match="expected linear motion"):
        estimate_jointly(frames, odometry, turning, POOR, poses[0])
