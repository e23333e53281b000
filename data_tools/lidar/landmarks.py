"""Ground, and landmarks in a scan: walls and poles, with their covariances.

Ground segmentation on a polar grid, ring by ring from the vehicle outwards.

In each sector the ground height of a ring is the lowest decile of its points' heights, if it differs from that of the
next inner ring by no more than the steepest road would rise; otherwise (a car, a wall, a reflection from below) the
inner height is kept. A point is ground if it lies within a clearance of the height interpolated between rings. After
Himmelsbach, Hundelshausen, Wuensche, Fast segmentation of 3D point clouds for ground vehicles, IV 2010, with heights
instead of lines.

Walls in a scan.

A plane is n . x + d = 0 in the sensor's frame, n of length 1 pointing to the side of the sensor (d > 0). Fitted to
points, or to means of surfels, c their centre and a <= b <= e the eigenvalues of S = sum (p - c)(p - c)^T, n is the
eigenvector of a and d = - n . c. With a noise of sigma across the plane, and k points,

    var(tilt) = sigma^2 / b        (the worse of the two directions),        var(d) = sigma^2 / k + |c|^2 var(tilt)

where the last term is the effect of the tilt on the distance at the sensor. Walls are found by consensus: the upright
flat surfel with the most others in its plane forms a wall with the connected ones among them; this is repeated with
the remaining surfels.

Poles in a scan: masts, posts and trunks.

Points above the ground are clustered from above (`clusters_from_above`) on small cells. A cluster is a pole if it is
thin, tall, filled from its foot to its top, and isolated: few points in the ring around it at its own height.
Its position is the mean of its points, moved away from the sensor, because the visible points of a circle of radius r
lie on average pi/4 r in front of its centre. The width w across the line of sight gives r = w / 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from data_tools.lidar.registration import surfels_of
from data_tools.lidar.scan import cell_order_statistics, clusters_from_above
from saga_fg.numerics import BoolArray, FloatArray, IntArray

_WEDGES = 60  # number of sectors of the polar grid
_RING_WIDTH = 1.5  # width of a ring, m
_MAX_SLOPE = 0.15  # steepest rise, m per m
GROUND_MAX_RANGE = 80.0  # outer radius of the last ring, m
MAX_RISE = 0.1  # change of height between rings allowed beyond the slope, m
CLEARANCE = 0.2  # largest distance of a ground point from the ground height, m


@dataclass(frozen=True, eq=False)
class Ground:
    """Segmentation of N points: is_ground (N,), and height (N,) of each point above the ground, m."""

    is_ground: BoolArray
    height: FloatArray


def segment_ground(points: FloatArray) -> Ground:
    """Find the ground in points (N, 3), m, of a sensor that stands upright (z up) above it."""
    if not len(points):
        return Ground(np.empty(0, dtype=np.bool_), np.empty(0))
    distance = np.hypot(points[:, 0], points[:, 1])
    sector = ((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * _WEDGES).astype(np.int64) % _WEDGES
    rings = int(np.ceil(GROUND_MAX_RANGE / _RING_WIDTH))
    ring = np.minimum((distance / _RING_WIDTH).astype(np.int64), rings - 1)
    low = cell_order_statistics(points[:, 2], sector * rings + ring, _WEDGES * rings, 10).reshape(_WEDGES, rings)
    ground = _ground_heights(low)
    place = np.clip(distance / _RING_WIDTH - 0.5, 0, rings - 1)
    inner = np.minimum(place.astype(np.int64), rings - 2)
    share = place - inner
    height = points[:, 2] - ((1 - share) * ground[sector, inner] + share * ground[sector, inner + 1])
    return Ground(np.abs(height) <= CLEARANCE, height)


def _ground_heights(low: FloatArray) -> FloatArray:
    """Heights (sectors, rings) of the ground, from the innermost ring on."""
    near = low[:, : max(int(10.0 / _RING_WIDTH), 1)]
    start = float(np.nanmedian(near)) if np.isfinite(near).any() else float(np.nanmin(low))
    height, since = np.full(len(low), start), np.ones(len(low))
    ground = np.empty_like(low)
    for k in range(low.shape[1]):
        fits = np.abs(low[:, k] - height) <= MAX_RISE + _MAX_SLOPE * _RING_WIDTH * since  # False in empty cells
        height = np.where(fits, low[:, k], height)
        since = np.where(fits, 1.0, since + 1.0)
        ground[:, k] = height
    return ground


_MIN_COSINE = 0.97  # least cosine between normals of one wall
_MAX_THICKNESS = 0.15  # largest distance of a surfel from the plane of its wall, m
_MIN_SURFELS = 8  # fewest surfels of a wall
SURFEL_SIZE = 1.0  # voxel size of the surfels, m
PLANE_MAX_RANGE = 50.0  # largest distance from the sensor, m
MAX_TILT = 0.15  # largest z component of the normal of a wall
PLANE_MAX_GAP = 3.0  # largest gap within a wall, m
PLANE_MIN_LENGTH = 3.0  # least length of a wall, m
WALL_NOISE = 0.03  # standard deviation of surfels across their wall, m


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane and its visible part, in the sensor's frame.

    coefficients  (4,) n and d, d > 0
    covariance    (3, 3) of two tilts of n (rad^2) and of d (m^2); no correlations, the tilts alike
    extent        (2, 3) its ends: the lowest point of one end and the highest of the other
    """

    coefficients: FloatArray
    covariance: FloatArray
    extent: FloatArray


