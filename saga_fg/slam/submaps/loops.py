"""Loops between poses of a graph, and their factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from factors import Robust, between_factor
from saga_fg.errors import InputError
from saga_fg.graph import Additions, GraphView
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import checked_transform
from saga_fg.slam.mapping import pose_key


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """`second` seen from `first`, keyframes, submaps or their anchors: first_T_second (4, 4), covariance (6, 6) of its
    tangent.

    confirmed: by another loop or by its proof, where odometry says otherwise; it is under no robust loss
    Raises `InputError`, naming both ends, for what is no rigid transform, and for a covariance that is not positive
    definite.
    """

    first: int
    second: int
    first_T_second: FloatArray
    covariance: FloatArray
    confirmed: bool = False

    def __post_init__(self) -> None:
        name = f"loop from {self.first} to {self.second}"
        checked_transform(f"{name}: first_T_second", self.first_T_second)
        P = checked(f"{name}: covariance", self.covariance, (6, 6))
        if np.abs(P - P.T).max() > 1e-6 * np.abs(P).max() or np.linalg.eigvalsh((P + P.T) / 2)[0] <= 0:
            raise InputError(f"{name}: covariance: expected a symmetric matrix, positive definite")


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


@dataclass(frozen=True, eq=False)
class Loops:
    """Provider of loops, without a loss; `epochs` are those of the poses by their numbers `first` and `second`."""

    loops: Sequence[LoopClosure]
    epochs: Sequence[int]
    name: str = "loops"
    _by_epoch: dict[int, list[LoopClosure]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        for loop in self.loops:
            later = max(self.epochs[loop.first], self.epochs[loop.second])
            self._by_epoch.setdefault(later, []).append(loop)

    def factors(self, view: GraphView) -> Additions:
        return Additions(factors=loop_factors(self._by_epoch.get(view.epoch, ()), self.epochs, None))
