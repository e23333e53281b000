"""Loops by place: found after much drift, and only where the vehicle came back."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.course import SimulatedCourse
from benchmarks.scans import SMALL, StaticWorld, simulate_scan
from data_tools.lidar import Submap, voxel_downsample
from pipelines.slam.loop_closures import PlaceLoops
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points, yaw_transform
from saga_fg.types.boxes import Boxes


@pytest.fixture(scope="module")
def drive() -> tuple[list[Submap], FloatArray]:
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
        submaps.append(Submap(number, (number, number + 1), number, np.eye(4), points, (way, way + 30.0)))
        frames.append(frame)
    return submaps, np.array(frames)


def test_loops_are_found_with_drift(drive: tuple[list[Submap], FloatArray], subtests: pytest.Subtests) -> None:
    for drift in [1.0, 10.0, 30.0]:
        with subtests.test(drift=drift):
            submaps, true = drive
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


def test_far_off_a_loop_waits_for_another(drive: tuple[list[Submap], FloatArray]) -> None:
    submaps, true = drive
    estimated = true.copy()
    estimated[6:, :2, 3] += 95.0
    search = PlaceLoops()
    found = [len(search.add(one, estimated[: k + 1])) for k, one in enumerate(submaps)]
    assert found[:7] == [0] * 7
    assert found[7] >= 2


def test_row_houses_are_no_place() -> None:
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
        submaps.append(Submap(number, (number, number + 1), number, np.eye(4), points, (start, start + 16.0)))
        frames.append(yaw_transform(10.0 * number, z=1.8))  # an odometry that says that the vehicle came back
    search = PlaceLoops()
    assert [len(search.add(one, np.array(frames[: k + 1]))) for k, one in enumerate(submaps)] == [0, 0]


def test_a_submap_without_points_has_no_loops(drive: tuple[list[Submap], FloatArray]) -> None:
    submaps, true = drive
    search = PlaceLoops()
    assert search.add(submaps[0], true[:1]) == []
    bare = Submap(1, (1, 2), 1, np.eye(4), np.empty((0, 3), dtype=np.float32), (30.0, 60.0))
    assert search.add(bare, true[:2]) == []