def fit_plane(points: FloatArray, noise: float) -> Plane:
    """The plane of points (N, 3), m, N >= 3, each with `noise` m across it."""
    centre = points.mean(axis=0)
    off = points - centre
    values, vectors = np.linalg.eigh(off.T @ off)
    normal, d = vectors[:, 0], float(-vectors[:, 0] @ centre)
    if d < 0:
        normal, d = -normal, -d
    tilt = noise**2 / max(float(values[1]), 1e-9)
    covariance = np.diag([tilt, tilt, noise**2 / len(points) + float(centre @ centre) * tilt])
    along = off @ vectors[:, 2]
    ends = np.stack([points[along.argmin()], points[along.argmax()]])
    ends[0, 2], ends[1, 2] = points[:, 2].min(), points[:, 2].max()
    return Plane(np.append(normal, d), covariance, ends)


def near_walls(positions: FloatArray, walls: Sequence[Plane], distance: float) -> BoolArray:
    """Mask of the positions (N, 3), m, within a horizontal `distance`, m, of the visible part of a wall."""
    near = np.zeros(len(positions), dtype=np.bool_)
    for wall in walls:
        along = np.array([-wall.coefficients[1], wall.coefficients[0]])
        ends = np.sort(wall.extent[:, :2] @ along)
        u = positions[:, :2] @ along
        across = np.abs(positions @ wall.coefficients[:3] + wall.coefficients[3])
        near |= (across <= distance) & (u >= ends[0] - distance) & (u <= ends[1] + distance)
    return near


def extract_walls(points: FloatArray) -> list[Plane]:
    """The walls among points (N, 3), m, of a scan without its ground, the largest first."""
    points = points[np.hypot(points[:, 0], points[:, 1]) <= PLANE_MAX_RANGE]
    surfels = surfels_of(points, SURFEL_SIZE)
    surfels = surfels.select(surfels.flat & (np.abs(surfels.normal[:, 2]) <= MAX_TILT))
    mean, normal = surfels.mean, surfels.normal
    coplanar = np.abs(normal @ normal.T) >= _MIN_COSINE
    across = np.abs(normal @ mean.T - np.einsum("ni,ni->n", normal, mean)[:, None])
    coplanar &= (across <= _MAX_THICKNESS) & (_MAX_THICKNESS >= across.T)
    walls: list[Plane] = []
    left = np.ones(len(mean), dtype=np.bool_)
    while left.any():
        support = coplanar[:, left].sum(axis=1) * left
        best = int(support.argmax())
        if support[best] < _MIN_SURFELS:
            break
        rows = _connected(mean, np.flatnonzero(coplanar[best] & left), best, PLANE_MAX_GAP)
        left[rows] = left[best] = False
        if len(rows) < _MIN_SURFELS:
            continue
        wall = fit_plane(mean[rows], WALL_NOISE)
        if (
            np.hypot(*(wall.extent[1] - wall.extent[0])[:2]) >= PLANE_MIN_LENGTH
            and abs(wall.coefficients[2]) <= MAX_TILT
        ):
            walls.append(wall)
    return walls


