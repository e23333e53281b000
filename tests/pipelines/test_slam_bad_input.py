"""LiDAR SLAM with scans that are lost, wheels that are wrong, and input that nobody can use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scans import SMALL, SimulatedScans, drive, simulate_scan, street
from data_tools.lidar import Scan
from pipelines.slam.drive import motion, shared
from pipelines.slam.lidar_slam import LidarSlam, LidarSlamSettings
from pipelines.slam.odometry import LidarOdometry, OdometryStep
from pipelines.slam.vehicle_sensors import Vehicle, mean_speed
from saga_fg import Detections, InputError
from saga_fg.graph import Additions, GraphView
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.types.frame import EgoMeasurements, GpsFix, Observation, WheelSpeed

NOTHING = Scan.of(np.empty((0, 3)))
PLAIN = LidarSlamSettings(landmarks=False, loop_closures=False)


class Listener:
    """A provider that keeps what keyframes bring."""

    name = "listener"

    def __init__(self) -> None:
        self.heard: list[EgoMeasurements | None] = []

    def factors(self, view: GraphView) -> Additions:
        self.heard.append(None if view.frame is None else view.frame.ego)
        return Additions()


class Given:
    """Odometry that says what it is told."""

    def __init__(self, steps: Sequence[object]) -> None:
        self.steps = iter(steps)

    def step(self, scan: Scan, timestamp: float, velocity: np.ndarray | None = None) -> OdometryStep:
        return next(self.steps)  # type: ignore[return-value]


def placed(x: float = 0.0, keyframe: bool = True, time: float = 0.0) -> OdometryStep:
    return OdometryStep(time, yaw_transform(x), 1e-4 * np.eye(6), Scan.of(np.ones((1, 3))), keyframe, None)


@pytest.fixture(scope="module")
def scans() -> SimulatedScans:
    return SimulatedScans(seed=0, count=16)


def test_lost_scans_leave_the_drive_as_it_was(scans: SimulatedScans) -> None:
    count = 3
    slam, deviations = LidarSlam(scans.world_T_ego[0], PLAIN, vehicle=Vehicle(scans.ego_T_lidar)), list[float]()
    for k, time in enumerate(scans.timestamps.tolist()):
        step = slam.step(NOTHING if 9 <= k < 9 + count else scans[k], time)
        deviations.append(float(np.sqrt(step.covariance.diagonal()[3:].max())))
        assert (step.keyframe is None) == (9 <= k < 9 + count)
    assert min(deviations[9 : 9 + count]) > 0.5
    assert deviations[9 + count] < 0.1
    error = np.linalg.norm(slam.finish().trajectory.positions - scans.world_T_ego[:, :3, 3], axis=1)
    assert error.max() < 0.15


@pytest.mark.parametrize("known", [True, False])
def test_carried_further_than_nearby(known: bool, caplog: pytest.LogCaptureFixture) -> None:
    """20 m back, where the map has the place; and into another street, of which nothing tells how far it is."""
    rng, poses, odometry, variance = np.random.default_rng(0), drive(40), LidarOdometry(), 0.0
    worlds = street(0), street(0 if known else 3)
    for k in range(42):
        row = k if k < 36 else k - 26
        scan = NOTHING if k == 38 else simulate_scan(worlds[k >= 36], poses[row], rng, SMALL)
        step = odometry.step(scan, 0.1 * k + 2.0 * (k >= 36))
        variance += step.covariance[3, 3]
    assert ("lost, its place is unknown" in caplog.text) != known
    assert ("from where it was expected: moved" in caplog.text) == known
    if known:
        off = inverse_transform(poses[0]) @ poses[row]
        np.testing.assert_allclose(step.map_T_lidar[:3, 3], off[:3, 3], atol=0.2)
    else:
        assert not step.keyframe
        assert variance > 20.0**2


def test_lost_scans_share_the_covariance_of_the_whole_motion() -> None:
    poses = [yaw_transform(k, 0.1 * k**2, 0.0, 0.2 * k) for k in range(4)]
    step = replace(placed(), covariance=np.diag([1.0, 2, 3, 4, 5, 6]), lost=2)
    total = motion(poses, shared(poses, step))[1]
    np.testing.assert_allclose(total, step.covariance, atol=1e-3)
    assert len(shared(poses[:1], replace(step, lost=0))) == 1


@pytest.mark.parametrize("speed", [30.0, -8.0])
def test_a_speed_that_no_vehicle_can_reach_is_refused(
    scans: SimulatedScans, speed: float, caplog: pytest.LogCaptureFixture
) -> None:
    slam = LidarSlam(scans.world_T_ego[0], PLAIN, vehicle=Vehicle(scans.ego_T_lidar, ["wheels"]))
    for k, time in enumerate(scans.timestamps.tolist()):
        slam.step(scans[k], time, wheels=WheelSpeed(speed if k == 10 else 8.0, 0.1))
    assert caplog.text.count("by other sensors is refused") == 1
    error = np.linalg.norm(slam.finish().trajectory.positions - scans.world_T_ego[:, :3, 3], axis=1)
    assert error.max() < 0.15


def test_wheels_that_are_wrong_from_the_start_are_refused(
    scans: SimulatedScans, caplog: pytest.LogCaptureFixture
) -> None:
    """Such as km/h for m/s: the scans are asked before anything is believed."""
    slam = LidarSlam(scans.world_T_ego[0], PLAIN, vehicle=Vehicle(scans.ego_T_lidar, ["wheels"]))
    for k, time in enumerate(scans.timestamps.tolist()):
        slam.step(scans[k], time, wheels=WheelSpeed(3.6 * 8.0, 0.1))
    assert caplog.text.count("by other sensors is refused") == 1
    found = slam.finish()
    error = np.linalg.norm(found.trajectory.positions - scans.world_T_ego[:, :3, 3], axis=1)
    assert error.max() < 0.15
    assert "wheels" in {**found.misfits, **found.unjudged}


def test_a_speed_predicts_only_where_wheels_are_among_the_sensors(
    scans: SimulatedScans, caplog: pytest.LogCaptureFixture
) -> None:
    without, listening = LidarSlam(settings=PLAIN), LidarSlam(settings=PLAIN, providers=[Listener()])
    for k, time in enumerate(scans.timestamps[:4].tolist()):
        alone = without.step(scans[k], time)
        heard = listening.step(scans[k], time, wheels=WheelSpeed(9.0, 0.1))
        np.testing.assert_array_equal(alone.odometry.map_T_lidar, heard.odometry.map_T_lidar)
    assert caplog.text.count("wheels: not among the sensors") == 1
    with pytest.raises(InputError, match="wheels: expected it among the sensors"):
        without.step(scans[4], 4.0, wheels=WheelSpeed(9.0, 0.1))
    with pytest.raises(InputError, match="gps: expected it among the sensors"):
        without.step(scans[4], 4.0, gps=GpsFix(np.zeros(3)))
    without.step(scans[4], float(scans.timestamps[4]))


def test_after_the_end_nothing_is_taken(scans: SimulatedScans) -> None:
    slam = LidarSlam(settings=PLAIN)
    slam.step(scans[0], 0.0)
    slam.finish()
    with pytest.raises(InputError, match="expected no scan after finish"):
        slam.step(scans[1], 0.1)
    with pytest.raises(InputError, match="finish: expected to be called once"):
        slam.finish()


def test_a_vehicle_that_stands_where_the_first_scan_was_refused(scans: SimulatedScans) -> None:
    class Detector:
        calls = 0

        def observations(self, points: np.ndarray) -> list[Observation]:
            self.calls += 1
            if self.calls == 1:
                raise ValueError("no")
            return []

    slam = LidarSlam(scans.world_T_ego[0], vehicle=Vehicle(scans.ego_T_lidar), detectors=[Detector()])
    with pytest.raises(ValueError, match="no"):
        slam.step(scans[0], 0.0)
    step = slam.step(scans[0], 0.1)
    assert step.keyframe == 0
    np.testing.assert_allclose(slam.finish().trajectory.positions, scans.world_T_ego[[0, 0], :3, 3], atol=0.02)


def test_the_first_keyframe_lies_where_odometry_says() -> None:
    class Provider(Listener):
        def factors(self, view: GraphView) -> Additions:
            super().factors(view)
            if len(self.heard) == 1:
                raise ValueError("no")
            return Additions()

    slam = LidarSlam(settings=PLAIN, providers=[Provider()], odometry=Given([placed(), placed(2.0), placed(3.0)]))
    with pytest.raises(ValueError, match="no"):
        slam.step(NOTHING, 0.0)
    for k in (1, 2):
        slam.step(NOTHING, 0.1 * k)
    np.testing.assert_allclose(slam.finish().trajectory.positions[:, 0], [0.0, 2.0, 3.0], atol=1e-6)


def test_odometry_of_ones_own_is_checked() -> None:
    slam = LidarSlam(settings=PLAIN, odometry=Given([placed(keyframe=False), placed(0.1, keyframe=False)]))
    assert slam.step(NOTHING, 0.0).keyframe == 0
    assert slam.step(NOTHING, 0.1).keyframe is None
    for step, message in (
        (None, "odometry: expected OdometryStep, got NoneType"),
        (replace(placed(), map_T_lidar=np.diag([2.0, 2.0, 2.0, 1.0])), "odometry: map_T_lidar: expected a rigid"),
        (replace(placed(), covariance=-np.eye(6)), "odometry: covariance: expected a symmetric"),
        (replace(placed(), covariance=np.full((6, 6), np.nan)), "odometry: covariance"),
        (replace(placed(), covariance=np.eye(3)), "odometry: covariance: expected shape"),
        (replace(placed(), lost=-1), "odometry: lost"),
        (replace(placed(), scan=np.zeros((1, 3))), "odometry: scan: expected Scan"),  # type: ignore[arg-type]
    ):
        with pytest.raises(InputError, match=message):
            LidarSlam(settings=PLAIN, odometry=Given([step])).step(NOTHING, 0.0)


def test_a_fix_between_keyframes_waits_for_the_next() -> None:
    heard = Listener()
    steps = [placed(), placed(0.2, keyframe=False), placed(0.4, keyframe=False), placed(0.6)]
    slam = LidarSlam(settings=PLAIN, providers=[heard], odometry=Given(steps), vehicle=Vehicle(sensors=["gps"]))
    fixes = {1: GpsFix(np.array([0.1, 0, 0]), age=0.02), 2: GpsFix(np.array([0.4, 0, 0]), age=0.03)}
    for k in range(4):
        slam.step(NOTHING, 0.1 * k, gps=fixes.get(k))
    fix = heard.heard[-1].gps if heard.heard[-1] is not None else None
    assert fix.position[0] == 0.4
    assert fix.age == pytest.approx(0.13)


def test_joined_speeds_keep_their_deviation() -> None:
    def joined(*speeds: WheelSpeed) -> WheelSpeed:
        return mean_speed(speeds, 0.2)

    both = joined(WheelSpeed(1.0, 0.1, 0.3), WheelSpeed(3.0, 0.3, 0.4))
    assert both.speed == pytest.approx(2.5)
    assert both.dt == pytest.approx(0.4)
    assert both.deviation == pytest.approx(np.hypot(0.25 * 0.3, 0.75 * 0.4))
    mixed, unknown = joined(WheelSpeed(1.0, 0.1), WheelSpeed(1.0, 0.1, 0.4)), joined(WheelSpeed(1.0, 0.1))
    assert mixed.deviation == pytest.approx(0.5 * np.hypot(0.2, 0.4))
    assert unknown.deviation is None


def test_scans_in_other_units_are_refused(scans: SimulatedScans) -> None:
    for scale in (1e3, 1e-3):
        odometry, other = LidarOdometry(), Scan.of(scans[0].points * scale)
        with pytest.raises(InputError, match="points in metres, at distances from min_range 3 m to max_range 100 m"):
            odometry.step(other, 0.0)
        odometry.step(scans[0], 0.0)
        for k in range(1, 5):
            assert odometry.step(other, 0.1 * k).registration is None
        with pytest.raises(InputError, match="max_range"):
            odometry.step(other, 0.5)
        odometry.step(scans[0], 0.6)


def test_a_turn_on_the_spot_makes_keyframes_too() -> None:
    scans = SimulatedScans(0, world_T_lidar=np.array([yaw_transform(0, 0, 1.7, 0.02 * k) for k in range(7)]))
    odometry = LidarOdometry()
    keyframes = [odometry.step(scans[k], time).keyframe for k, time in enumerate(scans.timestamps.tolist())]
    assert keyframes == [True, False, False, True, False, False, True]


def test_sensors_are_a_list_of_names() -> None:
    with pytest.raises(InputError, match=r"sensors: expected a list of names, such as \['gps'\], got a string"):
        LidarSlam(vehicle=Vehicle(sensors="gps"))  # type: ignore[arg-type]


def test_detections_without_a_scan_are_refused_and_the_drive_goes_on(scans: SimulatedScans) -> None:
    """As of a camera that is between two scans."""
    slam = LidarSlam(scans.world_T_ego[0], PLAIN, providers=[Listener()])
    slam.step(scans[0], 0.0)
    with pytest.raises(InputError, match=r"scan: expected one in every step: .* give those nearest to a scan"):
        slam.step(None, 0.05, detections=Detections.empty())  # type: ignore[arg-type]
    assert slam.step(scans[1], 0.1, detections=Detections.empty()).keyframe == 1


def test_detections_that_nothing_reads_are_refused(scans: SimulatedScans) -> None:
    slam = LidarSlam(scans.world_T_ego[0], PLAIN)
    with pytest.raises(InputError, match="detections: expected with `moving`, or with providers that read them"):
        slam.step(scans[0], 0.0, detections=Detections.empty())
    assert slam.step(scans[0], 0.0).keyframe == 0
