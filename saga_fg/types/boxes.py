"""Oriented boxes in one coordinate frame, and their overlap.

Overlap of oriented boxes: IoU in the plane and in space, generalised IoU, over many pairs at once.

With footprints A and B (rectangles in the horizontal plane), areas |.|, C the convex hull of both:

    IoU  = |A n B| / |A u B|                     |A u B| = |A| + |B| - |A n B|
    GIoU = IoU - (|C| - |A u B|) / |C|           in (-1, 1]; negative where boxes are apart, still telling how far

In space, areas become volumes: heights multiply, the intersection by the common height, C by the spanned height.

Intersection. The boundary of A n B is made of the parts of A's edges inside B and of B's edges inside A, so by Green's
theorem, with an edge p + t d (0 <= t <= 1) clipped to t0 <= t <= t1,

    |A n B| = 1/2 sum over the 8 edges of max(0, t1 - t0) (p x d)

In the frame of the other box the clip is a slab test on two coordinates: no polygon is built, nothing is sorted, and
there is no loop over pairs. Edges that coincide must count once: A's edges are clipped to B grown by a hair, B's edges
to A shrunk by it, which costs about 1e-11 of the box in accuracy.

Hull. Walking round the directions of the plane, the outermost corner of both boxes together: it can change at the 8
edge normals, and once between two of them. Again nothing is sorted.

Cost: circumscribed circles that do not meet are sorted out first, so the work grows with the pairs that may overlap.

Sources: Rezatofighi et al., Generalized Intersection over Union, CVPR 2019 (GIoU); Liang and Barsky, A New Concept and
Method for Line Clipping, ACM Transactions on Graphics 3(1), 1984 (clipping to slabs).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.kernels.pairs import paired_overlaps
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray, StrArray, checked, checked_labels
from saga_fg.numerics.gating import near_pairs
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


HAIR = 1e-11  # relative to the size of the boxes
CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])  # counter-clockwise, in half sizes
QUARTERS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])  # normals of the edges before those corners


def bev_iou(a: Boxes, b: Boxes) -> FloatArray:
    """(N, M) IoU of the footprints of all pairs; 0 where a size or heading is unknown."""
    result = np.zeros((len(a), len(b)))
    rows, columns = touching_pairs(a, b)
    result[rows, columns] = paired_bev_iou(a.select(rows), b.select(columns))
    return result


def iou_3d(a: Boxes, b: Boxes) -> FloatArray:
    """(N, M) IoU of the volumes of all pairs; 0 where a size or heading is unknown."""
    result = np.zeros((len(a), len(b)))
    rows, columns = touching_pairs(a, b)
    result[rows, columns] = paired_iou_3d(a.select(rows), b.select(columns))
    return result


def paired_bev_iou(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) IoU of the footprints of a[n] and b[n]; NaN where a size or heading is unknown."""
    return paired_overlaps(a.position, a.size, a.yaw, b.position, b.size, b.yaw, HAIR)


def paired_iou_3d(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) IoU of the volumes of a[n] and b[n]; NaN where a size or heading is unknown."""
    common = paired_intersection(a, b) * _common_height(a, b)
    return np.asarray(common / (_area(a) * a.size[:, 2] + _area(b) * b.size[:, 2] - common))


def paired_giou_3d(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) generalised IoU of the volumes of a[n] and b[n]; -1 where a size or heading is unknown."""
    known = np.isfinite(a.size + b.size).all(axis=1) & np.isfinite(a.yaw + b.yaw)
    result = np.full(len(a), -1.0)
    a, b = a.select(known), b.select(known)
    common = np.zeros(len(a))
    near = _may_touch(a, b).nonzero()[0]
    common[near] = paired_intersection(a.select(near), b.select(near))
    common = common * _common_height(a, b)
    hull = paired_hull(a, b) * _spanned_height(a, b)
    union = _area(a) * a.size[:, 2] + _area(b) * b.size[:, 2] - common
    result[known] = common / union - (hull - union) / hull
    return result


def touching_pairs(a: Boxes, b: Boxes) -> tuple[IntArray, IntArray]:
    """Rows of `a` and of `b` of the pairs whose circumscribed circles meet: all that can overlap."""
    radius_a, radius_b = (np.hypot(x.size[:, 0], x.size[:, 1]) / 2 for x in (a, b))
    return near_pairs(a.position[:, :2], b.position[:, :2], radius_a, radius_b)


