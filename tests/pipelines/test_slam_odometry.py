"""LiDAR odometry, moving objects, and loops that are closed."""

import logging

import gtsam
import numpy as np
import pytest

from benchmarks.course import SimulatedCourse
from benchmarks.scans import SMALL, ScannerSettings, SimulatedScans, StaticWorld, drive, scans, simulate_scan, street
from data_tools.lidar import Scan, Submap, constant_velocity, voxel_downsample
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.config import load_config
from pipelines.slam.driver import MovingObjects, SlamResult
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam, path_tracker
from pipelines.slam.loop_closures import Agreement, PlaceLoops, deviation
from pipelines.slam.odometry import (
    LOST_ROTATION,
    LOST_TRANSLATION,
    LidarOdometry,
    OdometrySettings,
    OdometryStep,
)
from saga_fg import Boxes, Detections, Frame, InputError
from saga_fg.numerics import FloatArray, inverse_transform, transform_points, yaw_transform
from saga_fg.slam.pose_graph.optimisation import shortest_paths
from saga_fg.slam.submaps import LoopClosure
from tests.data_tools.featureless import tunnel

# LiDAR odometry on simulated drives, where the true poses are known

PERIOD = 0.1


def run(taken: list[Scan]) -> list[OdometryStep]:
    odometry = LidarOdometry()
    return [odometry.step(scan, PERIOD * k) for k, scan in enumerate(taken)]


def trajectory(poses: FloatArray) -> Trajectory:
    return Trajectory(PERIOD * np.arange(len(poses)), poses)


def test_a_drive_is_followed_to_centimetres():
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


def test_a_start_at_full_speed_is_caught_up_with():
    """As long as the speed is not known, no prediction is held on to."""
    poses = drive(8, speed=16.0, turn_rate=0.0)
    steps = run(scans(street(1), poses, 1))
    estimate = poses[0] @ np.array([step.map_T_lidar for step in steps])
    assert np.linalg.norm(np.diff(estimate[4:, 0, 3]) - 1.6) < 0.1


