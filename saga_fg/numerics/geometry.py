"""Geometry in the plane and in space: angles, transforms, polylines, near pairs of points and their gates.

Rigid transforms and angles. Names carry frames: `world_T_ego` maps points from ego to world coordinates.

    p_world = world_T_ego[:3, :3] @ p_ego + world_T_ego[:3, 3]

All vehicle and world frames have z up; yaw is measured about z, from x towards y, in rad.

Pairs of places that are near each other, from a k-d tree where there are many.

Up to `MAX_COMPARED` distances are compared by a kernel, which is faster. Beyond, rows whose reach differs by less than
a factor of two are searched together, so that a few far-reaching ones do not widen the search of all others.

Quantiles of the chi-square distribution: gates, and ellipses that hold a given share.

`scipy.stats` has them, too, and takes half a second to import, which every start of the command would pay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from saga_fg.errors import InputError
from saga_fg.kernels.pairs import compared_pairs
from saga_fg.numerics.arrays import BoolArray, Columns, FloatArray, IntArray, checked


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Angles (any shape, rad) wrapped into [-pi, pi)."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.where(wrapped >= np.pi, -np.pi, wrapped))  # an angle just below -pi is rounded to pi


def checked_transform(name: str, value: ArrayLike) -> FloatArray:
    """`value` as a read-only 4 x 4 rigid transform; raises `InputError` unless its rotation is orthonormal (1e-4)."""
    matrix = checked(name, value, (4, 4))
    if not is_rotation(matrix[:3, :3], 1e-4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"{name}: expected a rigid 4 x 4 transform (orthonormal rotation, last row 0 0 0 1)")
    return matrix


def is_rotation(R: FloatArray, tolerance: float) -> BoolArray:
    """Test matrices (..., 3, 3): orthonormal to within `tolerance` and no reflection."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        orthonormal = (np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)) <= tolerance).all(axis=(-2, -1))
        return np.asarray(orthonormal & (np.linalg.det(R) > 0))


