"""Scans of a LiDAR registered, what they leave open, submaps and places that are found again."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.course import SimulatedCourse
from benchmarks.scans import StaticWorld, drive, scans, street
from data_tools.lidar import (
    Registration,
    RegistrationError,
    Scan,
    Submap,
    SurfelMap,
    azimuth_times,
    deskewed,
    register,
    surfels_of,
    upright,
    voxel_downsample,
    voxel_keys,
)
from data_tools.lidar.places import PlaceImage, PlaceIndex, Structure
from data_tools.lidar.registration import Undetermined
from data_tools.lidar.scan import inside_boxes
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_of, yaw_transform
from saga_fg.types.boxes import Boxes
from tests.data_tools.featureless import open_field, tunnel

# Thinning, de-skew, surfels and registration: laws of each, and poses recovered on simulated scans


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 5.0))
def test_downsampling_leaves_one_point_in_each_voxel(seed, size):
    points = np.random.default_rng(seed).normal(0, 10, (200, 3))
    rows = voxel_downsample(points, size)
    keys = voxel_keys(points, size)
    assert len(set(keys[rows].tolist())) == len(rows)
    assert set(keys[rows].tolist()) == set(keys.tolist())
    assert (np.diff(rows) > 0).all()


def test_voxels_off_the_grid_and_without_size_are_refused():
    with pytest.raises(InputError, match="expected coordinates within"):
        voxel_keys(np.array([[1e6, 0.0, 0.0]]), 0.1)
    with pytest.raises(InputError, match="voxel size > 0"):
        voxel_keys(np.zeros((1, 3)), 0.0)


@given(st.integers(0, 2**32 - 1))
def test_deskew_is_the_exponential_of_the_motion(seed):
    rng = np.random.default_rng(seed)
    points, time, xi = rng.normal(0, 20, (5, 3)), rng.uniform(-0.05, 0.05, 5), rng.normal(0, 3, 6)
    moved = deskewed(Scan(points, np.zeros(5), time), xi)
    for point, t, got in zip(points, time, moved.points, strict=True):
        np.testing.assert_allclose(got, gtsam.Pose3.Expmap(t * xi).transformFrom(point), atol=1e-9)
    assert not moved.time.any()


def test_deskew_needs_times_and_azimuths_give_them():
    with pytest.raises(InputError, match="the scan has none"):
        deskewed(Scan.of(np.zeros((1, 3))), np.zeros(6))
    ahead_left_right = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(azimuth_times(ahead_left_right, 0.1), [0.0, -0.025, 0.025])


@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_surfels_taken_in_parts_are_those_of_all_points(seed, cut):
    points = np.random.default_rng(seed).uniform(-2, 2, (60, 3))
    parts = SurfelMap(1.0, reach=50.0)
    parts.add(points[:cut], np.zeros(3))
    parts.add(points[cut:], np.zeros(3))
    whole = surfels_of(points, 1.0)
    for name in ("voxel", "count", "mean", "scatter", "flat"):
        np.testing.assert_allclose(getattr(parts.surfels, name), getattr(whole, name), atol=1e-12)


def test_surfels_know_their_normals_and_lines_are_not_flat():
    rng = np.random.default_rng(0)
    plane = rng.uniform([0, 0, 0.49], [1, 1, 0.51], (50, 3))
    line = rng.uniform([5, 0.49, 0.49], [6, 0.51, 0.51], (50, 3))
    surfels = surfels_of(np.concatenate([plane, line]), 1.0)
    assert surfels.flat.tolist() == [True, False]
    assert abs(surfels.normal[0, 2]) > 0.99


def test_the_map_forgets_what_is_far_behind():
    surfels = SurfelMap(1.0, reach=20.0)
    surfels.add(np.random.default_rng(0).uniform(-5, 5, (500, 3)), np.zeros(3))
    surfels.add(np.random.default_rng(1).uniform([95, -5, -5], [105, 5, 5], (500, 3)), np.array([100.0, 0, 0]))
    assert len(surfels.surfels)
    assert (surfels.surfels.mean[:, 0] > 80).all()


def test_a_scan_is_registered_to_a_centimetre_and_the_covariance_says_so():
    """Errors in the covariance's own measure: mean of a chi-square of six degrees, over independent scans."""
    world, poses = street(3), drive(2, speed=4.0)
    squares = []
    for seed in range(6):
        first, second = scans(world, poses, seed, skewed=False)
        surfels = SurfelMap(1.0, reach=100.0)
        surfels.add(first.points[voxel_downsample(first.points, 0.25)], np.zeros(3))
        truth = inverse_transform(poses[0]) @ poses[1]
        points = second.points[voxel_downsample(second.points, 1.5)]
        found = register(points, surfels, np.eye(4), 3.0, 0.1)
        error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse_transform(truth) @ found.map_T_scan))
        assert found.converged
        assert np.linalg.norm(error[3:]) < 0.04
        assert np.linalg.norm(error[:3]) < 0.002
        squares.append(float(error @ np.linalg.solve(found.covariance, error)))
    assert 1.5 < np.mean(squares) < 24  # 6 if the map were exact; it is one noisy scan


