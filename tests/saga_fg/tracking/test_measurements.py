"""Measurements of a frame: in which frame, how certain, and with the vehicle's own node."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import (
    Boxes,
    ConstantAcceleration,
    ConstantVelocity,
    Detection,
    Detections,
    Frame,
    InputError,
    Sensor,
    Tracker,
    TrackerSettings,
)
from saga_fg.model.edge_rules import Following
from saga_fg.model.nonlinear_interactions import SmoothDriver
from saga_fg.model.sensor import NoiseModel
from saga_fg.numerics.arrays import common_numbers
from saga_fg.numerics.geometry import inverse_transform, yaw_transform
from saga_fg.providers import Gps, Odometry, StartSettings
from saga_fg.tracking import AssociationSettings, ClassSettings, EgoNodeSettings
from saga_fg.tracking.measurements import suppress_duplicates
from saga_fg.types.frame import EgoMeasurements, GpsFix, OdometryIncrement
from tests.saga_fg.traffic_frames import at_pose, frame, seen, straight, turning_vehicle


def kept(x, probability, distance=1.0, label="car", shadow=0.0):
    n = len(x)
    boxes = Boxes.of(np.broadcast_to(label, n), np.stack([x, np.zeros(n), np.zeros(n)], axis=-1))
    near, wide = (np.broadcast_to(d, n).astype(float) for d in (distance, shadow))
    (group,) = common_numbers(boxes.label)
    into = suppress_duplicates(boxes, np.asarray(probability), near, wide, group)
    assert (into[into] == into).all()
    return np.flatnonzero(into == np.arange(n)).tolist()


@pytest.mark.parametrize(
    ("x", "probability", "options", "expected"),
    [
        ([], [], {}, []),
        ([0.0], [1.0], {}, [0]),
        ([0.0, 0.5, 5.0], [0.4, 0.9, 0.1], {}, [1, 2]),
        ([0.0, 0.5], [0.9, 0.9], {}, [0]),
        ([0.0, 0.8, 1.6], [0.9, 0.8, 0.7], {}, [0, 2]),  # what is suppressed suppresses nothing
        ([0.0, 0.8, 1.6], [0.7, 0.9, 0.8], {}, [1]),
        ([0.0, 0.1], [0.9, 0.8], {"label": ["car", "pedestrian"]}, [0, 1]),
        ([0.0, 0.0], [0.9, 0.8], {"distance": 0.0}, [0, 1]),
        ([0.0, 0.5], [0.9, 0.8], {"distance": 0.5}, [0, 1]),
        ([0.0, 1.5, 9.0], [0.9, 0.4, 0.1], {"shadow": 2.0}, [0, 2]),
        ([0.0, 1.5], [0.9, 0.5], {"shadow": 2.0}, [0, 1]),  # as strong as a second object
        ([0.0, 2.5], [0.9, 0.4], {"shadow": 2.0}, [0, 1]),
        ([0.0, 0.5], [0.9, 0.8], {"shadow": 2.0}, [0]),
    ],
)
def test_the_weaker_of_two_goes(x, probability, options, expected):
    assert kept(x, probability, **options) == expected


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_what_stays_is_apart_and_what_goes_was_beaten(seed, n):
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, 4, (n, 3))
    probability = rng.permutation(n) / n
    label = rng.choice(["car", "bus"], n)
    distance = np.where(label == "car", 1.0, 1.5)
    (group,) = common_numbers(label)
    into = suppress_duplicates(Boxes.of(label, position), probability, distance, np.zeros(n), group)
    stays = np.flatnonzero(into == np.arange(n))
    apart = np.hypot(*np.moveaxis(position[:, None, :2] - position[None, :, :2], -1, 0))
    rival = (label[:, None] == label) & (apart < distance[:, None]) & ~np.eye(n, dtype=bool)
    assert (np.diff(stays) > 0).all()
    assert not rival[np.ix_(stays, stays)].any()
    for k in np.setdiff1d(np.arange(n), stays):
        assert rival[k, into[k]]
        assert probability[into[k]] > probability[k]


# Covariances that come with detections: they take the place of the sensor's noise model, in any coordinates

SENSOR = Sensor(noise={"default": NoiseModel(position=0.3)})
ALONG = np.array([[[4.0, 0.0], [0.0, 0.01]]])  # wide along x


def table(covariance=None, places=((10.0, 0.0, 0.0),)):
    boxes = Boxes.of(["car"] * len(places), places)
    more = {} if covariance is None else {"position_covariance": covariance}
    return Detections(boxes, np.ones(len(places)), **more)


def test_reported_covariances_take_the_place_of_the_model_and_survive_selection():
    both = Detections.concatenate([table(ALONG), table()])
    R = SENSOR.detection_covariance(both, None)[:, :2, :2]
    assert R[0] == pytest.approx(ALONG[0])
    assert R[1] == pytest.approx(0.09 * np.eye(2))
    both = Detections.concatenate([table(), table(ALONG)])
    assert both.select([1]).position_covariance == pytest.approx(ALONG)
    one = both[1]
    assert one.position_covariance == (4.0, 0.0, 0.01)
    assert Detections.of([one, both[0]]).position_covariance[0] == pytest.approx(ALONG[0])


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_a_new_track_is_as_uncertain_as_its_detection(estimator):
    tracker = Tracker(TrackerSettings(estimator=estimator), {"lidar": SENSOR})
    quarter = yaw_transform(0, 0, 0, np.pi / 2)
    tracks = tracker.step(Frame(0.0, "lidar", table(ALONG), quarter, "ego"))
    assert tracks.position_covariance[0] == pytest.approx(np.diag([0.01, 4.0]), abs=1e-6)


def test_wrong_covariances_are_refused():
    with pytest.raises(InputError, match=r"position_covariance\[0\]: expected a positive definite"):
        table(-ALONG)
    with pytest.raises(InputError, match="position_covariance: expected shape"):
        table(np.ones((2, 2)))
    with pytest.raises(InputError, match="expected a positive definite"):
        Detection("car", (0, 0, 0), position_covariance=(1.0, 2.0, 1.0))


# The ego vehicle as a node of the tracks' graph: its pose estimated with the objects', and its part in following

PLACE = np.array([4000.0, -7000.0])  # of the scene in the world
CARS = straight(PLACE + np.array([(0.0, 3.0), (9.0, 3.2), (0.0, -40.0)]), [(1.2, 0.4), (1.2, 0.4), (1.0, 0.0)])
APART = EgoNodeSettings(estimated=True, label="ego")  # of no class that follows


def turning(t: float) -> np.ndarray:
    pose = turning_vehicle(t)
    pose[:2, 3] += PLACE
    return pose


def drive(sigma: float, planar: bool, count: int = 12) -> list[tuple[Frame, Frame]]:
    """Frames that know where the vehicle is, and the same with odometry of so small an error."""
    frames, pose = [], None
    for world in seen(np.random.default_rng(0), CARS, np.arange(count) / 10):
        known = at_pose(world, turning(world.timestamp), "ego")
        ego = EgoMeasurements()
        if pose is not None:
            motion = inverse_transform(pose) @ known.world_T_ego
            if planar:
                motion = motion[np.ix_([0, 1, 3], [0, 1, 3])]
            ego = EgoMeasurements(OdometryIncrement(motion, 0.1, sigma**2 * np.eye(3 if planar else 6)))
        frames.append((known, replace(known, world_T_ego=None if pose is not None else known.world_T_ego, ego=ego)))
        pose = known.world_T_ego
    return frames


@pytest.mark.parametrize(("estimator", "max_step"), [("isam2", np.inf), ("isam2", 0.04), ("fixed-lag", np.inf)])
def test_with_a_perfectly_known_pose_the_tracks_are_todays(estimator, max_step, subtests):
    for planar in [True, False]:
        with subtests.test(planar=planar):
            start = StartSettings(None, 1e-7, 1e-8, 1e-8, planar)
            today = Tracker(TrackerSettings(max_step=max_step))
            settings = TrackerSettings(estimator=estimator, lag=0.3, ego=APART, max_step=max_step)
            joint = Tracker(settings, providers=[Odometry(start)])
            for known, told in drive(1e-8, planar):
                a, b = today.step(known), joint.step(told)
                assert a.id.tolist() == b.id.tolist()
                for name in ("position", "velocity"):
                    assert getattr(b.boxes, name)[:, :2] == pytest.approx(getattr(a.boxes, name)[:, :2], abs=1e-9)
                assert b.position_covariance == pytest.approx(a.position_covariance, abs=1e-9)
                assert b.velocity_covariance == pytest.approx(a.velocity_covariance, abs=1e-9)


DT, Q, R = 0.2, 0.5, 0.04
MODEL = {
    "default": ClassSettings(motion=ConstantVelocity(acceleration_noise=Q)),
    "ego": ClassSettings(motion=ConstantVelocity(acceleration_noise=1e3)),
}
SENSORS = {"default": Sensor(noise={"default": NoiseModel(position=R**0.5)})}
START = StartSettings((0.0, 0.0, 0.0), 0.3, 0.03)


def drawn(seed: int, count: int = 30) -> list[tuple[Frame, np.ndarray]]:
    """Frames in the vehicle's coordinates with odometry and GPS, and the objects, drawn from the model."""
    rng = np.random.default_rng(seed)
    pose, noise = gtsam.Pose2(*rng.normal(0, 0.3, 2), rng.normal(0, 0.03)), np.diag([0.1, 0.05, 0.01]) ** 2
    objects = np.array([(12.0, 5, 0, 0), (25, -8, 0, 0), (30, 12, 0, 0), (8, -14, 0, 0)])
    objects[:, 2:] = np.array([4.0, 0.0]) + rng.normal(0, 1, (4, 2))
    F = np.eye(4) + DT * np.eye(4, k=2)
    L = np.linalg.cholesky(Q * np.kron([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]], np.eye(2)))
    step, frames = gtsam.Pose2(0.8, 0.0, 0.03), []
    for k in range(count):
        odometry = None
        if k:
            pose, objects = pose.compose(step), objects @ F.T + rng.normal(size=(4, 4)) @ L.T
            measured = step.retract(rng.multivariate_normal(np.zeros(3), noise))
            odometry = OdometryIncrement(measured.matrix(), DT, noise)
        z = np.array([pose.transformTo(one[:2]) for one in objects]) + rng.normal(0, R**0.5, (4, 2))
        gps = GpsFix(pose.translation() + rng.normal(size=2), np.eye(2)) if k % 2 == 0 else None
        ego = EgoMeasurements(odometry, gps)
        frames.append((frame(k * DT, z, yaw=np.nan, coordinates="ego", ego=ego), objects[:, :2].copy()))
    return frames


