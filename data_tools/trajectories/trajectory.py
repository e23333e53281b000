"""A trajectory: poses of the vehicle at increasing times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked
from saga_fg.numerics.geometry import is_rotation

_ORTHONORMAL = 1e-4  # largest allowed entry of R R^T - 1, as in `checked_transform`


@dataclass(frozen=True, eq=False)
class Trajectory:
    """n poses of the vehicle, n >= 1.

    timestamps   (n,) s, strictly increasing
    world_T_ego  (n, 4, 4) rigid transforms, lengths in m

    Raises `InputError` naming the record: a time that does not increase, a matrix that is not rigid.
    """

    timestamps: FloatArray
    world_T_ego: FloatArray

    def __post_init__(self) -> None:
        timestamps = checked("timestamps", self.timestamps, (None,))
        poses = checked("world_T_ego", self.world_T_ego, (len(timestamps), 4, 4))
        if not len(timestamps):
            raise InputError("timestamps: expected at least one pose")
        late = np.diff(timestamps) <= 0
        if late.any():
            k = int(np.argmax(late)) + 1
            raise InputError(
                f"timestamps[{k}]: expected increasing times, got {timestamps[k]:.6f} s after {timestamps[k - 1]:.6f} s"
            )
        askew = ~is_rotation(poses[:, :3, :3], _ORTHONORMAL)
        askew |= (np.abs(poses[:, 3] - [0, 0, 0, 1]) > 1e-9).any(axis=1)
        if askew.any():
            k = int(np.argmax(askew))
            raise InputError(f"world_T_ego[{k}]: expected a rigid transform (orthonormal rotation, last row 0 0 0 1)")
        object.__setattr__(self, "timestamps", timestamps)
        object.__setattr__(self, "world_T_ego", poses)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> FloatArray:
        """(n, 3) positions of the vehicle in the world, m."""
        return self.world_T_ego[:, :3, 3]

    @property
    def path_length(self) -> FloatArray:
        """(n,) length of the path from the first pose on, m."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def select(self, rows: BoolArray | IntArray | slice) -> Self:
        """The poses of a mask, of increasing row indices or of a slice."""
        return type(self)(self.timestamps[rows], self.world_T_ego[rows])

    def transformed(self, target_T_world: ArrayLike) -> Self:
        """The trajectory in other world coordinates; target_T_world (4, 4)."""
        return type(self)(self.timestamps, checked("target_T_world", target_T_world, (4, 4)) @ self.world_T_ego)


def matched(estimate: Trajectory, truth: Trajectory, tolerance: float = 0.01) -> tuple[Trajectory, Trajectory]:
    """The poses of both at common times: each pose of `estimate` with the nearest of `truth`, within `tolerance` s.

    A pose of the truth is used once, for the estimate nearest to it in time. Raises `InputError` if there is no pair.
    """
    after = np.clip(np.searchsorted(truth.timestamps, estimate.timestamps), 1, max(len(truth) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(truth) - 1)
    to_before = np.abs(estimate.timestamps - truth.timestamps[before])
    to_after = np.abs(estimate.timestamps - truth.timestamps[after])
    nearest = np.where(to_before <= to_after, before, after)
    gap = np.minimum(to_before, to_after)
    order = np.lexsort((gap, nearest))
    first = np.ones(len(order), dtype=bool)
    first[1:] = nearest[order][1:] != nearest[order][:-1]
    rows = np.sort(order[first])
    rows = rows[gap[rows] <= tolerance]
    if not len(rows):
        raise InputError(
            f"estimate: expected poses within {tolerance:g} s of the truth's, which run from "
            f"{truth.timestamps[0]:.3f} to {truth.timestamps[-1]:.3f} s; the estimate's run from "
            f"{estimate.timestamps[0]:.3f} to {estimate.timestamps[-1]:.3f} s"
        )
    return estimate.select(rows), truth.select(nearest[rows])