def paired_intersection(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) area common to the footprints of a[n] and b[n], m^2; NaN where a size or heading is unknown."""
    half_a, half_b = a.size[:, :2] / 2, b.size[:, :2] / 2
    hair = HAIR * np.maximum(half_a.sum(axis=1), half_b.sum(axis=1))[:, None]
    offset = a.position[:, :2] - b.position[:, :2]
    a_in_b = _corners_in(half_a, offset, a.yaw, b.yaw)
    b_in_a = _corners_in(half_b, -offset, b.yaw, a.yaw)
    edge_a = np.roll(a_in_b, -1, axis=1) - a_in_b
    edge_b = np.roll(b_in_a, -1, axis=1) - b_in_a
    moment = a_in_b[..., 0] * edge_a[..., 1] - a_in_b[..., 1] * edge_a[..., 0]
    along_a = np.sum(_share_inside(a_in_b, edge_a, half_b + hair) * moment, axis=1)
    along_b = np.sum(_share_inside(b_in_a, edge_b, half_a - hair), axis=1) * 2 * half_b[:, 0] * half_b[:, 1]
    return np.asarray(np.clip((along_a + along_b) / 2, 0.0, np.minimum(_area(a), _area(b))))


def _corners_in(half: FloatArray, offset: FloatArray, yaw: FloatArray, frame_yaw: FloatArray) -> FloatArray:
    """Corners (N, 4, 2) of boxes centred at `offset` (N, 2) from boxes with heading `frame_yaw`, in their frame."""
    c, s = np.cos(frame_yaw)[:, None], np.sin(frame_yaw)[:, None]
    centre = np.stack(
        [c[:, 0] * offset[:, 0] + s[:, 0] * offset[:, 1], c[:, 0] * offset[:, 1] - s[:, 0] * offset[:, 0]], 1
    )
    c, s = np.cos(yaw - frame_yaw)[:, None], np.sin(yaw - frame_yaw)[:, None]
    corner = half[:, None, :] * CORNERS
    turned = np.stack([c * corner[..., 0] - s * corner[..., 1], s * corner[..., 0] + c * corner[..., 1]], axis=-1)
    return np.asarray(centre[:, None, :] + turned)


def _share_inside(start: FloatArray, edge: FloatArray, half: FloatArray) -> FloatArray:
    """(N, 4) how much of each edge start + t edge, 0 <= t <= 1, lies in the rectangle |x| <= half_x, |y| <= half_y."""
    run = np.where(np.abs(edge) < 1e-300, 1e-300, edge)  # parallel to a slab: enters at -inf, leaves at +inf, or never
    with np.errstate(over="ignore"):
        one, two = (-half[:, None, :] - start) / run, (half[:, None, :] - start) / run
    enter = np.maximum(np.minimum(one, two).max(axis=2), 0.0)
    leave = np.minimum(np.maximum(one, two).min(axis=2), 1.0)
    return np.asarray(np.maximum(leave - enter, 0.0))


def paired_hull(a: Boxes, b: Boxes) -> FloatArray:
    """(N,) area of the convex hull of both footprints, m^2; NaN where a size or heading is unknown.

    Between two neighbouring of the 8 edge normals each box has one outermost corner, and of these two corners one is
    the outer at the start and one at the end of the interval: in turn they are the hull's corners.
    """
    half_a, half_b = a.size[:, :2] / 2, b.size[:, :2] / 2
    turn = b.yaw - a.yaw
    quarters = np.floor(turn / (np.pi / 2))
    rest = turn - quarters * (np.pi / 2)
    corner_a = half_a[:, None, :] * CORNERS
    corner_b = _corners_in(half_b, b.position[:, :2] - a.position[:, :2], b.yaw, a.yaw)
    shift = np.where(np.isfinite(quarters), quarters, 0).astype(np.int64)
    after = np.take_along_axis(corner_b, ((np.arange(4) - shift[:, None]) % 4)[..., None], axis=1)
    before = np.roll(after, 1, axis=1)  # outermost of b in the first part of each quarter, from a's normal to b's
    c, s = np.cos(rest)[:, None], np.sin(rest)[:, None]
    normal_b = np.stack([c * QUARTERS[:, 0] - s * QUARTERS[:, 1], s * QUARTERS[:, 0] + c * QUARTERS[:, 1]], axis=-1)
    outer_at_a = (np.sum((corner_a - before) * QUARTERS, axis=-1) >= 0)[..., None]
    outer_at_b = (np.sum((corner_a - after) * normal_b, axis=-1) >= 0)[..., None]
    corners = np.stack(
        [
            np.where(outer_at_a, corner_a, before),
            np.where(outer_at_b, corner_a, before),
            np.where(outer_at_b, corner_a, after),
            np.where(np.roll(outer_at_a, -1, axis=1), corner_a, after),
        ],
        axis=2,
    ).reshape(len(a), 16, 2)
    following = np.roll(corners, -1, axis=1)
    return np.asarray(np.sum(corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0], axis=1) / 2)


def _may_touch(a: Boxes, b: Boxes) -> BoolArray:
    """(N,) whether the circumscribed circles of a[n] and b[n] meet."""
    offset = a.position[:, :2] - b.position[:, :2]
    reach = (np.hypot(a.size[:, 0], a.size[:, 1]) + np.hypot(b.size[:, 0], b.size[:, 1])) / 2
    return np.asarray(np.hypot(offset[:, 0], offset[:, 1]) < reach)


def _area(boxes: Boxes) -> FloatArray:
    return np.asarray(boxes.size[:, 0] * boxes.size[:, 1])


def _common_height(a: Boxes, b: Boxes) -> FloatArray:
    low = np.maximum(a.position[:, 2] - a.size[:, 2] / 2, b.position[:, 2] - b.size[:, 2] / 2)
    high = np.minimum(a.position[:, 2] + a.size[:, 2] / 2, b.position[:, 2] + b.size[:, 2] / 2)
    return np.asarray(np.maximum(high - low, 0.0))


def _spanned_height(a: Boxes, b: Boxes) -> FloatArray:
    low = np.minimum(a.position[:, 2] - a.size[:, 2] / 2, b.position[:, 2] - b.size[:, 2] / 2)
    high = np.maximum(a.position[:, 2] + a.size[:, 2] / 2, b.position[:, 2] + b.size[:, 2] / 2)
    return np.asarray(high - low)
