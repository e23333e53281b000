"""Places: the same one is found however it lies, and nothing is found where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.course import SimulatedCourse
from data_tools.lidar.places import PlaceImage, PlaceIndex, Structure
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_of, yaw_transform


def submap(course: SimulatedCourse, way: float, length: float = 30.0) -> FloatArray:
    """Points of a piece of the drive, in the frame of its first scan."""
    rows = np.flatnonzero((course.distance >= way) & (course.distance < way + length))[::8]
    back = inverse_transform(course.world_T_ego[rows[0]])
    return np.concatenate([transform_points(back @ course.world_T_ego[k], course[int(k)].points) for k in rows])


@pytest.fixture(scope="module")
def places() -> list[FloatArray]:
    course = SimulatedCourse(0, length=700.0, skewed=False)
    return [submap(course, way) for way in np.arange(0.0, 660.0, 60.0)]


def test_a_place_is_found_turned_and_shifted(places: list[FloatArray], subtests: pytest.Subtests) -> None:
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


def test_heights_count_from_the_ground_of_a_slope(places: list[FloatArray]) -> None:
    slope = places[2].copy()
    slope[:, 2] += 0.08 * slope[:, 0]
    index = PlaceIndex()
    index.add(0, PlaceImage.of(places[2]))
    (match,) = index.candidates(PlaceImage.of(slope))
    assert match.score > 0.8


def test_structure_is_shared_with_the_same_place_alone(places: list[FloatArray]) -> None:
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


def test_no_places_no_points_and_numbers_twice() -> None:
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
