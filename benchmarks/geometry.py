"""Geometry of LiDAR scans beside Open3D's, on the same points: what is kept of our own, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from scipy.spatial import cKDTree

from benchmarks.course import SimulatedCourse, revisits
from benchmarks.loops import FALSE, PERIOD
from benchmarks.runner import Row, Rows, in_turn
from data_tools.datasets.kitti import kitti_scans
from data_tools.lidar import (
    PlaceImage,
    PlaceIndex,
    ScanSequence,
    SurfelMap,
    clusters_from_above,
    extract_walls,
    load_open3d,
    register,
    segment_ground,
    surfels_of,
    voxel_downsample,
)
from pipelines.slam.loop_closures import SPACING, registered
from pipelines.slam.odometry import LidarOdometry
from saga_fg import InputError
from saga_fg.numerics import FloatArray, inverse_transform, transform_points, yaw_transform

_MAP, _SCAN, _SURFEL = 0.25, 1.5, 1.0  # m: spacings and voxels of LiDAR odometry
_BEFORE, _EVERY = 12, 5  # scans that make a map, and steps between those compared
_APART, _AROUND = 60.0, 8  # m of way between submaps of one place; scans of them before and after their middle
OURS = "saga-fg"
T = TypeVar("T")
_Pair = tuple[FloatArray, FloatArray]
_START = yaw_transform(0.25, -0.15, 0.05, 0.01)  # errors of the start of a registration


@dataclass(frozen=True, eq=False)
class _Case:
    """Points (N, 3) of a scan, those above the ground, thinned ones and those of a map in its frame, also as Open3D's
    clouds."""

    points: FloatArray
    standing: FloatArray
    thin: FloatArray
    map_points: FloatArray
    clouds: dict[str, Any]


def geometry(
    dataroot: Annotated[Path | None, typer.Option("--dataroot", help="KITTI tracking.")] = None,
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
    course: Annotated[
        int | None, typer.Option("--course", help="In place of scans: submaps of the simulated drive of a seed.")
    ] = None,
) -> Rows:
    """Thinning, neighbours, normals, ground, walls, clusters and registration of LiDAR scans: ours and Open3D's.

    Registration is that of a scan with the map of those before, from a start that is off by 0.3 m, with the map's
    surfels, normals or covariances. Errors are the distances from the pose by LiDAR odometry.

    With --course, submaps of one place are registered without a guess: aligned as images from above, as loops are, or
    by features (FPFH); the second step is the same. Errors are those of the simulated poses.

    \b
    Examples:
      python -m benchmarks geometry --dataroot data/kitti
      python -m benchmarks geometry --course 2
    """
    if (dataroot is None) == (course is None):
        raise InputError("expected either --dataroot or --course")
    if course is not None:
        places, truths = _places(course)
        ways: dict[str, Callable[[_Pair], Any]] = {
            OURS: _aligned,
            "FPFH, fast global": partial(_by_features, fast=True),
            "FPFH, RANSAC": partial(_by_features, fast=False),
        }
        yield from _compared("submaps of one place", ways, places, truths)
        return
    cases = _cases(kitti_scans(dataroot or Path(), sequence))
    for name, contenders in _contenders().items():
        yield from _compared(name, contenders, cases, [np.eye(4)] * len(cases) if name == "registration" else ())


def _cases(recorded: ScanSequence) -> list[_Case]:
    """Every few scans with the map of those before."""
    open3d, odometry, cases = load_open3d(), LidarOdometry(), list[_Case]()
    placed = [odometry.step(recorded[k], float(time)) for k, time in enumerate(recorded.timestamps)]
    for k in range(_BEFORE, len(placed), _EVERY):
        points = placed[k].scan.points
        inverse = inverse_transform(placed[k].map_T_lidar)
        before = [transform_points(inverse @ one.map_T_lidar, one.scan.points) for one in placed[k - _BEFORE : k]]
        around = np.concatenate(before)
        arrays = {"points": points, "standing": points[~segment_ground(points).is_ground]}
        arrays["map_points"] = around[voxel_downsample(around, _MAP)]
        arrays["thin"] = points[voxel_downsample(points, _SCAN)]
        clouds = {name: open3d.t.geometry.PointCloud(open3d.core.Tensor(one)) for name, one in arrays.items()}
        cases.append(_Case(**arrays, clouds=clouds))
    return cases


def _contenders() -> dict[str, dict[str, Callable[[_Case], Any]]]:
    """What does each operation; of a registration, with its pose (4, 4)."""
    open3d = load_open3d()
    tensor, legacy = open3d.t.pipelines.registration, open3d.pipelines.registration
    kernel = tensor.robust_kernel.RobustKernel(tensor.robust_kernel.RobustKernelMethod.CauchyLoss, 0.1)

    def ours(case: _Case) -> FloatArray:
        surfels = SurfelMap(_SURFEL, np.inf)
        surfels.add(case.map_points, np.zeros(3))
        return register(case.thin, surfels, _START, 1.3, 0.1).map_T_scan

    def by_planes(case: _Case) -> Any:
        target = case.clouds["map_points"].clone()
        target.estimate_normals(30, _SURFEL)
        to_planes = tensor.TransformationEstimationPointToPlane(kernel)
        stop = tensor.ICPConvergenceCriteria(1e-6, 1e-6, 30)
        return tensor.icp(case.clouds["thin"], target, 1.0, _START, to_planes, stop).transformation.numpy()

    def generalised(case: _Case) -> Any:
        clouds = [case.clouds[name].to_legacy() for name in ("thin", "map_points")]
        return legacy.registration_generalized_icp(*clouds, 1.0, _START).transformation

    def nearest(case: _Case) -> None:
        search = open3d.core.nns.NearestNeighborSearch(case.clouds["map_points"].point.positions)
        search.knn_index()
        search.knn_search(case.clouds["thin"].point.positions, 1)

    return {
        "thinning to 0.25 m": {
            OURS: lambda case: voxel_downsample(case.points, _MAP),
            "voxel_down_sample": lambda case: case.clouds["points"].voxel_down_sample(_MAP),
        },
        "nearest neighbours": {
            "SciPy": lambda case: cKDTree(case.map_points).query(case.thin),
            "NearestNeighborSearch": nearest,
        },
        "normals of a map": {
            OURS: lambda case: surfels_of(case.map_points, _SURFEL),
            "estimate_normals": lambda case: case.clouds["map_points"].clone().estimate_normals(30, _SURFEL),
            "estimate_covariances": lambda case: case.clouds["map_points"].to_legacy().estimate_covariances(),
        },
        "ground": {
            OURS: lambda case: segment_ground(case.points),
            "segment_plane": lambda case: case.clouds["points"].segment_plane(0.2, 3, 100),
        },
        "walls": {
            OURS: lambda case: extract_walls(case.standing),
            "detect_planar_patches": lambda case: _patches(case.clouds["standing"]),
        },
        "clusters": {
            OURS: lambda case: clusters_from_above(case.standing, 0.2),
            "cluster_dbscan": lambda case: case.clouds["standing"].cluster_dbscan(0.3, 4),
        },
        "registration": {OURS: ours, "tensor ICP, planes": by_planes, "generalised ICP": generalised},
    }


def _compared(
    of: str, contenders: Mapping[str, Callable[[T], Any]], cases: Sequence[T], truths: Sequence[FloatArray]
) -> Iterator[Row]:
    """A row for each contender: its time, and where the true poses (4, 4) are given how far its own are off."""
    found: dict[str, list[Any]] = {who: [] for who in contenders}

    def prepared(who: str, run: Callable[[T], Any]) -> Callable[[T], Callable[[], None]]:
        return lambda case: lambda: found[who].append(run(case))

    times = in_turn({who: prepared(who, run) for who, run in contenders.items()}, cases, 1)
    first = float(np.median(next(iter(times.values()))))
    for who, spent in times.items():
        ms = float(np.median(spent))
        off = [
            np.linalg.norm((inverse_transform(true) @ T)[:3, 3]) for T, true in zip(found[who], truths, strict=False)
        ]
        errors = {"off, mm": 1e3 * float(np.median(off)), "right": float(np.mean(np.array(off) < FALSE))} if off else {}
        yield "geometry of scans", {"of": of, "by": who, "ms": ms, "ratio": ms / first, **errors}


def _patches(cloud: Any) -> Any:
    legacy = cloud.to_legacy()
    legacy.estimate_normals()
    return legacy.detect_planar_patches(60, 75, 0.75, 0.0, 0)


def _places(seed: int) -> tuple[list[_Pair], list[FloatArray]]:
    """Points (N, 3) of two submaps of each stretch that a course drives again, and the second one's true pose."""
    course = SimulatedCourse(seed, period=PERIOD, skewed=False)
    lidar = course.world_T_ego @ course.ego_T_lidar
    pairs, truths = list[_Pair](), list[FloatArray]()
    for start, end in revisits(course.world_T_ego):
        new = (start + end) // 2
        before = np.flatnonzero(course.distance < course.distance[new] - _APART)
        old = int(before[np.linalg.norm(lidar[before, :2, 3] - lidar[new, :2, 3], axis=1).argmin()])
        pairs.append((_submap(course, lidar, old), _submap(course, lidar, new)))
        truths.append(inverse_transform(lidar[old]) @ lidar[new])
    return pairs, truths


