"""Oriented boxes in one coordinate frame, and their overlap.

Overlap of oriented boxes: IoU in the plane and in space, over many pairs at once. With footprints A and B (rectangles
in the horizontal plane) and areas |.|,

    IoU  = |A n B| / |A u B|,     |A u B| = |A| + |B| - |A n B|

In space, areas become volumes: heights multiply, the intersection by the common height.

Intersection. The boundary of A n B is made of the parts of A's edges inside B and of B's edges inside A, so by Green's
theorem, with an edge p + t d (0 <= t <= 1) clipped to t0 <= t <= t1,

    |A n B| = 1/2 sum over the 8 edges of max(0, t1 - t0) (p x d)

In the frame of the other box the clip is a slab test on two coordinates: no polygon is built, nothing is sorted, and
there is no loop over pairs. Edges that coincide must count once: A's edges are clipped to B grown by a hair, B's edges
to A shrunk by it, which costs about 1e-11 of the box in accuracy.

Cost: circumscribed circles that do not meet are sorted out first, so the work grows with the pairs that may overlap.

Source: Liang and Barsky, A New Concept and Method for Line Clipping, ACM Transactions on Graphics 3(1), 1984.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.kernels.pairs import paired_overlaps
from saga_fg.numerics import (
    Columns,
    FloatArray,
    IntArray,
    StrArray,
    checked,
    checked_labels,
    near_pairs,
    transform_points,
    wrap_angle,
)

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


HAIR = 1e-11  # relative to the size of the boxes


def bev_iou(a: Boxes, b: Boxes) -> FloatArray:
    """(N, M) IoU of the footprints of all pairs; 0 where a size or heading is unknown."""
    return _of_all_pairs(paired_bev_iou, a, b)


def iou_3d(a: Boxes, b: Boxes) -> FloatArray:
    """(N, M) IoU of the volumes of all pairs; 0 where a size or heading is unknown."""
    return _of_all_pairs(paired_iou_3d, a, b)


def _of_all_pairs(overlap: Callable[[Boxes, Boxes], FloatArray], a: Boxes, b: Boxes) -> FloatArray:
    result = np.zeros((len(a), len(b)))
    rows, columns = touching_pairs(a, b)
    result[rows, columns] = overlap(a.select(rows), b.select(columns))
    return result


def paired_bev_iou(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) IoU of the footprints of a[n] and b[n]; NaN where a size or heading is unknown."""
    common = _common_area(a, b)
    return np.asarray(common / (_area(a) + _area(b) - common))


def paired_iou_3d(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) IoU of the volumes of a[n] and b[n]; NaN where a size or heading is unknown."""
    low = np.maximum(a.position[:, 2] - a.size[:, 2] / 2, b.position[:, 2] - b.size[:, 2] / 2)
    high = np.minimum(a.position[:, 2] + a.size[:, 2] / 2, b.position[:, 2] + b.size[:, 2] / 2)
    common = _common_area(a, b) * np.maximum(high - low, 0.0)
    return np.asarray(common / (_area(a) * a.size[:, 2] + _area(b) * b.size[:, 2] - common))


def touching_pairs(a: Boxes, b: Boxes) -> tuple[IntArray, IntArray]:
    """Rows of `a` and of `b` of the pairs whose circumscribed circles meet: all that can overlap."""
    radius_a, radius_b = (np.hypot(x.size[:, 0], x.size[:, 1]) / 2 for x in (a, b))
    return near_pairs(a.position[:, :2], b.position[:, :2], radius_a, radius_b)


def _common_area(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) area common to the footprints of a[n] and b[n], m^2; NaN where a size or heading is unknown."""
    return paired_overlaps(a.position, a.size, a.yaw, b.position, b.size, b.yaw, HAIR)


def _area(boxes: Boxes) -> FloatArray:
    return np.asarray(boxes.size[:, 0] * boxes.size[:, 1])
