"""Manifolds of variables: their types, rotations, and Jacobians by central differences.

Types of variables: how to read one from `gtsam.Values`, its dimension, how to move it.

A variable x lives on a manifold; x + delta means retract(x, delta), delta in R^dim. For vectors that is the sum, for
poses GTSAM's own retraction, so that Jacobians are taken in the coordinates in which GTSAM's solvers step.

The exponential map of rotations and its derivative, for many at once.

    Log(R) = theta u,     Log(R Exp(d)) = Log(R) + Jr^-1(Log R) d + O(d^2)
    Jr^-1(w) = 1 + [w]x / 2 + (1 / theta^2 - (1 + cos theta) / (2 theta sin theta)) [w]x^2

Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018, equations 132 and 144.

Jacobians by central differences, on any manifold.

    J e_i = ( f(x + h_i e_i) - f(x - h_i e_i) ) / (2 h_i),      h_i = (eps max(1, |x_i|))^(1/3)

The truncation error is h^2 f''' / 6, the rounding error eps |f| / h; with |f| like |x| and f''' of order one this h
balances them, leaving about 1e-10 near the origin and 1e-8 a kilometre away.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from factors.validation import FactorError, FloatArray, format_key


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

    def array(self, state: FloatArray) -> FloatArray:
        return state


class Manifold:
    """A variable of GTSAM's own: how `gtsam.Values` gives it, what gives its numbers, and GTSAM's retraction."""

    dim: ClassVar[int]
    at: ClassVar[str]
    numbers: ClassVar[str]

    def read(self, values: gtsam.Values, key: int) -> Any:
        return getattr(values, self.at)(key)

    def retract(self, state: Any, delta: FloatArray) -> Any:
        return state.retract(delta)

    def local(self, state: Any, other: Any) -> FloatArray:
        return np.asarray(state.localCoordinates(other))

    def array(self, state: Any) -> FloatArray:
        return np.asarray(getattr(state, self.numbers)())


@dataclass(frozen=True)
class PlanarPose(Manifold):
    """A `gtsam.Pose2`; delta = (x, y, heading) in the pose's own frame; as numbers (3, 3)."""

    dim, at, numbers = 3, "atPose2", "matrix"


@dataclass(frozen=True)
class SpatialPose(Manifold):
    """A `gtsam.Pose3`; delta = (rotation vector, translation) in the pose's own frame; as numbers (4, 4)."""

    dim, at, numbers = 6, "atPose3", "matrix"


@dataclass(frozen=True)
class ImuBias(Manifold):
    """A `gtsam.imuBias.ConstantBias`; delta = (of accelerometers, m/s^2, of gyroscopes, rad/s), as numbers the same."""

    dim, at, numbers = 6, "atConstantBias", "vector"


@dataclass(frozen=True)
class OrientedPlane(Manifold):
    """A `gtsam.OrientedPlane3`; delta = (two turns of the normal, rad; distance, m); as numbers (4,): n, d."""

    dim, at, numbers = 3, "atOrientedPlane3", "planeCoefficients"


def read_states(values: gtsam.Values, keys: Sequence[int], variables: Sequence[Variable]) -> list[Any]:
    """Return the states of `keys`; raise `FactorError` for a missing one or one of another type or dimension."""
    try:
        return [variable.read(values, key) for key, variable in zip(keys, variables, strict=True)]
    except RuntimeError as error:
        missing = [key for key in keys if not values.exists(key)]
        reason = f"has no {format_key(missing[0])}" if missing else f"holds another type of variable: {error}"
        raise FactorError(f"values {reason}") from error


_SMALL = 1e-4  # rad, below which a series does


def cross_matrix(vector: FloatArray) -> FloatArray:
    """[v]x (..., 3, 3) of vectors (..., 3): [v]x w = v x w."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)


def rotation_log(rotation: FloatArray) -> FloatArray:
    """Rotation vectors (N, 3), rad, of rotation matrices (N, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def rotation_exp(vector: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), rad."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def inverse_right_jacobian(vector: FloatArray) -> FloatArray:
    """Jr^-1 (N, 3, 3) at rotation vectors (N, 3) shorter than 2 pi."""
    theta = np.linalg.norm(vector, axis=-1)
    safe = np.where(theta < _SMALL, 1.0, theta)
    factor = 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe))
    factor = np.where(theta < _SMALL, 1 / 12 + theta**2 / 720, factor)
    W = cross_matrix(vector)
    return np.asarray(np.eye(3) + W / 2 + factor[..., None, None] * (W @ W))


def central_differences(
    function: Callable[..., ArrayLike], states: Sequence[Any], variables: Sequence[Variable]
) -> list[FloatArray]:
    """Return the Jacobian (..., m, d_k) of `function(*states)`, (..., m), with respect to each state.

    Vectors may be many at once, (..., d_k), where an entry of the function's value depends on the same entry of its
    arguments alone.
    """
    jacobians = []
    for k, (state, variable) in enumerate(zip(states, variables, strict=True)):
        size = np.abs(state) if isinstance(state, np.ndarray) else np.ones(variable.dim)
        steps = np.cbrt(np.finfo(float).eps * np.maximum(1.0, size))
        columns = []
        for i in range(variable.dim):
            delta, ahead, behind = np.zeros_like(steps), list(states), list(states)
            delta[..., i] = steps[..., i]
            ahead[k], behind[k] = variable.retract(state, delta), variable.retract(state, -delta)
            columns.append((np.asarray(function(*ahead)) - np.asarray(function(*behind))) / (2 * steps[..., i, None]))
        jacobians.append(np.stack(columns, axis=-1))
    return jacobians


def wrap_angles(residual: FloatArray, components: Sequence[int]) -> FloatArray:
    """Return `residual` (..., m) with these components, angles in rad, brought into [-pi, pi)."""
    if not components:
        return residual
    wrapped = residual.copy()
    for i in components:
        wrapped[..., i] = (residual[..., i] + np.pi) % (2 * np.pi) - np.pi
    return wrapped
