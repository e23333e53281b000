"""Place recognition between submaps, and their overlap.

Place recognition: which older submap shows the place of a new one, and how the two lie to each other.

A submap is seen from above as an image of heights above the ground, less their mean; cells that were never seen are 0.

    key        | F_theta |F a| (rho, theta) |     the spectrum's magnitude knows no translation, its Fourier series over
                                              the bearing no rotation; whitened by the spread over all places
    alignment  max over yaw, x, y of   sum a b' / sqrt( sum a^2 sum b'^2 ),    b' the new image turned: by convolution

The key says which places are compared; the alignment is an exhaustive search and needs no guess. Its second best peak
elsewhere tells whether the place looks like itself somewhere else (row houses). Sources: Reddy and Chatterji, An
FFT-based technique for translation, rotation, and scale-invariant image registration, TIP 1996; Lu, Xu, Chen, Xiong,
Wang, One RING to rule them all: Radon sinogram for place recognition, RA-L 2022.

Submaps: the thinned points of a few dozen metres of way, in a frame of their own.

The frame of a submap is fixed to one of its keyframes: where that keyframe's sensor was, turned so that z points
up. When the estimate of the keyframe's pose changes, the submap moves along, and its points stay as they are.

Share of the structure above the ground that two registered submaps have in common: the proof of a place.

Ground lies on ground everywhere, so it proves nothing; and what only one of the two has seen says nothing either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from data_tools.lidar.scan import voxel_downsample
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, checked, inverse_transform, transform_points, yaw_transform

CELL, _CELLS = 1.5, 64  # m; of an image in each direction
_PADDED = 2 * _CELLS
_HIGHEST = 3.0  # m above the ground: what is higher is seen from near by alone
_GROUND = 3.0  # m, cell in which the lowest point counts
_TURNS = 120  # of the search
_RADII, _BEARINGS, _ORDERS = 16, 60, 8  # of a key
_APART, _TURNED = 6.0, 0.35  # m and rad between two peaks that are not the same


@dataclass(frozen=True, eq=False)
class PlaceImage:
    """Heights above the ground, seen from above.

    centre  (2,) m, middle of the image in the submap's frame
    cells   (M, 2) m, centres of the cells that were seen, about `centre`; weight (M,) their heights, less the mean
    key     (K,) the same for every translation and rotation
    ground  (G, 3) m, heights of the ground in the submap's frame
    """

    centre: FloatArray
    cells: FloatArray
    weight: FloatArray
    key: FloatArray
    ground: FloatArray

    @classmethod
    def of(cls, points: FloatArray) -> PlaceImage:
        """The image of points (N, 3), m, z up. Raises `InputError` if there are none, or if some are not finite."""
        points = checked("points", np.asarray(points, dtype=np.float64), (None, 3))
        if not len(points):
            raise InputError("points: expected points of a submap, got none")
        centre = np.median(points[:, :2], axis=0)
        points = points[(np.abs(points[:, :2] - centre) < CELL * _CELLS / 2).all(axis=1)]
        height, ground = heights_above_ground(points)
        at = np.floor((points[:, :2] - centre) / CELL).astype(np.int64) + _CELLS // 2
        seen, row = np.unique(at[:, 0] * _CELLS + at[:, 1], return_inverse=True)
        weight = np.zeros(len(seen))
        np.maximum.at(weight, row, np.clip(height, 0.0, _HIGHEST) / _HIGHEST)
        weight -= weight.mean()
        cells = CELL * (np.stack([seen // _CELLS, seen % _CELLS], axis=1) - _CELLS // 2 + 0.5)
        return cls(centre, cells, weight, _key(_images(cells, weight, np.zeros(1))[0]), ground)


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """A place that looks like the new one.

    number         of the older place
    place_T_query  (4, 4) frame of the new submap in that of the older one, level
    score          correlation of the images, up to 1; rival: of the best other alignment of the two
    """

    number: int
    place_T_query: FloatArray
    score: float
    rival: float


class PlaceIndex:
    """Images of places, and the search for those that look like another."""

    def __init__(self) -> None:
        self._images: dict[int, PlaceImage] = {}

    def __len__(self) -> int:
        return len(self._images)

    def add(self, number: int, image: PlaceImage) -> None:
        """Keep a place. Raises `InputError` for a number that is taken."""
        if number in self._images:
            raise InputError(f"number: expected a new place, {number} is known")
        self._images[number] = image

    def candidates(self, image: PlaceImage, among: Sequence[int] | None = None, most: int = 12) -> list[PlaceMatch]:
        """Align the image with the `most` places whose keys are nearest, the best match first.

        among: numbers of the places to compare with; None: all. An index without places has no candidates.
        """
        numbers = list(self._images) if among is None else [number for number in among if number in self._images]
        if not numbers:
            return []
        keys = np.array([self._images[number].key for number in numbers])
        spread = np.array([each.key for each in self._images.values()]).std(axis=0)
        off = np.where(spread > 0, (keys - image.key) / np.where(spread > 0, spread, 1.0), 0.0)
        nearest = np.argsort(np.linalg.norm(off, axis=1), kind="stable")[:most]
        return self.aligned(image, [numbers[row] for row in nearest])

    def aligned(self, image: PlaceImage, numbers: Sequence[int]) -> list[PlaceMatch]:
        """Align the image with these places, the best match first."""
        angles: FloatArray = np.linspace(0.0, 2 * np.pi, _TURNS, endpoint=False)
        turned = _images(image.cells, image.weight, angles)
        size: FloatArray = np.sqrt((turned.astype(np.float64) ** 2).sum(axis=(1, 2)))
        spectra = np.conj(fft.rfft2(turned, s=(_PADDED, _PADDED)))
        found = [_aligned(number, self._images[number], image, angles, spectra, size) for number in numbers]
        return sorted(found, key=lambda match: -match.score)


def heights_above_ground(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Heights (N,) of points (N, 3) above the ground, m, and places (G, 3) on it.

    The ground is the lowest point of each cell, without what stands out for less than three cells.
    """
    at = np.floor(points[:, :2] / _GROUND).astype(np.int64)
    first = at.min(axis=0)
    at -= first
    low = np.full(at.max(axis=0) + 1, np.inf)
    np.minimum.at(low, (at[:, 0], at[:, 1]), points[:, 2])
    filled = np.argwhere(np.isfinite(low))
    low = minimum_filter(low, 3, mode="constant", cval=np.inf)
    low = maximum_filter(np.where(np.isfinite(low), low, -np.inf), 3, mode="constant", cval=-np.inf)
    ground = np.column_stack([(filled + first + 0.5) * _GROUND, low[filled[:, 0], filled[:, 1]]])
    return points[:, 2] - low[at[:, 0], at[:, 1]], ground


