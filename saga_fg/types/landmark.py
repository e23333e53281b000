"""What a landmark is to the map: a type of variable, its factors, and where one is when first seen.

A new type of landmark is one object with these members; association, filtering, smoothing, merging and output follow
from them. `docs/guides/add-a-landmark.md` adds one.

    state      `variable`: how it is read from `gtsam.Values`, moved and compared
    predict    `factors`: their residual is how far an observation is off what the map predicts, their covariance how
               far it may be; linearised they are all that the gates and the filter need
    initialise where a landmark stands by one observation alone

An observation must determine its landmark: as many residuals as the state has dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gtsam

from factors import Linearisable, PlanarPose, SpatialPose, Variable
from saga_fg.numerics.arrays import FloatArray, IntArray, checked, checked_covariances

LandmarkFactors = Sequence[Linearisable] | gtsam.NonlinearFactorGraph


class LandmarkType(Protocol):
    """A kind of thing that stands."""

    @property
    def name(self) -> str:
        """What it is called in messages and files."""

    @property
    def pose(self) -> PlanarPose | SpatialPose:
        """The type of pose it is seen from."""

    @property
    def variable(self) -> Variable:
        """The type of its state."""

    @property
    def density(self) -> float:
        """How many of its kind to expect per unit of its tangent, e.g. 1/m^2: what a new one competes with."""

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> LandmarkFactors:
        """Return n factors, in this order: rows (n, 2) keys of pose and landmark, observed (n, m), covariances
        (n, d, d).
        """

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> Any:
        """Return the state that an observation (m,) from a pose, as a matrix, says."""

    def coordinates(self, state: Any) -> dict[str, float]:
        """Return the numbers by which a state is written to files, by name; among them "x" and "y", m, where to draw
        it.
        """


@dataclass(frozen=True, eq=False)
class Observation:
    """kind: of the landmark; value: (m,) what was measured, in the frame of the pose; covariance: (d, d) of the
    residuals.
    """

    kind: LandmarkType
    value: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        d = self.kind.variable.dim
        value = checked(f"observed {self.kind.name}", self.value, (None,))
        covariance = checked_covariances(f"covariance of a {self.kind.name}", [self.covariance], 1, d)[0]
        vars(self).update(value=value, covariance=covariance)


@dataclass(frozen=True, eq=False)
class Landmark:
    """A landmark of the map: its state, the covariance (d, d) of that, and the number of its observations."""

    number: int
    kind: LandmarkType
    state: Any
    covariance: FloatArray
    observations: int
    confirmed: bool
