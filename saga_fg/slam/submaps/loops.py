"""Loops between poses of a graph, and their factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam

from factors import Robust, between_factor
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import pose_key


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """`second` seen from `first`, keyframes, submaps or their anchors: first_T_second (4, 4), covariance (6, 6) of its
    tangent.

    confirmed: by another loop or by its proof, where odometry says otherwise; it is under no robust loss
    """

    first: int
    second: int
    first_T_second: FloatArray
    covariance: FloatArray
    confirmed: bool = False


def loop_factors(
    loops: Sequence[LoopClosure], epochs: Sequence[int], robust: Robust | None
) -> list[gtsam.NonlinearFactor]:
    """Factors between the poses of `epochs`, by the numbers `first` and `second` of loops."""
    return [
        between_factor(
            pose_key(epochs[one.first]),
            pose_key(epochs[one.second]),
            one.first_T_second,
            one.covariance,
            None if one.confirmed else robust,
        )
        for one in loops
    ]
