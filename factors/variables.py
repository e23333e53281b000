"""Types of variables: how to read one from `gtsam.Values`, its dimension, how to move it.

A variable x lives on a manifold; x + delta means retract(x, delta), delta in R^dim. For vectors that is the sum, for
poses GTSAM's own retraction, so that Jacobians are taken in the coordinates in which GTSAM's solvers step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import gtsam
import numpy as np

from factors.errors import FactorError
from factors.validation import FloatArray, format_key


class Variable(Protocol):
    """A type of variable; states are whatever `read` returns."""

    @property
    def dim(self) -> int: ...

    def read(self, values: gtsam.Values, key: int) -> Any:
        """Return the state of `key`; GTSAM raises RuntimeError when there is none, or one of another type."""

    def retract(self, state: Any, delta: FloatArray) -> Any:
        """Return `state` moved by `delta` (dim,)."""

    def local(self, state: Any, other: Any) -> FloatArray:
        """Return the delta (dim,) from `state` to `other`."""

    def size(self, state: Any) -> FloatArray:
        """Return the magnitude (dim,) of each coordinate, which numerical differences choose their steps by."""

    def array(self, state: Any) -> FloatArray:
        """Return the state as numbers, for functions of many states at once."""


@dataclass(frozen=True)
class Vector:
    """A vector of R^dim; its states are read-only arrays of shape (dim,)."""

    dim: int

    def __post_init__(self) -> None:
        if isinstance(self.dim, bool) or not isinstance(self.dim, int | np.integer) or self.dim < 1:
            raise FactorError(f"dim: expected a positive integer, got {self.dim!r}")

    def read(self, values: gtsam.Values, key: int) -> FloatArray:
        state = values.atVector(key)
        if len(state) != self.dim:
            raise FactorError(f"{format_key(key)}: expected a vector of {self.dim} entries, got {len(state)}")
        state.flags.writeable = False  # a function that writes into its arguments would spoil the next one's
        return state

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        return state + delta

    def local(self, state: FloatArray, other: FloatArray) -> FloatArray:
        return other - state

    def size(self, state: FloatArray) -> FloatArray:
        return np.abs(state)

    def array(self, state: FloatArray) -> FloatArray:
        return state


class Manifold:
    """Steps of a variable of GTSAM's own, by GTSAM's retraction."""

    def retract(self, state: Any, delta: FloatArray) -> Any:
        return state.retract(delta)

    def local(self, state: Any, other: Any) -> FloatArray:
        return np.asarray(state.localCoordinates(other))


@dataclass(frozen=True)
class PlanarPose(Manifold):
    """A `gtsam.Pose2`; delta = (x, y, heading) in the pose's own frame; as numbers (3, 3)."""

    dim: ClassVar[int] = 3

    def read(self, values: gtsam.Values, key: int) -> gtsam.Pose2:
        return values.atPose2(key)

    def size(self, state: gtsam.Pose2) -> FloatArray:
        return np.ones(3)

    def array(self, state: gtsam.Pose2) -> FloatArray:
        return state.matrix()


@dataclass(frozen=True)
class SpatialPose(Manifold):
    """A `gtsam.Pose3`; delta = (rotation vector, translation) in the pose's own frame; as numbers (4, 4)."""

    dim: ClassVar[int] = 6

    def read(self, values: gtsam.Values, key: int) -> gtsam.Pose3:
        return values.atPose3(key)

    def size(self, state: gtsam.Pose3) -> FloatArray:
        return np.ones(6)

    def array(self, state: gtsam.Pose3) -> FloatArray:
        return state.matrix()


@dataclass(frozen=True)
class ImuBias(Manifold):
    """A `gtsam.imuBias.ConstantBias`; delta = (of accelerometers, m/s^2, of gyroscopes, rad/s), as numbers the same."""

    dim: ClassVar[int] = 6

    def read(self, values: gtsam.Values, key: int) -> gtsam.imuBias.ConstantBias:
        return values.atConstantBias(key)

    def size(self, state: gtsam.imuBias.ConstantBias) -> FloatArray:
        return np.abs(state.vector())

    def array(self, state: gtsam.imuBias.ConstantBias) -> FloatArray:
        return state.vector()


def read_states(values: gtsam.Values, keys: Sequence[int], variables: Sequence[Variable]) -> list[Any]:
    """Return the states of `keys`; raise `FactorError` for a missing one or one of another type or dimension."""
    try:
        return [variable.read(values, key) for key, variable in zip(keys, variables, strict=True)]
    except RuntimeError as error:
        missing = [key for key in keys if not values.exists(key)]
        reason = f"has no {format_key(missing[0])}" if missing else f"holds another type of variable: {error}"
        raise FactorError(f"values {reason}") from error