def test_poses_stay_rigid_however_long_the_chain():
    """A rotation a little off, fed back through the predicted motion, would be off by everything within forty scans."""
    world, poses = street(0), np.repeat(drive(2, speed=0.5)[:1], 45, axis=0)
    last = run(scans(world, poses, skewed=False))[-1].map_T_lidar
    np.testing.assert_allclose(last[:3, :3] @ last[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(last, np.eye(4), atol=0.02)


def test_a_scan_without_points_lies_where_it_was_predicted(caplog):
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


def test_through_a_tunnel_odometry_says_what_it_does_not_see(caplog):
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


def test_time_runs_forwards_and_settings_are_checked():
    odometry = LidarOdometry()
    scan = scans(street(0), drive(2))[0]
    odometry.step(scan, 1.0)
    with pytest.raises(InputError, match="timestamp: expected a finite number of seconds, got nan"):
        LidarOdometry().step(scan, float("nan"))
    with pytest.raises(InputError, match=r"timestamp: expected one after 1\.0"):
        odometry.step(scan, 1.0)
    with pytest.raises(InputError, match="surfel_size: expected"):
        OdometrySettings(surfel_size=0.0)


# Moving objects leave the map, parked ones stay

START, SPEED = np.array([5.0, 1.5, 0.75]), 7.0  # m, m/s, of a car that drives ahead
SIZE = np.array([4.4, 1.8, 1.5])


def drive_behind_a_car(count: int = 24) -> tuple[SimulatedScans, list[Frame], np.ndarray]:
    """Scans of a street in which a car drives, frames with all cars, and the places of the moving one."""
    scans = SimulatedScans(1, count)
    rng, still = np.random.default_rng(0), scans.world
    parked = still.boxes.select(still.boxes.label == "car")
    places, frames = START + np.outer(scans.timestamps, [SPEED, 0, 0]), []
    for k, (time, pose) in enumerate(zip(scans.timestamps.tolist(), scans.world_T_ego, strict=True)):
        mover = Boxes.of(["car"], places[[k]], SIZE[None], [0.0], [[0.0, 0.0]])
        world = StaticWorld(Boxes.concatenate([still.boxes, mover]), still.poles)
        a = min(k, count - 2)
        motion = constant_velocity(inverse_transform(scans.world_T_ego[a]) @ scans.world_T_ego[a + 1], SMALL.period)
        scans._scans[k] = simulate_scan(world, pose, rng, SMALL, motion)
        cars = Boxes.concatenate([parked, mover])
        near = cars.select(np.linalg.norm(cars.position - pose[:3, 3], axis=1) < 30)
        seen = Boxes.of(near.label.tolist(), near.position, near.size, near.yaw).transformed(inverse_transform(pose))
        frames.append(Frame(time, "lidar", Detections(seen, np.full(len(seen), 3.0)), np.eye(4), "ego"))
    return scans, frames, places


def points_on(result: SlamResult, places: np.ndarray, size: np.ndarray = SIZE) -> int:
    """Number of points of the map in boxes along x, above the ground."""
    cloud = np.concatenate(
        [
            transform_points(T, one.points.astype(float))
            for T, one in zip(result.world_T_submap, result.submaps, strict=True)
        ]
    )
    inside = [(np.abs(cloud - place) < size / 2).all(axis=1) & (cloud[:, 2] > 0.3) for place in places]
    return int(np.any(inside, axis=0).sum())


def test_the_trail_of_a_moving_car_is_not_in_the_map():
    scans, frames, places = drive_behind_a_car()
    settings = LidarSlamSettings(loop_closures=False, landmarks=False)
    before = lidar_slam(scans, settings=settings)
    after = lidar_slam(scans, settings=settings, objects=(frames, path_tracker(load_config("kitti"))))
    assert points_on(before, places[5:]) > 200
    assert points_on(after, places[5:]) < 0.05 * points_on(before, places[5:])
    parked = scans.world.boxes.select(scans.world.boxes.label == "car").position
    near = parked[np.abs(parked[:, 0] - scans.world_T_ego[len(frames) // 2, 0, 3]) < 15]
    assert len(near) >= 3
    kept, there = (points_on(one, near, SIZE + 0.4) for one in (after, before))
    assert kept > 0.9 * there > 100


@pytest.mark.parametrize(("turned", "said"), [(0.0, 0), (2.0, 1)])
def test_detections_in_another_frame_are_noticed(turned, said, caplog):
    scans, frames, _ = drive_behind_a_car(12)
    objects = MovingObjects(path_tracker(load_config("kitti")))
    for k, frame in enumerate(frames):
        boxes = frame.detections.boxes.transformed(yaw_transform(3.0 * turned, yaw=turned))
        objects.check(scans[k], Detections(boxes, frame.detections.score))
    assert (
        caplog.text.count("detections: expected boxes in the frame of the vehicle, at the times of the scans") == said
    )


def test_an_object_moves_when_its_speed_is_sure(subtests):
    """Speeds above the limit, but by no more than the detections can tell."""
    for speeds, moving in [([4.0] * 2, 0), ([4.0] * 4, 1), ([1.2] * 12, 0)]:
        with subtests.test(speeds=speeds, moving=moving):
            objects, x = MovingObjects(path_tracker(load_config("kitti"))), 10.0
            for k, speed in enumerate(speeds):
                x += 0.1 * speed
                seen = Boxes.of(["car"], [[x, 0.0, 0.75]], SIZE[None], [0.0])
                found = objects.boxes(0.1 * k, Detections(seen, np.array([3.0])), np.eye(4))
            assert len(found) == moving


# Loops by place: found after much drift, and only where the vehicle came back


@pytest.fixture(scope="module")
def loops_drive() -> tuple[list[Submap], FloatArray]:
    """Six submaps, then the first three again in the next lap, and their true frames."""
    first = SimulatedCourse(0, length=10.0, skewed=False).lap
    course = SimulatedCourse(0, length=first + 100.0, skewed=False)
    starts = [*np.arange(0.0, 180.0, 30.0), *(course.lap + np.arange(5.0, 95.0, 30.0))]
    submaps, frames = [], []
    for number, way in enumerate(starts):
        rows = np.flatnonzero((course.distance >= way) & (course.distance < way + 30.0))[::4]
        frame = course.world_T_ego[rows[0]]
        points = np.concatenate(
            [transform_points(inverse_transform(frame) @ course.world_T_ego[k], course[int(k)].points) for k in rows]
        )
        points = points[voxel_downsample(points, 0.4)].astype(np.float32)
        submaps.append(Submap((number, number + 1), np.eye(4), points, (way, way + 30.0)))
        frames.append(frame)
    return submaps, np.array(frames)


def test_loops_are_found_with_drift(loops_drive, subtests):
    for drift in [1.0, 10.0, 30.0]:
        with subtests.test(drift=drift):
            submaps, true = loops_drive
            off = np.array([yaw_transform(0.6 * d, -0.8 * d, 0.0, 0.002 * d) for d in drift * (np.arange(9) >= 6)])
            estimated = off @ true
            search = PlaceLoops()
            loops = [loop for k, one in enumerate(submaps) for loop in search.add(one, estimated[: k + 1])]
            assert {loop.second for loop in loops} == {6, 7, 8}
            for loop in loops:
                between = inverse_transform(true[loop.first]) @ true[loop.second]
                error = (inverse_transform(between) @ loop.first_T_second)[:3, 3]
                assert (
                    error @ np.linalg.solve(loop.covariance[3:, 3:], error) < 16.3
                )  # 0.1 % of three degrees of freedom


def test_far_off_a_loop_waits_for_another(loops_drive):
    submaps, true = loops_drive
    estimated = true.copy()
    estimated[6:, :2, 3] += 95.0
    search = PlaceLoops()
    found = [len(search.add(one, estimated[: k + 1])) for k, one in enumerate(submaps)]
    assert found[:7] == [0] * 7
    assert found[7] >= 2


def test_row_houses_are_no_place():
    """A street that repeats every 12 m: where along it the vehicle is, nobody can tell."""
    x = np.arange(-150.0, 250.0, 12.0)
    houses = [(at, side * 12.0, 3.0) for at in x for side in (-1, 1)]
    n = len(houses)
    boxes = Boxes.of(["house"] * n, houses, [(8.0, 6.0, 6.0)] * n, np.zeros(n), np.zeros((n, 2)))
    world, rng = StaticWorld(boxes, np.empty((0, 4))), np.random.default_rng(0)
    submaps, frames = [], []
    for number, start in enumerate((0.0, 96.0)):
        steps = [yaw_transform(x=d) for d in (0.0, 8.0, 16.0)]
        start_T_world = yaw_transform(-start, z=-1.8)
        scans = [simulate_scan(world, inverse_transform(start_T_world) @ step, rng, SMALL).points for step in steps]
        placed = [transform_points(step, scan) for step, scan in zip(steps, scans, strict=True)]
        points = np.concatenate(placed).astype(np.float32)
        submaps.append(Submap((number, number + 1), np.eye(4), points, (start, start + 16.0)))
        frames.append(yaw_transform(10.0 * number, z=1.8))  # an odometry that says that the vehicle came back
    search = PlaceLoops()
    assert [len(search.add(one, np.array(frames[: k + 1]))) for k, one in enumerate(submaps)] == [0, 0]


def test_a_submap_without_points_has_no_loops(loops_drive):
    submaps, true = loops_drive
    search = PlaceLoops()
    assert search.add(submaps[0], true[:1]) == []
    bare = Submap((1, 2), np.eye(4), np.empty((0, 3), dtype=np.float32), (30.0, 60.0))
    assert search.add(bare, true[:2]) == []


# Loops that wait for another: two that close a chain are believed, and one that does not is forgotten


def loop(first: int, second: int, x: float) -> LoopClosure:
    return LoopClosure(first, second, yaw_transform(x), np.eye(6))


def test_deviations_are_known_and_ways_take_the_shortest_measurements():
    pose = gtsam.Pose3(gtsam.Rot3.Rodrigues(np.array([0.3, 0.0, 0.4])), np.array([0.0, 0.0, 2.0])).matrix()
    np.testing.assert_allclose(deviation(pose), [2.0, 0.5])
    np.testing.assert_allclose(deviation(np.eye(4)), [0.0, 0.0], atol=1e-12)
    first, second = np.array([0, 1, 2, 0, 0]), np.array([1, 2, 3, 3, 1])
    length = np.array([5.0, 5.0, 5.0, 1.0, 7.0])
    np.testing.assert_allclose(shortest_paths(first, second, length, 5, 0), [0.0, 5.0, 6.0, 1.0, np.inf])


@pytest.mark.parametrize(("off", "later", "believed"), [(0.1, 4, 2), (0.8, 4, 0), (0.1, 9, 0), (0.1, 1, 0)])
def test_a_loop_is_believed_when_another_agrees(off, later, believed):
    """Poses 10 m apart along a line; two loops from 20 on to 0 on, the second off by `off` m, `later` poses on."""
    poses = [yaw_transform(x=10.0 * k) for k in range(40)]
    agreement = Agreement(np.array([0.3, 0.05]), np.zeros(2), patience=80.0, apart=15.0)
    loops = [loop(0, 20, 5.0), loop(2, 20 + later, 5.0 + 10.0 * (later - 2) + off)]
    found = [
        agreement.confirmed(loop, lambda a, b: inverse_transform(poses[a]) @ poses[b], lambda k: 10.0 * k)
        for loop in loops
    ]
    assert len(found[0]) == 0
    assert len(found[1]) == believed
