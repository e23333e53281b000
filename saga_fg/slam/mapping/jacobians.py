"""Observations of landmarks linearised, all of a kind together."""

from __future__ import annotations

import gtsam
import numpy as np

from factors import ResidualFactors, linearised
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.landmark import LandmarkType


def whitened_jacobians(
    kind: LandmarkType, rows: IntArray, observed: FloatArray, covariances: FloatArray, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals r (n, d), and their Jacobians (n, d, k) by the pose and (n, d, d) by the landmark, whitened.

    rows: (n, 2) keys of pose and landmark
    """
    factors = kind.factors(rows, observed, covariances)
    if not isinstance(factors, gtsam.NonlinearFactorGraph) and isinstance(factors[0], ResidualFactors):
        W, (by_pose, by_landmark), r = factors[0].linearisation(values)
        return (W @ r[:, :, None])[:, :, 0], W @ by_pose, W @ by_landmark
    if isinstance(factors, gtsam.NonlinearFactorGraph):
        linear = factors.linearize(values)
    else:
        linear = linearised(gtsam.NonlinearFactorGraph(), factors, values)
    k = kind.pose.dim
    each = [linear.at(row).jacobian() for row in range(len(rows))]
    return (
        np.stack([-b for _, b in each]),
        np.stack([A[:, :k] for A, _ in each]),
        np.stack([A[:, k:] for A, _ in each]),
    )