def errors(step: Callable[[Frame], object], frames: list[tuple[Frame, np.ndarray]]) -> np.ndarray:
    """Normalised squared errors, per dimension, of the positions of the tracks that are nearest to the objects."""
    result = []
    for k, (told, truth) in enumerate(frames):
        tracks = step(told)
        apart = np.linalg.norm(tracks.boxes.position[:, None, :2] - truth, axis=2)  # type: ignore[attr-defined]
        nearest = np.argmin(apart, axis=0)
        e = tracks.boxes.position[nearest, :2] - truth  # type: ignore[attr-defined]
        if k >= 10:
            result.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(tracks.position_covariance[nearest]), e) / 2)  # type: ignore[attr-defined]
    return np.array(result)


def test_objects_err_as_they_say_where_the_pose_is_uncertain():
    """Ten times as much if the pose were taken for exact."""
    found = []
    for seed in range(5):
        settings = TrackerSettings(classes=MODEL, edges=(), estimator="isam2", ego=APART)
        tracker = Tracker(settings, SENSORS, providers=[Odometry(START), Gps(gate=1)])
        found.append(errors(tracker.step, drawn(seed)).mean())
    assert 0.6 < np.mean(found) < 1.6, found


def hidden_follower(seed: int) -> list[tuple[Frame, float, bool]]:
    """A car 18 m behind us, hidden for 1.7 s while we brake from 12 to 4 m/s; it follows as Helly's law says."""
    rng = np.random.default_rng(seed)
    ours = theirs = np.array([0.0, 12.0])
    theirs, frames = theirs - [18.0, 0.0], []
    for k in range(45):
        braking = -4.0 if k >= 25 else 0.0
        following = (ours[1] - theirs[1]) + (ours[0] - theirs[0] - 18.0) / 4 + rng.normal()
        ours = ours + 0.1 * np.array([ours[1], braking])
        theirs = theirs + 0.1 * np.array([theirs[1], following])
        hidden = k >= 28
        z = [] if hidden else [np.array([theirs[0], 0.0]) + rng.normal(0, 0.1, 2)]
        pose = yaw_transform(ours[0], 0.0, 0.0, 0.0)
        frames.append((frame(0.1 * k, z, yaw=0.0, world_T_ego=pose), theirs[0], hidden))
    return frames