def _submap(course: SimulatedCourse, lidar: FloatArray, row: int) -> FloatArray:
    """Points (N, 3) of the scans around a row, in its frame."""
    inverse = inverse_transform(lidar[row])
    around = range(max(0, row - _AROUND), min(len(course), row + _AROUND + 1))
    points = np.concatenate([transform_points(inverse @ lidar[k], course[k].points) for k in around])
    return points[voxel_downsample(points, _MAP)]


def _aligned(pair: _Pair) -> FloatArray:
    """As loops are: aligned by their images from above, then registered."""
    index = PlaceIndex()
    index.add(0, PlaceImage.of(pair[0]))
    return _refined(pair, index.aligned(PlaceImage.of(pair[1]), [0])[0].place_T_query)


def _by_features(pair: _Pair, fast: bool) -> FloatArray:
    """FPFH with fast global registration or RANSAC, then registered."""
    module = load_open3d()
    module.utility.random.seed(0)
    by, search = module.pipelines.registration, module.geometry.KDTreeSearchParamHybrid
    clouds = [
        module.geometry.PointCloud(module.utility.Vector3dVector(one)).voxel_down_sample(1.0) for one in pair[::-1]
    ]
    for cloud in clouds:
        cloud.estimate_normals(search(2.0, 30))
    features = [by.compute_fpfh_feature(cloud, search(5.0, 100)) for cloud in clouds]
    if fast:
        option = by.FastGlobalRegistrationOption(maximum_correspondence_distance=1.5)
        found = by.registration_fgr_based_on_feature_matching(*clouds, *features, option)
    else:
        found = by.registration_ransac_based_on_feature_matching(*clouds, *features, True, 1.5)
    return _refined(pair, found.transformation)


def _refined(pair: _Pair, old_T_new: FloatArray) -> FloatArray:
    fine = registered(pair[0], pair[1][voxel_downsample(pair[1], SPACING)], old_T_new, "follow")
    return old_T_new if fine is None else fine.map_T_scan
