"""Geometry of LiDAR scans beside Open3D's, on the same points: what is kept of our own, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial import cKDTree

from benchmarks.runner import Rows, in_turn
from data_tools.datasets.kitti import kitti_scans
from data_tools.lidar import (
    PlaceImage,
    PlaceIndex,
    PlaceMatch,
    SurfelMap,
    clusters_from_above,
    extract_walls,
    load_open3d,
    register,
    segment_ground,
    surfels_of,
    voxel_downsample,
)
from pipelines.slam.odometry import LidarOdometry
from saga_fg.numerics import FloatArray, inverse_transform, transform_points, yaw_transform

_MAP, _SCAN, _SURFEL = 0.25, 1.5, 1.0  # m: spacings and voxels of LiDAR odometry
_BEFORE, _EVERY = 12, 5  # scans that make a map, and steps between those compared
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
    dataroot: Annotated[Path, typer.Option("--dataroot", help="KITTI tracking.")],
    sequence: Annotated[str, typer.Option("--sequence", help="A sequence with LiDAR scans.")] = "0000",
) -> Rows:
    """Thinning, neighbours, normals, ground, walls, clusters and registration of LiDAR scans: ours and Open3D's.

    Registration is that of a scan with the map of those before, from a start that is off by 0.3 m, with the map's
    surfels or normals. Errors are the distances from the pose by LiDAR odometry.

    \b
    Example:
      python -m benchmarks geometry --dataroot data/kitti
    """
    open3d, recorded, odometry = load_open3d(), kitti_scans(dataroot, sequence), LidarOdometry()
    placed = [odometry.step(recorded[k], float(time)) for k, time in enumerate(recorded.timestamps)]
    cases, off = [], dict[str, list[float]](ours=[], theirs=[])
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
    registration = open3d.t.pipelines.registration
    kernel = registration.robust_kernel.RobustKernel(registration.robust_kernel.RobustKernelMethod.CauchyLoss, 0.1)
    estimation = registration.TransformationEstimationPointToPlane(kernel)
    stop = registration.ICPConvergenceCriteria(1e-6, 1e-6, 30)

    def ours(case: _Case) -> None:
        surfels = SurfelMap(_SURFEL, np.inf)
        surfels.add(case.map_points, np.zeros(3))
        off["ours"].append(float(np.linalg.norm(register(case.thin, surfels, _START, 1.3, 0.1).map_T_scan[:3, 3])))

    def theirs(case: _Case) -> None:
        target = case.clouds["map_points"].clone()
        target.estimate_normals(30, _SURFEL)
        found = registration.icp(case.clouds["thin"], target, 1.0, _START, estimation, stop)
        off["theirs"].append(float(np.linalg.norm(found.transformation.numpy()[:3, 3])))

    def nearest(case: _Case) -> None:
        search = open3d.core.nns.NearestNeighborSearch(case.clouds["map_points"].point.positions)
        search.knn_index()
        search.knn_search(case.clouds["thin"].point.positions, 1)

    kinds: dict[str, tuple[Callable[[_Case], Any], Callable[[_Case], Any]]] = {
        "thinning to 0.25 m": (
            lambda case: voxel_downsample(case.points, _MAP),
            lambda case: case.clouds["points"].voxel_down_sample(_MAP),
        ),
        "nearest neighbours": (lambda case: cKDTree(case.map_points).query(case.thin), nearest),
        "normals of a map": (
            lambda case: surfels_of(case.map_points, _SURFEL),
            lambda case: case.clouds["map_points"].clone().estimate_normals(30, _SURFEL),
        ),
        "ground": (
            lambda case: segment_ground(case.points),
            lambda case: case.clouds["points"].segment_plane(0.2, 3, 100),
        ),
        "walls": (
            lambda case: extract_walls(case.standing),
            lambda case: _patches(case.clouds["standing"]),
        ),
        "clusters": (
            lambda case: clusters_from_above(case.standing, 0.2),
            lambda case: case.clouds["standing"].cluster_dbscan(0.3, 4),
        ),
        "registration": (ours, theirs),
        "alignment without a guess": (
            lambda case: _aligned(case.map_points, case.points),
            lambda case: _aligned_by_features(case.clouds["points"], case.clouds["map_points"]),
        ),
    }
    for name, (mine, other) in kinds.items():
        contenders = {"saga-fg": partial(partial, mine), "Open3D": partial(partial, other)}
        ms = {who: float(np.median(spent)) for who, spent in in_turn(contenders, cases, 1).items()}
        errors = {f"off, mm: {who}": 1e3 * float(np.median(found)) for who, found in off.items() if found}
        yield "geometry of scans, ms", {"of": name, **ms, "ratio": ms["Open3D"] / ms["saga-fg"], **errors}


def _patches(cloud: Any) -> Any:
    legacy = cloud.to_legacy()
    legacy.estimate_normals()
    return legacy.detect_planar_patches(60, 75, 0.75, 0.0, 0)


def _aligned(place: FloatArray, points: FloatArray) -> PlaceMatch:
    index = PlaceIndex()
    index.add(0, PlaceImage.of(place))
    return index.aligned(PlaceImage.of(points), [0])[0]


def _aligned_by_features(source: Any, target: Any) -> Any:
    """FPFH and fast global registration."""
    module = load_open3d()
    register_by, search = module.pipelines.registration, module.geometry.KDTreeSearchParamHybrid
    clouds = [cloud.to_legacy().voxel_down_sample(1.0) for cloud in (source, target)]
    for cloud in clouds:
        cloud.estimate_normals(search(2.0, 30))
    features = [register_by.compute_fpfh_feature(cloud, search(5.0, 100)) for cloud in clouds]
    option = register_by.FastGlobalRegistrationOption(maximum_correspondence_distance=1.5)
    return register_by.registration_fgr_based_on_feature_matching(*clouds, *features, option)
