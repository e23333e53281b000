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
from saga_fg.numerics.arrays import FloatArray, checked
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
    direction = np.einsum("cij,crj->cri", poses[:, :3, :3], beam).reshape(-1, 3)
    origin = np.repeat(poses[:, :3, 3], s.rings, axis=0)
    distance = ranges(world, origin, direction)
    hit = distance <= s.reach
    noisy = distance[hit] + rng.normal(0.0, s.noise, int(hit.sum()))
    return Scan(beam.reshape(-1, 3)[hit] * noisy[:, None], np.full(len(noisy), np.nan), np.repeat(time, s.rings)[hit])


def ranges(world: StaticWorld, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Ranges (N,), m, of rays from `origin` (N, 3) in unit `direction` (N, 3); infinite for rays that hit nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(direction[:, 2] < 0, -origin[:, 2] / direction[:, 2], np.inf)
        nearest = np.where(ground > 0, ground, np.inf)
        for pole in world.poles:
            nearest = np.minimum(nearest, _to_pole(pole, origin, direction))
        for row in range(len(world.boxes)):
            nearest = np.minimum(nearest, _to_box(world.boxes.select([row]), origin, direction))
    return nearest


def _to_pole(pole: FloatArray, origin: FloatArray, direction: FloatArray) -> FloatArray:
    off, along = origin[:, :2] - pole[:2], direction[:, :2]
    a, b = (along**2).sum(axis=1), (off * along).sum(axis=1)
    root = b**2 - a * ((off**2).sum(axis=1) - pole[2] ** 2)
    s = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    z = origin[:, 2] + s * direction[:, 2]
    return np.where((root >= 0) & (s > 0) & (z >= 0) & (z <= pole[3]), s, np.inf)


def _to_box(box: Boxes, origin: FloatArray, direction: FloatArray) -> FloatArray:
    c, s = np.cos(box.yaw[0]), np.sin(box.yaw[0])
    box_R_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    o, u = (origin - box.position[0]) @ box_R_world.T, direction @ box_R_world.T
    half = box.size[0] / 2
    first, second = (-half - o) / u, (half - o) / u
    near = np.nanmax(np.minimum(first, second), axis=1)
    far = np.nanmin(np.maximum(first, second), axis=1)
    return np.where((near <= far) & (near > 0), near, np.inf)
