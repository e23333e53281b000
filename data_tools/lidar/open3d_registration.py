"""Registration by Open3D's tensor ICP, in place of our Gauss-Newton loop: the same surfels, pairs by its own search.

The target is the mean and normal of each flat surfel; the estimate is point to plane under a Cauchy loss.
"""

from __future__ import annotations

import numpy as np

from data_tools.lidar.open3d_loader import load_open3d
from data_tools.lidar.surfels import SurfelMap
from saga_fg.numerics.arrays import FloatArray

_PRECISE = 1e-6  # relative change of fitness and residual at which it ends


def icp(
    points: FloatArray, surfels: SurfelMap, map_T_scan: FloatArray, farthest: float, scale: float, iterations: int
) -> tuple[FloatArray, int, bool]:
    """Return the pose (4, 4) of points (N, 3), the number of iterations, and whether they converged.

    map_T_scan: (4, 4) to begin with; farthest: m; scale: of the loss, m. Raises `MissingExtraError` without Open3D.
    """
    open3d = load_open3d()
    registration, tensor = open3d.t.pipelines.registration, open3d.core.Tensor
    flat = surfels.flat
    target = open3d.t.geometry.PointCloud(tensor(np.ascontiguousarray(flat.mean)))
    target.point.normals = tensor(np.ascontiguousarray(flat.normal))
    source = open3d.t.geometry.PointCloud(tensor(np.ascontiguousarray(points)))
    kernel = registration.robust_kernel
    loss = kernel.RobustKernel(kernel.RobustKernelMethod.CauchyLoss, scale, 1.0)
    found = registration.icp(
        source,
        target,
        farthest,
        tensor(np.ascontiguousarray(map_T_scan)),
        registration.TransformationEstimationPointToPlane(loss),
        registration.ICPConvergenceCriteria(_PRECISE, _PRECISE, iterations),
    )
    return found.transformation.numpy().astype(np.float64), int(found.num_iterations), bool(found.converged)