def _images(cells: FloatArray, weight: FloatArray, angles: FloatArray) -> npt.NDArray[np.float32]:
    """The image turned by each angle (A, n, n)."""
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x = np.floor((c * cells[:, 0] - s * cells[:, 1]) / CELL).astype(np.int64) + _CELLS // 2
    y = np.floor((s * cells[:, 0] + c * cells[:, 1]) / CELL).astype(np.int64) + _CELLS // 2
    inside = (x >= 0) & (x < _CELLS) & (y >= 0) & (y < _CELLS)
    size = len(angles) * _CELLS**2
    flat = ((np.arange(len(angles))[:, None] * _CELLS + x) * _CELLS + y)[inside]
    count = np.bincount(flat, minlength=size)
    total = np.bincount(flat, weights=np.broadcast_to(weight, inside.shape)[inside], minlength=size)
    return (total / np.maximum(count, 1)).astype(np.float32).reshape(len(angles), _CELLS, _CELLS)


def _aligned(
    number: int,
    old: PlaceImage,
    new: PlaceImage,
    angles: FloatArray,
    spectra: npt.NDArray[np.complex64],
    size: FloatArray,
) -> PlaceMatch:
    (image,) = _images(old.cells, old.weight, np.zeros(1))
    norm = size * np.sqrt((image**2).sum())
    score = fft.irfft2(fft.rfft2(image, s=(_PADDED, _PADDED)) * spectra, s=(_PADDED, _PADDED))
    score /= np.where(norm > 0, norm, 1.0).astype(np.float32)[:, None, None]
    turn, i, j = np.unravel_index(int(np.argmax(score)), score.shape)
    best = float(score[turn, i, j])
    shift = np.arange(_PADDED)
    shift = np.where(shift < _CELLS, shift, shift - _PADDED)
    apart = np.hypot.outer(shift - shift[i], shift - shift[j]) * CELL > _APART
    turned = np.abs(np.angle(np.exp(1j * (angles - angles[turn])))) > _TURNED
    rival = max(float(score[turned].max()), float(score[:, apart].max()))
    T = yaw_transform(yaw=float(angles[turn]))
    T[:2, 3] = old.centre + CELL * np.array([shift[i], shift[j]]) - T[:2, :2] @ new.centre
    T[2, 3] = _lift(old.ground, transform_points(T, new.ground))
    return PlaceMatch(number, T, best, rival)


def _lift(old: FloatArray, new: FloatArray) -> float:
    """Median height of the ground (G, 3) of one place above that of another, where both know it."""
    distance, row = cKDTree(old[:, :2]).query(new[:, :2], distance_upper_bound=_GROUND)
    known = np.isfinite(distance)
    return float(np.median(old[row[known], 2] - new[known, 2])) if known.any() else 0.0


