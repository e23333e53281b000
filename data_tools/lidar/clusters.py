"""Detections without a trained detector: ground removed, clusters above it as oriented boxes.

Points above the ground are clustered from above; clusters as high as walls, or longer than any vehicle, are discarded.
The box of a cluster has the heading theta for which its points lie close to the box's sides: with c1, c2 the
coordinates of a point along and across theta, and d its distance from the nearer of the sides that bound c1 and c2,

    theta = argmax over [0, pi/2)  sum_i 1 / max(d_i, d0)         (closeness; Zhang et al., IV 2017)

One or two sides of a vehicle are visible. Its box is extended to the least size of its class, away from the sensor. The
class follows from the visible size. The score is the number of points relative to that of a car at this distance.

Source: Zhang, Xu, Dong, Dolan, Efficient L-shape fitting for vehicle detection using laser scanners, IV 2017.

Ground segmentation on a polar grid, ring by ring from the vehicle outwards.

In each sector the ground height of a ring is the lowest decile of its points' heights, if it differs from that of the
next inner ring by no more than the steepest road would rise; otherwise (a car, a wall, a reflection from below) the
inner height is kept. A point is ground if it lies within a clearance of the height interpolated between rings. After
Himmelsbach, Hundelshausen, Wuensche, Fast segmentation of 3D point clouds for ground vehicles, IV 2010, with heights
instead of lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data_tools.lidar.scan import cell_order_statistics, clusters_from_above
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.settings import Positive, PositiveInt, Settings, setting, settings_group
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections

_SECTORS = 60  # number of sectors of the polar grid
_RING_WIDTH = 1.5  # width of a ring, m
_MAX_SLOPE = 0.15  # steepest rise, m per m
MAX_RANGE = 80.0  # outer radius of the last ring, m
MAX_STEP = 0.1  # change of height between rings allowed beyond the slope, m
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
    sector = ((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    rings = int(np.ceil(MAX_RANGE / _RING_WIDTH))
    ring = np.minimum((distance / _RING_WIDTH).astype(np.int64), rings - 1)
    low = cell_order_statistics(points[:, 2], sector * rings + ring, _SECTORS * rings, 10).reshape(_SECTORS, rings)
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
        fits = np.abs(low[:, k] - height) <= MAX_STEP + _MAX_SLOPE * _RING_WIDTH * since  # False in empty cells
        height = np.where(fits, low[:, k], height)
        since = np.where(fits, 1.0, since + 1.0)
        ground[:, k] = height
    return ground


_MAX_FOOT_HEIGHT = 0.6  # largest height above the ground of an object's lowest point, m
_HEADINGS = np.radians(np.arange(0.0, 90.0, 2.0))
_CLOSE = 0.1  # m, d0


@dataclass(frozen=True)
class ObjectSize:
    """Visible sizes of a class of objects, from - to, and the least size of its boxes."""

    length: tuple[float, float] = setting((0.0, 6.0), "visible length of the longer side, m")
    width: tuple[float, float] = setting((0.0, 2.6), "visible length of the shorter side, m")
    height: tuple[float, float] = setting((0.7, 2.6), "height above the ground, m")
    complete: tuple[float, float] = setting((4.2, 1.75), "least length and width of a box, m")


def _sizes() -> dict[str, ObjectSize]:
    return {
        "pedestrian": ObjectSize((0.15, 1.0), (0.1, 0.9), (1.0, 2.1), (0.7, 0.6)),
        "cyclist": ObjectSize((1.0, 2.1), (0.2, 0.95), (1.2, 2.1), (1.8, 0.7)),
        "car": ObjectSize((1.4, 7.0), (0.2, 2.6), (1.2, 2.6), (4.2, 1.75)),
    }


@dataclass(frozen=True)
class ClusterSettings(Settings):
    """Clustering of points into boxes; the first class whose sizes fit is taken."""

    cell: Positive = setting(0.3, "cell of the clustering grid, m; raised: points farther apart join")
    min_height: Positive = setting(0.25, "lowest height above the ground of clustered points, m")
    max_height: Positive = setting(2.6, "largest height above the ground of an object, m")
    max_range: Positive = setting(40.0, "largest distance from the sensor, m")
    min_points: PositiveInt = setting(10, "fewest points of an object")
    classes: Mapping[str, ObjectSize] = settings_group(_sizes, "sizes by class")


def detect_clusters(points: FloatArray, settings: ClusterSettings | None = None) -> Detections:
    """Boxes of the objects on the ground in a scan (N, 3), m; in the sensor's frame, with classes and scores."""
    s = settings or ClusterSettings()
    ground = segment_ground(points)
    near = np.hypot(points[:, 0], points[:, 1]) <= s.max_range
    above = near & (ground.height >= s.min_height)
    points, height = points[above], ground.height[above]
    candidates = [
        _detection(points[rows], float(height[rows].max()), s)
        for rows in clusters_from_above(points, s.cell)
        if len(rows) >= s.min_points and height[rows].max() <= s.max_height and height[rows].min() <= _MAX_FOOT_HEIGHT
    ]
    found = [candidate for candidate in candidates if candidate is not None]
    if not found:
        return Detections.empty()
    label, position, size, yaw, score = zip(*found, strict=True)
    boxes = Boxes.of(list(label), np.array(position), np.array(size), np.array(yaw))
    return Detections(boxes, np.array(score))


