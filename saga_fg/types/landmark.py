"""Types of landmarks: the variable, its factors, and its initial state.

A new type of landmark is one object with these members; association, filtering, smoothing, merging and output follow
from them. `docs/guides/add-a-landmark.md` adds one.

    state      `variable`: reading from `gtsam.Values`, retraction and difference
    predict    `factors`: residual and covariance of an observation against the map, which gates and filter linearise
    initialise the state of a landmark from its first observation

An observation must determine its landmark: as many residuals as the state has dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from saga_fg.numerics.arrays import FloatArray, IntArray, checked, checked_covariances

if TYPE_CHECKING:  # frames bring observations of landmarks, and are read before anything is estimated
    import gtsam

    from factors import PlanarPose, ResidualFactors, SpatialPose, Variable

LandmarkFactors: TypeAlias = "Sequence[ResidualFactors | gtsam.NonlinearFactor]"


class LandmarkType(Protocol):
    """A type of stationary object."""

    @property
    def name(self) -> str:
        """Name in messages and files."""

    @property
    def pose(self) -> PlanarPose | SpatialPose:
        """The type of pose that observes it."""

    @property
    def variable(self) -> Variable:
        """The type of its state."""

    @property
    def density(self) -> float:
        """Expected number per unit of its tangent, e.g. 1/m^2, for the odds of a new landmark in association."""

    def factors(self, rows: IntArray, observed: FloatArray, covariances: FloatArray) -> LandmarkFactors:
        """Return n factors, in this order: rows (n, 2) keys of pose and landmark, observed (n, m), covariances
        (n, d, d).
        """

    def initialise(self, world_T_pose: FloatArray, observed: FloatArray) -> Any:
        """Return the state of a landmark by an observation (m,) from a pose, given as a matrix."""

    def coordinates(self, state: Any) -> dict[str, float]:
        """Return the numbers of a state for files, by name; among them "x" and "y", m, for drawings."""


@dataclass(frozen=True, eq=False)
class Observation:
    """kind: of the landmark; value: (m,) what was measured, in the frame of the pose; covariance: (d, d) of the
    residuals; extent: (2, 3) ends of the piece of a wall or line that was seen, m, in that frame, None where unknown.
    """

    kind: LandmarkType
    value: FloatArray
    covariance: FloatArray
    extent: FloatArray | None = None

    def __post_init__(self) -> None:
        d = self.kind.variable.dim
        value = checked(f"observed {self.kind.name}", self.value, (None,))
        covariance = checked_covariances(f"covariance of a {self.kind.name}", [self.covariance], 1, d)[0]
        extent = None if self.extent is None else checked(f"extent of a {self.kind.name}", self.extent, (2, 3))
        vars(self).update(value=value, covariance=covariance, extent=extent)


@dataclass(frozen=True, eq=False)
class Landmark:
    """A landmark of the map: its state, the covariance (d, d) of that, and the number of its observations."""

    number: int
    kind: LandmarkType
    state: Any
    covariance: FloatArray
    observations: int
    confirmed: bool