def astray(ego: EgoNodeSettings | None, estimator: str) -> float:
    """RMS error of the follower's place while it is hidden, m."""
    classes = {"default": ClassSettings(motion=ConstantVelocity(acceleration_noise=1.0), max_deviation=20.0)}
    tracker = Tracker(TrackerSettings(classes=classes, edges=(Following(rate=2.0),), estimator=estimator, ego=ego))
    squares = []
    for told, place, hidden in hidden_follower(0):
        tracks = tracker.step(told)
        if hidden:
            squares.append((tracks.boxes.position[0, 0] - place) ** 2)
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.parametrize("estimator", ["kalman", "fixed-lag"])
def test_a_hidden_car_behind_us_brakes_because_we_do(estimator):
    without, with_us = astray(None, estimator), astray(EgoNodeSettings(), estimator)
    assert with_us < 0.5 * without
    assert without > 1.3


def test_the_vehicle_is_never_reported_and_a_node_of_the_graph():
    tracker = Tracker(TrackerSettings(ego=EgoNodeSettings()))
    for told, _, _ in hidden_follower(0)[:10]:
        tracks = tracker.step(told)
    assert tracks.id.tolist() == [1]
    assert tracker.graph.nodes.tolist() == [1, 0]
    assert tracker.graph.edge_count > 0