def _detection(
    points: FloatArray, top: float, s: ClusterSettings
) -> tuple[str, FloatArray, FloatArray, float, float] | None:
    yaw = l_shape_heading(points[:, :2])
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    local = points[:, :2] @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    visible = high - low
    if visible[1] > visible[0]:  # the longer side is the length
        yaw += np.pi / 2
        low, high = np.array([low[1], -high[0]]), np.array([high[1], -low[0]])
        axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        visible = high - low
    label = next((name for name, size in s.classes.items() if _fits(visible, top, size)), None)
    if label is None:
        return None
    least = np.array(s.classes[label].complete)
    if label == "car" and visible[0] < least[1] + 0.3:
        least = least[::-1]  # only the rear or front is visible, the length is away from the sensor
    size = np.maximum(visible, least)
    centre = (low + high) / 2
    away = np.sign(centre)  # the sensor is at 0: the hidden part lies behind the visible one
    centre = centre + away * (size - visible) / 2
    if size[1] > size[0]:
        yaw, size = yaw + np.pi / 2, size[::-1]
    centre = axes.T @ centre
    bottom = float(points[:, 2].max()) - top
    position = np.array([*centre, bottom + top / 2])
    return label, position, np.array([*size, top]), float(yaw), _score(len(points), float(np.hypot(*centre)))


def l_shape_heading(points: FloatArray) -> float:
    """The heading (rad, from 0 to pi/2) of the rectangle whose sides points (N, 2) lie closest to."""
    along = np.stack([np.cos(_HEADINGS), np.sin(_HEADINGS)])
    c1, c2 = points @ along, points @ np.stack([-along[1], along[0]])
    d1 = np.minimum(c1.max(axis=0) - c1, c1 - c1.min(axis=0))
    d2 = np.minimum(c2.max(axis=0) - c2, c2 - c2.min(axis=0))
    closeness = (1.0 / np.maximum(np.minimum(d1, d2), _CLOSE)).sum(axis=0)
    return float(_HEADINGS[closeness.argmax()])


def _fits(visible: FloatArray, top: float, size: ObjectSize) -> bool:
    ranges = zip((*visible, top), (size.length, size.width, size.height), strict=True)
    return all(low <= value <= high for value, (low, high) in ranges)


def _score(points: int, distance: float) -> float:
    """Score in [0, 1]: points relative to 3000 / distance, the least of a vehicle with a sensor of 64 rings."""
    return float(min(1.0, 0.2 + 0.8 * points * distance / 3000.0))
