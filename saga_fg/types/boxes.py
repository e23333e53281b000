"""Oriented boxes in one coordinate frame: the columns that detections, tracks and annotations share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, StrArray, checked, checked_labels
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import transform_points, wrap_angle

MAX_POSITION = 1e9  # m; beyond, distances have no digits left
MAX_SPEED = 1e6  # m/s
MAX_SIZE = 1e5  # m


@dataclass(frozen=True, eq=False)
class Boxes(Columns):
    """N boxes, validated once. NaN means "not measured", allowed in size, yaw and velocity only.

    label     (N,)    class names
    position  (N, 3)  centres, m
    size      (N, 3)  length (along the heading), width, height, m, > 0
    yaw       (N,)    heading about z from x towards y, rad, wrapped into [-pi, pi)
    velocity  (N, 2)  horizontal velocity over ground, m/s

    Raises `InputError` naming the column and the row.
    """

    label: StrArray
    position: FloatArray
    size: FloatArray
    yaw: FloatArray
    velocity: FloatArray

    def __post_init__(self) -> None:
        label = checked_labels("label", self.label)
        n = len(label)
        size = checked("size", self.size, (n, 3), "finite-or-nan")
        if (size <= 0).any():
            row = int(np.argwhere(size <= 0)[0][0])
            raise InputError(f"size[{row}]: expected positive length, width, height in m, got {size[row].tolist()}")
        position = checked("position", self.position, (n, 3))
        velocity = checked("velocity", self.velocity, (n, 2), "finite-or-nan")
        for name, values, limit in (
            ("size", size, MAX_SIZE),
            ("position", position, MAX_POSITION),
            ("velocity", velocity, MAX_SPEED),
        ):
            if (np.abs(values) > limit).any():
                row = int(np.argwhere(np.abs(values) > limit)[0][0])
                raise InputError(f"{name}[{row}]: expected numbers within {limit:g}, got {values[row].tolist()}")
        yaw = wrap_angle(checked("yaw", self.yaw, (n,), "finite-or-nan"))
        yaw.flags.writeable = False
        vars(self).update(label=label, position=position, size=size, yaw=yaw, velocity=velocity)

    @classmethod
    def unchecked(
        cls, label: StrArray, position: FloatArray, size: FloatArray, yaw: FloatArray, velocity: FloatArray
    ) -> Self:
        """Boxes of arrays that were checked where they came in, with headings that are wrapped."""
        made = object.__new__(cls)
        vars(made).update(label=label, position=position, size=size, yaw=yaw, velocity=velocity)
        return made

    @classmethod
    def of(
        cls,
        label: Sequence[str] | StrArray,
        position: ArrayLike,
        size: ArrayLike | None = None,
        yaw: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
    ) -> Self:
        """Boxes from any array-likes; a column left out is unknown (NaN)."""
        n = len(label)
        return cls(
            label=np.asarray(label),
            position=np.asarray(position, dtype=np.float64).reshape(n, 3) if n == 0 else position,  # type: ignore[arg-type]
            size=np.full((n, 3), np.nan) if size is None or n == 0 else size,  # type: ignore[arg-type]
            yaw=np.full(n, np.nan) if yaw is None else yaw,  # type: ignore[arg-type]
            velocity=np.full((n, 2), np.nan) if velocity is None or n == 0 else velocity,  # type: ignore[arg-type]
        )

    @classmethod
    def empty(cls) -> Self:
        return cls.of([], np.empty((0, 3)))

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """All boxes of `parts`, in order."""
        return super().concatenate(parts) if parts else cls.empty()

    def transformed(self, target_T_source: FloatArray) -> Self:
        """The boxes in target coordinates; `target_T_source` is a rigid (4, 4) transform whose tilt is small."""
        R = target_T_source[:3, :3]
        heading = np.stack([np.cos(self.yaw), np.sin(self.yaw), np.zeros(len(self))], axis=-1) @ R.T
        return replace(
            self,
            position=transform_points(target_T_source, self.position),
            yaw=np.arctan2(heading[:, 1], heading[:, 0]) if len(self) else self.yaw,
            velocity=self.velocity @ R[:2, :2].T,
        )

    def corners(self) -> FloatArray:
        """Footprints (N, 4, 2): front left, rear left, rear right, front right, in the boxes' frame."""
        half = self.size[:, None, :2] / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        x, y = half[..., 0], half[..., 1]
        return np.asarray(self.position[:, None, :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1))