def _key(image: npt.NDArray[np.float32]) -> FloatArray:
    """Magnitudes (K,) of the spectrum's Fourier series over the bearing, on rings of the spectrum."""
    norm = float(np.sqrt((image**2).sum())) or 1.0
    spectrum = np.abs(fft.fftshift(fft.fft2(image, s=(_PADDED, _PADDED)))) / norm
    rings = map_coordinates(gaussian_filter(np.log1p(spectrum), 1.0), _rings(), order=1)
    return np.asarray(np.abs(fft.fft(rings, axis=1))[:, :_ORDERS].ravel() / _BEARINGS, dtype=np.float64)


@cache
def _rings() -> FloatArray:
    """Places (2, radii, bearings) in the spectrum, half a turn of each ring, as the other half is the same."""
    radius = 0.35 * _PADDED * (np.arange(_RADII) + 1.0) / _RADII
    bearing = np.pi / _BEARINGS * np.arange(_BEARINGS)
    return np.asarray(_PADDED // 2 + np.multiply.outer([np.sin(bearing), np.cos(bearing)], radius).swapaxes(1, 2))


@dataclass(frozen=True, eq=False)
class Submap:
    """A piece of the map.

    keyframes          numbers of its first keyframe, the anchor, which carries the frame, and of the one after its last
    anchor_T_submap    (4, 4) the frame in that of the anchor's sensor, z up
    points             (N, 3) float32, m, in the submap's frame
    travelled          m driven since the start of the drive, at its first and at its last keyframe

    Raises `InputError` for points that are not finite.
    """

    keyframes: tuple[int, int]
    anchor_T_submap: FloatArray
    points: npt.NDArray[np.float32]
    travelled: tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "anchor_T_submap", checked("anchor_T_submap", self.anchor_T_submap, (4, 4)))
        object.__setattr__(self, "points", checked("points", self.points, (None, 3)).astype(np.float32))

    def frame(self, world_T_keyframe: FloatArray) -> FloatArray:
        """Its frame in the world (4, 4), given the poses (N, 4, 4) of all keyframes."""
        return np.asarray(world_T_keyframe[self.keyframes[0]] @ self.anchor_T_submap)


def upright(world_T_sensor: FloatArray) -> FloatArray:
    """Return the rotation (4, 4) that turns a sensor's axes so that z points up in the world, and x stays ahead."""
    R = world_T_sensor[:3, :3]
    heading = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(heading), np.sin(heading)
    turned = np.eye(4)
    turned[:3, :3] = R.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned


_STANDS = 0.5  # m above the ground
_SPACING, _CELL = 0.8, 1.0  # m: of the points compared, and of the cells that were seen
_SEEN, _NEAR = 2.0, 0.6  # m from above to a cell that was seen, and to a point that is the same
_FEWEST = 20  # points that tell an overlap


@dataclass(frozen=True, eq=False)
class Structure:
    """Points above the ground, thinned (M, 3), with trees of more of them, and of the cells seen from above."""

    points: FloatArray
    tree: cKDTree
    seen: cKDTree

    @classmethod
    def of(cls, points: FloatArray) -> Structure:
        """The structure of points (N, 3), m, z up; N > 0."""
        standing = points[heights_above_ground(points)[0] > _STANDS]
        cells = np.unique(np.floor(points[:, :2] / _CELL), axis=0) * _CELL + _CELL / 2
        standing = standing[voxel_downsample(standing, _SPACING / 2)]
        return cls(standing[voxel_downsample(standing, _SPACING)], cKDTree(standing), cKDTree(cells))

    def shared(self, other: Structure, self_T_other: FloatArray) -> float:
        """Share of the points of each that lie on the other, where that one has seen: the smaller one; 0: too few."""
        return min(share or 0.0 for share in self._shares(other, self_T_other))

    def agreement(self, other: Structure, self_T_other: FloatArray) -> float | None:
        """Mean of the two shares: for a scan, which sees too little of the other to have most of it; None: too few."""
        told = [share for share in self._shares(other, self_T_other) if share is not None]
        return float(np.mean(told)) if told else None

    def _shares(self, other: Structure, T: FloatArray) -> tuple[float | None, float | None]:
        return self._share(other.points, T), other._share(self.points, inverse_transform(T))

    def _share(self, points: FloatArray, T: FloatArray) -> float | None:
        """Share of the points that lie on this structure where it has seen; None: too few there."""
        moved = transform_points(T, points)
        distance, _ = self.seen.query(moved[:, :2], distance_upper_bound=_SEEN)
        moved = moved[np.isfinite(distance)]
        if len(moved) < _FEWEST:
            return None
        if not len(self.points):
            return 0.0
        distance, _ = self.tree.query(moved, distance_upper_bound=_NEAR)
        return float(np.isfinite(distance).mean())