def inverse_transform(target_T_source: FloatArray) -> FloatArray:
    """source_T_target of a rigid (..., 4, 4) transform."""
    Rt = np.swapaxes(target_T_source[..., :3, :3], -1, -2)
    result = np.zeros_like(target_T_source)
    result[..., :3, :3] = Rt
    result[..., :3, 3] = -(Rt @ target_T_source[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def rigid_transforms(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Transforms (N, 4, 4) of rotations (N, 3, 3) and translations (N, 3)."""
    transforms = np.tile(np.eye(4), (len(translation), 1, 1))
    transforms[:, :3, :3], transforms[:, :3, 3] = rotation, translation
    return transforms


def transform_points(target_T_source: FloatArray, points: FloatArray) -> FloatArray:
    """Points (N, 3) in source coordinates to target coordinates."""
    return points @ target_T_source[:3, :3].T + target_T_source[:3, 3]


def adjoint(a_T_b: FloatArray) -> FloatArray:
    """Adjoints (..., 6, 6) of rigid transforms: tangents (rotation, translation) in the frame of b to those in a's."""
    R, t = a_T_b[..., :3, :3], a_T_b[..., :3, 3]
    result = np.zeros((*a_T_b.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = R
    x, y, z = np.moveaxis(t[..., None], -2, 0)  # np.cross takes three times as long for few transforms
    result[..., 3, :3] = y * R[..., 2, :] - z * R[..., 1, :]
    result[..., 4, :3] = z * R[..., 0, :] - x * R[..., 2, :]
    result[..., 5, :3] = x * R[..., 1, :] - y * R[..., 0, :]
    return result


def carried_covariance(a_T_b: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (..., 6, 6) of tangents (rotation, translation) in the frame of b, brought into that of a."""
    Ad = adjoint(a_T_b)
    return np.asarray(Ad @ covariance @ np.swapaxes(Ad, -1, -2))


def yaw_of(rotation: FloatArray) -> FloatArray:
    """Yaw (rad) of rotation matrices (..., 3, 3): direction of the rotated x axis in the horizontal plane."""
    return np.asarray(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]))


def yaw_transform(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> FloatArray:
    """4 x 4 transform with translation (x, y, z) in m and a rotation by `yaw` rad about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=np.float64)


def quaternion_yaw(quaternion: FloatArray) -> FloatArray:
    """Yaw (N,) of unit quaternions (N, 4) in (w, x, y, z) order."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def yaw_quaternion(yaw: ArrayLike) -> FloatArray:
    """Unit quaternions (N, 4), (w, x, y, z), of rotations by `yaw` (N,) about z."""
    half = np.asarray(yaw, dtype=np.float64) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def quaternion_rotation(quaternion: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) in (w, x, y, z) order."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_quaternion(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4), (w, x, y, z) with w >= 0, of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True))


def quaternion_norms(quaternions: FloatArray) -> FloatArray:
    """Norms (N,) of quaternions (N, 4); infinite where they are beyond all numbers."""
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(quaternions, axis=1))


def checked_quaternions(name: str, value: ArrayLike) -> FloatArray:
    """`value` as unit quaternions (N, 4), (w, x, y, z); raises `InputError` where the norm is off 1 by over 1e-3."""
    quaternions = checked(name, value, (None, 4))
    norm = quaternion_norms(quaternions)
    bad = np.abs(norm - 1) > 1e-3
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{name}[{row}]: expected a unit quaternion (w, x, y, z), got norm {norm[row]:.6g}")
    return np.asarray(quaternions / norm[:, None])


def transforms(x: FloatArray) -> FloatArray:
    """Poses (n, 3): x, y, heading as (n, 3, 3)."""
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    T = np.tile(np.eye(3), (len(x), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, :2, 2] = x[:, :2]
    return T


def transform(x: FloatArray) -> FloatArray:
    """A pose (3,) as (3, 3)."""
    return np.asarray(transforms(x[None])[0])


def vectors(T: FloatArray) -> FloatArray:
    """Poses (n, 3, 3) as x, y, heading (n, 3)."""
    return np.stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])], axis=1)


def vector(T: FloatArray) -> FloatArray:
    """A pose (3, 3) as x, y, heading."""
    return np.asarray(vectors(T[None])[0])


def heading(T: FloatArray) -> float:
    """The heading of a pose (3, 3)."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def moved(points: FloatArray, T: FloatArray) -> FloatArray:
    """Points (n, 2) by a pose (3, 3)."""
    return np.asarray(points @ T[:2, :2].T + T[:2, 2])


def in_space(T: FloatArray) -> FloatArray:
    """Poses in the plane (..., 3, 3) as poses in space (..., 4, 4) at z = 0."""
    poses = np.zeros((*T.shape[:-2], 4, 4))
    poses[..., :2, :2], poses[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    poses[..., 2, 2] = poses[..., 3, 3] = 1.0
    return poses


def in_plane(T: FloatArray) -> FloatArray:
    """Upright poses in space (..., 4, 4) from above (..., 3, 3)."""
    rows = np.array([0, 1, 3])
    return T[..., rows[:, None], rows]


@dataclass(frozen=True, eq=False)
class Feet(Columns):
    """Nearest points (m, 2) of a polyline to m places, s (m,) and e (m,), m, and its direction (m, 2) at s."""

    point: FloatArray
    s: FloatArray
    e: FloatArray
    direction: FloatArray


class Polylines(NamedTuple):
    """L polylines as S pieces, one line after the other.

    start (S, 2), m, and unit direction t (S, 2) of each piece; low, high (S,): bounds of the distance along it, m, inf
    at both ends of a line; before (S,): length of the line before it, m; middle (S,): s of its middle; angle (S,), rad,
    without jumps; first (L,), pieces (L,): its pieces; length (L,), m; base (L,) of keys s + base that sort all pieces
    """

    start: FloatArray
    t: FloatArray
    low: FloatArray
    high: FloatArray
    before: FloatArray
    middle: FloatArray
    angle: FloatArray
    first: IntArray
    pieces: IntArray
    length: FloatArray
    base: FloatArray

    @classmethod
    def from_points(cls, lines: Sequence[FloatArray]) -> Self:
        """Polylines (k, 2) of one piece at least, of points apart."""
        pieces = np.array([len(line) - 1 for line in lines], dtype=np.int64)
        first, total, length = np.cumsum(pieces) - pieces, int(pieces.sum()), np.empty(len(lines))
        columns = tuple(np.empty((total, *width)) for width in ((2,), (2,), (), (), (), (), ()))
        for count in np.unique(pieces).tolist():
            alike = np.flatnonzero(pieces == count)
            at = first[alike][:, None] + np.arange(count)
            *parts, length[alike] = _pieces(np.array([lines[k] for k in alike.tolist()]))
            for column, part in zip(columns, parts, strict=True):
                column[at] = part
        start, t, low, high, before, middle, angle = columns
        base = np.cumsum(length + 1) - length
        return cls(
            start=start,
            t=t,
            low=low,
            high=high,
            before=before,
            middle=middle,
            angle=angle,
            first=first,
            pieces=pieces,
            length=length,
            base=base,
        )

    def __len__(self) -> int:
        return len(self.length)

    def feet(self, line: IntArray, places: FloatArray) -> Feet:
        """The feet of places (m, 2) on polylines `line` (m,); first and last pieces run on straight."""
        count = self.pieces[line]
        begin = np.cumsum(count) - count
        row = np.repeat(np.arange(len(line)), count)
        piece = np.arange(len(row)) + (self.first[line] - begin)[row]
        t, place = self.t[piece], places[row]
        offset = place - self.start[piece]
        along = np.clip(offset[:, 0] * t[:, 0] + offset[:, 1] * t[:, 1], self.low[piece], self.high[piece])
        apart = offset - along[:, None] * t
        distance = apart[:, 0] ** 2 + apart[:, 1] ** 2
        least = np.minimum.reduceat(distance, begin) if len(line) else distance
        hit = np.flatnonzero(distance == least[row])
        k = hit[np.unique(row[hit], return_index=True)[1]]  # the first of equals
        t, apart = t[k], apart[k]
        s = self.before[piece[k]] + along[k]
        return Feet(places - apart, s, t[:, 0] * apart[:, 1] - t[:, 1] * apart[:, 0], self.direction_at(line, s))

    def direction_at(self, line: IntArray, s: FloatArray) -> FloatArray:
        """Unit directions (m, 2) at distances s (m,) along `line` (m,), turning evenly from piece to piece."""
        key = np.clip(s, 0.0, self.length[line]) + self.base[line]
        first, last = self.first[line], self.first[line] + self.pieces[line] - 1
        passed = np.searchsorted(np.repeat(self.base, self.pieces) + self.middle, key, side="right")
        a, b = np.clip(passed - 1, first, last), np.clip(passed, first, last)
        apart = self.middle[b] - self.middle[a]
        share = np.where(apart > 0, (s - self.middle[a]) / np.where(apart > 0, apart, 1.0), 0.0)
        angle = self.angle[a] + share * (self.angle[b] - self.angle[a])
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def feet(polyline: FloatArray, places: FloatArray) -> Feet:
    """The feet on a polyline (k, 2) of places (m, 2); its first and last pieces run on straight."""
    return Polylines.from_points([polyline]).feet(np.zeros(len(places), dtype=np.int64), places)


def on_it(polyline: FloatArray, s: FloatArray) -> BoolArray:
    """Mask (m,) of distances along a polyline (k, 2) between its first and its last point."""
    return np.asarray((s >= 0) & (s <= np.hypot(*np.diff(polyline, axis=0).T).sum()))


def direction_at(polyline: FloatArray, s: FloatArray) -> FloatArray:
    """Unit directions (m, 2) at distances s (m,) along a polyline (k, 2), turning evenly from piece to piece."""
    return Polylines.from_points([polyline]).direction_at(np.zeros(len(s), dtype=np.int64), s)


def _pieces(lines: FloatArray) -> tuple[FloatArray, ...]:
    """The pieces of polylines (L, k, 2): their columns in `Polylines`, (L, k - 1, ...), and the lengths (L,)."""
    step = np.diff(lines, axis=1)
    length = np.hypot(step[..., 0], step[..., 1])
    end = np.cumsum(length, axis=1)
    low, high = np.zeros_like(length), length.copy()
    low[:, 0], high[:, -1] = -np.inf, np.inf
    angle = np.unwrap(np.arctan2(step[..., 1], step[..., 0]), axis=1)
    return lines[:, :-1], step / length[..., None], low, high, end - length, end - length / 2, angle, length.sum(axis=1)


MAX_COMPARED = 500_000  # distances that the kernel compares
_MIN_REACH = 1e-9  # m, so that a reach of 0 has a logarithm


def near_pairs(
    a: FloatArray, b: FloatArray, reach: FloatArray, further: FloatArray | float = 0.0
) -> tuple[IntArray, IntArray]:
    """Rows (K,) of `a` and of `b` with |a_i - b_j| <= reach_i + further_j, in order of i, then of j.

    a (n, 2), b (m, 2), reach (n,) and further (m,) in m; where one of these is NaN there is no pair
    """
    reach = np.asarray(reach, dtype=np.float64)
    further = np.zeros(len(b)) + further
    if len(a) * len(b) <= MAX_COMPARED:
        return compared_pairs(a, b, reach, further)
    i, j = (~np.isnan(reach)).nonzero()[0], (~np.isnan(further)).nonzero()[0]
    if len(i) == 0 or len(j) == 0:
        return i[:0], j[:0]
    widest = reach[i] + further[j].max()
    bounded = np.isfinite(widest)
    all_i, all_j = compared_pairs(a[i[~bounded]], b[j], reach[i[~bounded]], further[j])
    found, tree = [i[~bounded][all_i] * len(b) + j[all_j]], cKDTree(b[j])
    i, widest = i[bounded], widest[bounded]
    octave = np.ceil(np.log2(np.maximum(widest, _MIN_REACH)))
    for level in np.unique(octave).tolist():
        alike = (octave == level).nonzero()[0]
        radius = float(widest[alike].max()) * (1 + 1e-9)
        near = cKDTree(a[i[alike]]).sparse_distance_matrix(tree, radius, output_type="ndarray")
        row, column = i[alike[near["i"]]], j[near["j"]]
        x, y = (a[row] - b[column])[:, :2].T
        within = x * x + y * y <= (reach[row] + further[column]) ** 2
        found.append(row[within] * len(b) + column[within])
    row, column = np.divmod(np.sort(np.concatenate(found)), len(b))
    return row, column


def chi_square_quantile(probability: float, degrees: float) -> float:
    """The value that a chi-square variable of so many degrees of freedom stays below with this probability."""
    return float(2 * gammaincinv(degrees / 2, probability))