def _connected(mean: FloatArray, rows: IntArray, seed: int, gap: float) -> IntArray:
    """The rows connected with `seed` by gaps of at most `gap` m."""
    pairs = cKDTree(mean[rows]).query_pairs(gap, output_type="ndarray")
    links = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    _, part = connected_components(links, directed=False)
    return np.asarray(rows[part == part[np.flatnonzero(rows == seed)[0]]])


_MIN_FILLED = 0.5  # least share of half-metre steps of the height that contain points
_CLEAR_RADIUS = 0.6  # radius around the axis without other objects, m
_DEPTH_NOISE = 0.1  # standard deviation along the line of sight, from the unknown radius, m
CELL = 0.2  # cell of the clustering grid, m
POLE_MAX_RANGE = 40.0  # largest distance from the sensor, m
MIN_HEIGHT = 0.3  # lowest height above the ground of clustered points, m
POLE_MIN_LENGTH = 1.2  # least height from the lowest to the highest point, m
MAX_WIDTH = 0.6  # largest horizontal extent, m
MIN_POINTS = 8  # fewest points
CLEAR_SHARE = 0.1  # _CLEAR_RADIUS as a share of the range, against columns of walls at grazing angles
POLE_NOISE = 0.05  # standard deviation of the axis, m
BEARING_NOISE = 0.006  # standard deviation across the line of sight, rad


@dataclass(frozen=True, eq=False)
class Pole:
    """An upright pole, in the sensor's frame.

    foot        (3,) lowest visible point of the axis, m
    top         height of the highest visible point, m
    radius      m
    covariance  (2, 2) of the axis' position, x and y, m^2
    """

    foot: FloatArray
    top: float
    radius: float
    covariance: FloatArray


def extract_poles(points: FloatArray, height: FloatArray, walls: Sequence[Plane] = ()) -> list[Pole]:
    """The poles among points (N, 3), m, at `height` (N,) above the ground, m, except near `walls`."""
    points = points[(height >= MIN_HEIGHT) & (np.hypot(points[:, 0], points[:, 1]) <= POLE_MAX_RANGE)]
    everything = points
    points = points[~near_walls(points, walls, CELL)]
    slender = [points[rows] for rows in _slender(points, clusters_from_above(points, CELL))]
    if not slender:
        return []
    tree = cKDTree(everything[:, :2], balanced_tree=False, compact_nodes=False)
    poles = []
    for candidate in slender:
        pole = _pole(candidate)
        around = everything[
            tree.query_ball_point(pole.foot[:2], max(_CLEAR_RADIUS, CLEAR_SHARE * float(np.hypot(*pole.foot[:2]))))
        ]
        level = (around[:, 2] >= pole.foot[2]) & (around[:, 2] <= pole.top)
        if level.sum() <= 1.2 * len(candidate):
            poles.append(pole)
    return poles


def _slender(points: FloatArray, clusters: Sequence[IntArray]) -> list[IntArray]:
    """The clusters that are thin, tall and filled."""
    if not clusters:
        return []
    count = np.array([len(rows) for rows in clusters])
    grouped, start = points[np.concatenate(clusters)], np.cumsum(count) - count
    low, high = np.minimum.reduceat(grouped, start), np.maximum.reduceat(grouped, start)
    size = high - low
    thin = (count >= MIN_POINTS) & (size[:, :2].max(axis=1) <= MAX_WIDTH) & (size[:, 2] >= POLE_MIN_LENGTH)
    return [clusters[k] for k in np.flatnonzero(thin).tolist() if _filled(points[clusters[k], 2])]


def _filled(height: FloatArray) -> bool:
    steps = np.floor((height - height.min()) / 0.5)
    return bool(len(np.unique(steps)) >= _MIN_FILLED * np.ceil(np.ptp(height) / 0.5))


def _pole(points: FloatArray) -> Pole:
    mean = points[:, :2].mean(axis=0)
    sight = mean / max(float(np.hypot(*mean)), 1e-9)
    aside = np.array([-sight[1], sight[0]])
    across = points[:, :2] @ aside
    radius = float(np.ptp(across)) / 2
    axis = mean + np.pi / 4 * radius * sight
    covariance = np.cov(points[:, :2].T) / len(points) + POLE_NOISE**2 * np.eye(2)
    covariance += (BEARING_NOISE * float(np.hypot(*mean))) ** 2 * np.outer(aside, aside)
    covariance += _DEPTH_NOISE**2 * np.outer(sight, sight)
    return Pole(np.append(axis, points[:, 2].min()), float(points[:, 2].max()), radius, covariance)
