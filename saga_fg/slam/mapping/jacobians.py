"""Observations of landmarks linearised, all of a kind together."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from factors import ResidualFactors, linearised, pose
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.landmark import LandmarkType, Observation

_OPEN = 1e-9  # smallest singular value over the largest one of what determines a landmark


def whitened_jacobians(
    kind: LandmarkType, rows: IntArray, observed: FloatArray, covariances: FloatArray, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals r (n, d), and their Jacobians (n, d, k) by the pose and (n, d, d) by the landmark, whitened.

    rows: (n, 2) keys of pose and landmark. Raises `InputError` naming the type for what its factors refuse.
    """
    try:
        return _linearised(kind, rows, observed, covariances, values)
    except Exception as error:
        raise refused(kind, observed[0], error) from error


def first_seen(observation: Observation, world_T_pose: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """The state of a landmark by its first observation, A_l^-1 (d, d) and A_p (d, k) there.

    Raises `InputError` naming the components of the state that the observation leaves open.
    """
    kind, values = observation.kind, gtsam.Values()
    state = initial_state(observation, world_T_pose)
    values.insert(0, pose("world_T_pose", world_T_pose))
    values.insert(1, state)
    one = (np.array([[0, 1]]), observation.value[None], observation.covariance[None])
    _, (by_pose,), (by_landmark,) = whitened_jacobians(kind, *one, values)
    _, sizes, directions = np.linalg.svd(by_landmark)
    known = np.sum(sizes > _OPEN * sizes[0])
    if known < kind.variable.dim:
        left = np.flatnonzero(np.abs(directions[known:]).max(axis=0) > 0.1).tolist()
        raise InputError(
            f"{kind.name} observed as {observation.value.tolist()}: components {left} of its state are not determined; "
            f"expected an observation of all {kind.variable.dim}, or another landmark type that has only those observed"
        )
    return state, np.linalg.inv(by_landmark), by_pose


def initial_state(observation: Observation, world_T_pose: FloatArray) -> Any:
    """The state of a landmark by an observation. Raises `InputError` naming the type for what that refuses."""
    try:
        return observation.kind.initialise(world_T_pose, observation.value)
    except Exception as error:
        raise refused(observation.kind, observation.value, error) from error


def refused(kind: LandmarkType, observed: FloatArray, error: Exception) -> InputError:
    """Name the type and the observation in an error of the type's own."""
    if isinstance(error, InputError):
        return error
    text = " ".join((str(error) if isinstance(error, ValueError) else repr(error)).split())
    return InputError(f"{kind.name} observed as {observed.tolist()}, which its type cannot read: {text}")


def _linearised(
    kind: LandmarkType, rows: IntArray, observed: FloatArray, covariances: FloatArray, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
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
