"""A spinning LiDAR in a world of boxes, poles and level ground: scans with known poses.

A ray from o in direction u (|u| = 1) meets, at the least positive s,

    the ground         o_z + s u_z = 0
    an upright pole    | (o + s u - c)_xy | = r,   0 <= z <= h
    an oriented box    the slabs | x | <= l/2, | y | <= w/2, | z | <= h/2 of its own frame   (Kay and Kajiya, 1986)

The head turns clockwise once a period and looks ahead at the scan's timestamp. It moves with constant velocity while it
turns, which skews the scans like real ones. Ranges have Gaussian noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from data_tools.lidar import Scan
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, checked
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.settings import Positive, PositiveInt, Settings, setting
from saga_fg.types.boxes import Boxes


@dataclass(frozen=True, eq=False)
class StaticWorld:
    """Static objects on the level ground z = 0, in world coordinates.

    boxes  walls, houses, parked vehicles, curbs
    poles  (M, 4) x, y, radius, height, m; upright cylinders from the ground
    """

    boxes: Boxes
    poles: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "poles", checked("poles", self.poles, (None, 4)))

    def within(self, position: FloatArray, reach: float) -> StaticWorld:
        """The surfaces within `reach`, m, of a position (3,), seen from above."""
        boxes, poles = self.boxes, self.poles
        apart = np.linalg.norm(boxes.position[:, :2] - position[:2], axis=1)
        near = apart - np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2 <= reach
        return StaticWorld(boxes.select(near), poles[np.linalg.norm(poles[:, :2] - position[:2], axis=1) <= reach])


@dataclass(frozen=True)
class ScannerSettings(Settings):
    """Resolution and noise of the LiDAR; 64 rings and 2000 columns are those of a Velodyne HDL-64E."""

    rings: PositiveInt = setting(32, "number of beams, one above the other")
    columns: PositiveInt = setting(720, "number of firings a turn")
    lowest: float = setting(-0.44, "elevation of the lowest beam, rad")
    highest: float = setting(0.06, "elevation of the highest beam, rad")
    reach: Positive = setting(80.0, "longest range, m")
    noise: float = setting(0.02, "standard deviation of a range, m")
    period: Positive = setting(0.1, "duration of a turn, s")


def simulate_scan(
    world: StaticWorld,
    world_T_lidar: FloatArray,
    rng: np.random.Generator,
    settings: ScannerSettings | None = None,
    velocity: FloatArray | None = None,
) -> Scan:
    """The scan at `world_T_lidar` (4, 4), the sensor's pose when it looks ahead.

    velocity  (6,) turn rate, rad/s, and velocity, m/s, in the sensor's frame; None for a static sensor
    """
    s = settings or ScannerSettings()
    turn = -np.pi + 2 * np.pi * (np.arange(s.columns) + 0.5) / s.columns
    time = turn * (s.period / (2 * np.pi))
    elevation = np.linspace(s.lowest, s.highest, s.rings)
    beam = np.stack(
        [
            np.cos(elevation) * np.cos(-turn)[:, None],
            np.cos(elevation) * np.sin(-turn)[:, None],
            np.broadcast_to(np.sin(elevation), (s.columns, s.rings)),
        ],
        axis=-1,
    )
    xi = np.zeros(6) if velocity is None else checked("velocity", velocity, (6,))
    poses = world_T_lidar @ np.array([gtsam.Pose3.Expmap(t * xi).matrix() for t in time])
    direction = np.einsum("cij,crj->cri", poses[:, :3, :3], beam)
    distance = ranges(world.within(world_T_lidar[:3, 3], s.reach), poses[:, :3, 3], direction).ravel()
    hit = distance <= s.reach
    noisy = distance[hit] + rng.normal(0.0, s.noise, int(hit.sum()))
    return Scan(beam.reshape(-1, 3)[hit] * noisy[:, None], np.full(len(noisy), np.nan), np.repeat(time, s.rings)[hit])


def ranges(world: StaticWorld, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Ranges (C, R), m, of R rays, unit `direction` (C, R, 3), from each `origin` (C, 3); infinite without a hit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(direction[..., 2] < 0, -origin[:, None, 2] / direction[..., 2], np.inf)
        nearest = np.where(ground > 0, ground, np.inf)
        boxes, poles = world.boxes, world.poles
        half = np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2
        column, row = np.nonzero(_in_sight(boxes.position[:, :2], half, origin, direction))
        _shorten(nearest, column, _to_boxes(boxes.select(row), origin[column], direction[column]))
        column, row = np.nonzero(_in_sight(poles[:, :2], poles[:, 2], origin, direction))
        _shorten(nearest, column, _to_poles(poles[row], origin[column], direction[column]))
    return nearest


def _shorten(nearest: FloatArray, column: IntArray, distance: FloatArray) -> None:
    """Take the least of ranges (P, R) of each column, in ascending order (P,), into `nearest` (C, R)."""
    if len(column):
        first = np.flatnonzero(np.diff(column, prepend=-1))
        at = column[first]
        nearest[at] = np.minimum(nearest[at], np.minimum.reduceat(distance, first))


def _in_sight(centre: FloatArray, radius: FloatArray, origin: FloatArray, direction: FloatArray) -> BoolArray:
    """Mask (C, M) of the circles (M, 2) that rays of each origin can meet, seen from above."""
    bearing = np.arctan2(direction[..., 1], direction[..., 0])
    middle = np.arctan2(direction[..., 1].sum(axis=1), direction[..., 0].sum(axis=1))
    width = np.abs(wrap_angle(bearing - middle[:, None])).max(axis=1)
    off = centre - origin[:, None, :2]
    ratio = radius / np.hypot(off[..., 0], off[..., 1])
    angle = np.where(ratio < 1, np.arcsin(np.minimum(ratio, 1.0)), np.pi)
    turned = np.abs(wrap_angle(np.arctan2(off[..., 1], off[..., 0]) - middle[:, None]))
    return np.asarray(turned <= angle + width[:, None] + 1e-9)


def _to_poles(pole: FloatArray, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Ranges (P, R) of the rays of P origins (P, 3) to a pole each (P, 4)."""
    off, along = (origin[:, :2] - pole[:, :2])[:, None], direction[..., :2]
    a, b = (along**2).sum(axis=-1), (off * along).sum(axis=-1)
    root = b**2 - a * ((off**2).sum(axis=-1) - pole[:, None, 2] ** 2)
    s = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    z = origin[:, None, 2] + s * direction[..., 2]
    return np.where((root >= 0) & (s > 0) & (z >= 0) & (z <= pole[:, None, 3]), s, np.inf)


def _to_boxes(box: Boxes, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Ranges (P, R) of the rays of P origins (P, 3) to a box each."""
    c, s, off = np.cos(box.yaw), np.sin(box.yaw), origin - box.position
    near, far = np.full(direction.shape[:2], -np.inf), np.full(direction.shape[:2], np.inf)
    for axis, (x, y, z) in enumerate(((c, s, 0 * c), (-s, c, 0 * c), (0 * c, 0 * c, 0 * c + 1))):
        o = (x * off[:, 0] + y * off[:, 1] + z * off[:, 2])[:, None]
        u = direction[..., 2] if axis == 2 else x[:, None] * direction[..., 0] + y[:, None] * direction[..., 1]
        half = box.size[:, axis, None] / 2
        first, second = (-half - o) / u, (half - o) / u
        near = np.fmax(near, np.minimum(first, second))  # a ray in the plane of a side gives NaN, which says nothing
        far = np.fmin(far, np.maximum(first, second))
    return np.where((near <= far) & (near > 0), near, np.inf)