def test_what_cannot_be_registered_is_said():
    surfels = SurfelMap(1.0, reach=100.0)
    ground = np.random.default_rng(0).uniform([-20, -20, 0], [20, 20, 0.02], (20000, 3))
    surfels.add(ground, np.zeros(3))
    with pytest.raises(RegistrationError, match="leave a direction of motion unconstrained"):
        register(ground[::20], surfels, np.eye(4), 1.0, 0.1)
    with pytest.raises(RegistrationError, match="expected 12 points near the map at least, got 0"):
        register(transform_points(yaw_transform(z=50.0), ground[::20]), surfels, np.eye(4), 1.0, 0.1)


# Motions that surfaces leave open: a plane, a tunnel, a street; and what registration makes of them


def registered(world: StaticWorld, start: np.ndarray, undetermined: Undetermined = "hold") -> Registration:
    first, second = scans(world, drive(2, speed=4.0, turn_rate=0.0), skewed=False)
    surfels = SurfelMap(1.0, reach=100.0)
    surfels.add(first.points[voxel_downsample(first.points, 0.25)], np.zeros(3))
    points = second.points[voxel_downsample(second.points, 1.5)]
    return register(points, surfels, start, 3.0, 0.1, undetermined)


def test_streets_determine_the_motion_and_open_fields_leave_height_and_tilt():
    found = registered(street(0), np.eye(4))
    assert found.observed.names() == ()
    np.testing.assert_array_equal(found.covariance, registered(street(0), np.eye(4), undetermined="refuse").covariance)
    start = yaw_transform(0.4, 0.0, 0.1, 0.02)
    found = registered(open_field(), start)
    assert found.observed.names() == ("heading", "along the road", "across the road")
    np.testing.assert_allclose(found.map_T_scan[:3, 3], [0.4, 0.0, 0.0], atol=0.01)


def test_along_a_tunnel_the_prediction_stays():
    start = yaw_transform(0.3, 0.1, 0.05, 0.01)
    found = registered(tunnel(), start)
    assert "along the road" in found.observed.names()
    assert "across the road" not in found.observed.names()
    assert found.map_T_scan[0, 3] == pytest.approx(0.3, abs=0.03)  # as predicted; 0.4 is the truth
    assert abs(found.map_T_scan[1, 3]) < 0.03
    assert abs(found.map_T_scan[2, 3]) < 0.03
    lost = found.observed.lost * found.observed.scale  # nothing is claimed there
    np.testing.assert_allclose(lost @ found.covariance @ lost.T, 0.0, atol=1e-9)
    assert found.observed.names(np.array([0.0, 1.0, 0.0]))[-1] == "across the road"  # of a way to the left


# Points inside boxes of objects


def test_points_in_boxes_are_found():
    boxes = Boxes.of(["car", "car"], [[10.0, 0, 1], [0, 20, 1]], size=[[4.0, 2, 2], [4.0, 2, 2]], yaw=[0.0, np.pi / 2])
    rows = [[12.2, 0, 1], [12.4, 0, 1], [10, 1.2, 1], [10, 1.4, 1], [0, 22.2, 1], [2.2, 20, 1], [10, 0, 2.4]]
    points = np.array(rows, dtype=float)
    assert inside_boxes(points, boxes).tolist() == [True, False, True, False, True, False, False]
    assert inside_boxes(points, boxes, margin=0.5)[:4].all()
    assert not inside_boxes(points, Boxes.of(["car"], [[12.0, 0, 1]])).any()  # without a size
    assert inside_boxes(np.empty((0, 3)), boxes).shape == (0,)


# Submaps: their frame, and what they refuse