def test_the_vehicle_is_of_the_class_and_the_length_that_are_set():
    cars, filled = straight([(-25.0, 0.0)], [(8.0, 0.0)]), {}
    for length in (4.5, 16.0):
        ego, classes = EgoNodeSettings(label="truck", length=length), {"truck": ClassSettings(ConstantAcceleration())}
        classes["default"] = ClassSettings(ConstantVelocity())
        tracker = Tracker(TrackerSettings(edges=(Following(SmoothDriver()),), ego=ego, classes=classes))
        for world in seen(np.random.default_rng(0), cars, np.arange(12) / 10):
            tracker.step(at_pose(world, yaw_transform(8.0 * world.timestamp), "ego"))
        (edges,) = tracker.graph.nonlinear
        assert tracker.graph.nodes[edges.source].tolist() == [0]
        assert tracker.graph.dims.tolist() == [4, 6]
        filled[length] = edges.given[0]
    assert filled[16.0] - filled[4.5] == pytest.approx((16.0 - 4.5) / 2), "who follows a longer vehicle has less room"


def test_what_is_refused():
    with pytest.raises(InputError, match="length: expected a finite number > 0"):
        EgoNodeSettings(length=0.0)
    with pytest.raises(InputError, match=r"ego\.estimated: expected the estimator isam2 or fixed-lag, got kalman"):
        Tracker(TrackerSettings(ego=EgoNodeSettings(estimated=True)))
    with pytest.raises(InputError, match=r"ego\.estimated: expected association without pairs"):
        TrackerSettings(ego=EgoNodeSettings(True), estimator="isam2", association=AssociationSettings(method="graph"))
    told = drawn(0, 1)[0][0]
    for settings, providers in ((TrackerSettings(), ()), (TrackerSettings(estimator="isam2"), (Odometry(START),))):
        with pytest.raises(InputError, match="world_T_ego: expected a pose, since nothing estimates it"):
            Tracker(settings, providers=providers).step(told)
    nowhere = Tracker(TrackerSettings(estimator="isam2", ego=APART), providers=[Gps()])
    with pytest.raises(InputError, match=r"ego\.estimated: expected a provider that adds the vehicle's pose"):
        nowhere.step(told)