def test_submaps_stand_upright_and_have_small_finite_points():
    world_T_sensor = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, 0.2, -0.1), np.array([3.0, 4.0, 1.0])).matrix()
    world_T_submap = world_T_sensor @ upright(world_T_sensor)
    np.testing.assert_allclose(world_T_submap[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(world_T_submap[1, 0], world_T_submap[0, 0]), 0.7)
    np.testing.assert_allclose(world_T_submap[:3, 3], [3, 4, 1])
    submap = Submap((0, 5), np.eye(4), np.ones((3, 3)), (0.0, 4.0))
    assert submap.points.dtype == np.float32
    with pytest.raises(InputError, match=r"points\[0, 0\]: expected a finite number"):
        Submap((0, 5), np.eye(4), np.full((3, 3), np.nan), (0.0, 4.0))


# Places: the same one is found however it lies, and nothing is found where nothing is


def submap(course: SimulatedCourse, travelled: float, length: float = 30.0) -> FloatArray:
    """Points of a piece of the drive, in the frame of its first scan."""
    rows = np.flatnonzero((course.distance >= travelled) & (course.distance < travelled + length))[::8]
    back = inverse_transform(course.world_T_ego[rows[0]])
    return np.concatenate([transform_points(back @ course.world_T_ego[k], course[int(k)].points) for k in rows])


@pytest.fixture(scope="module")
def places() -> list[FloatArray]:
    course = SimulatedCourse(0, length=700.0, skewed=False)
    return [submap(course, travelled) for travelled in np.arange(0.0, 660.0, 60.0)]


def test_a_place_is_found_turned_and_shifted(places, subtests):
    for yaw, x, y in [(0.0, 0.0, 0.0), (1.1, 6.0, -4.0), (np.pi, -9.0, 3.0)]:
        with subtests.test(yaw=yaw, x=x, y=y):
            index = PlaceIndex()
            for number, points in enumerate(places):
                index.add(number, PlaceImage.of(points))
            T = yaw_transform(x, y, 0.3, yaw)
            again = transform_points(inverse_transform(T), places[4][::2])
            best, second, *_ = index.candidates(PlaceImage.of(again), most=4)
            assert best.number == 4
            assert best.score > 1.4 * max(second.score, best.rival)
            off = inverse_transform(T) @ best.place_T_query
            assert np.linalg.norm(off[:3, 3]) < 1.5
            assert abs(yaw_of(off[:3, :3])) < np.deg2rad(3.1)


def test_heights_count_from_the_ground_of_a_slope(places):
    slope = places[2].copy()
    slope[:, 2] += 0.08 * slope[:, 0]
    index = PlaceIndex()
    index.add(0, PlaceImage.of(places[2]))
    (match,) = index.candidates(PlaceImage.of(slope))
    assert match.score > 0.8


def test_structure_is_shared_with_the_same_place_alone(places):
    one, half, other = (Structure.of(points) for points in (places[1], places[1][::2], places[6]))
    assert one.shared(half, np.eye(4)) > 0.7
    assert one.shared(half, yaw_transform(y=4.0)) < 0.5
    assert one.shared(other, np.eye(4)) < 0.5
    flat = Structure.of(np.column_stack([np.mgrid[:40, :40].reshape(2, -1).T, np.zeros(1600)]).astype(float))
    assert flat.shared(one, np.eye(4)) == 0.0
    assert flat.agreement(flat, np.eye(4)) is None
    same, moved = one.agreement(half, np.eye(4)), one.agreement(half, yaw_transform(y=4.0))
    assert same is not None
    assert moved is not None
    assert same > 0.7
    assert moved < 0.5


def test_no_places_no_points_and_numbers_twice():
    index = PlaceIndex()
    ground = PlaceImage.of(np.column_stack([np.mgrid[:9, :9].reshape(2, -1).T, np.zeros(81)]).astype(float))
    assert index.candidates(ground) == []
    index.add(3, ground)
    assert index.candidates(ground, among=[5]) == []
    assert index.candidates(ground)[0].score == 0.0  # bare ground looks like nothing
    with pytest.raises(InputError, match="number: expected a new place, 3 is known"):
        index.add(3, ground)
    with pytest.raises(InputError, match="expected points of a submap, got none"):
        PlaceImage.of(np.empty((0, 3)))
    with pytest.raises(InputError, match="expected a finite number"):
        PlaceImage.of(np.full((4, 3), np.nan))
