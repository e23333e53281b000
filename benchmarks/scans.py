"""Simulated scanners: a LiDAR along a random street, and a planar laser in a building.

A spinning LiDAR in a world of boxes, poles and level ground: scans with known poses.

A ray from o in direction u (|u| = 1) meets, at the least positive s,

    the ground         o_z + s u_z = 0
    an upright pole    | (o + s u - c)_xy | = r,   0 <= z <= h
    an oriented box    the slabs | x | <= l/2, | y | <= w/2, | z | <= h/2 of its own frame   (Kay and Kajiya, 1986)

The head turns clockwise once a period and looks ahead at the scan's timestamp. It moves with constant velocity while it
turns, which skews the scans like real ones. Ranges have Gaussian noise.

A robot with a planar laser and poor wheels that drives round the corridor of a building.

The corridor runs round a block; niches and cupboards of random size make places tell apart. Wheels turn too far by a
constant share and at random, so that odometry does not close. All is known: the true poses come with the log.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from data_tools.datasets.mcap.ros2_types import definition, header
from data_tools.laser import LaserLog
from data_tools.lidar import Scan, ScanSequence, constant_velocity
from pipelines.slam.odometry import OdometrySettings, OdometryStep, moved_on
from saga_fg import Boxes
from saga_fg.numerics import (
    BoolArray,
    FloatArray,
    IntArray,
    checked,
    inverse_transform,
    transforms,
    wrap_angle,
    yaw_transform,
)


class GivenPoses:
    """An odometry of poses (K, 4, 4) of the sensor that are known, with deviations of a step, rad and m.

    Scans that it places have no skew.
    """

    def __init__(self, poses: FloatArray, rotation: float, translation: float) -> None:
        self._poses = inverse_transform(poses[0]) @ poses
        self._noise, self._row, self._keyframe = np.diag([rotation] * 3 + [translation] * 3) ** 2, 0, 0

    def step(self, scan: Scan, timestamp: float, velocity: FloatArray | None = None) -> OdometryStep:
        """Place the next scan."""
        k, placed = self._row, self._poses[self._row]
        keyframe = k == 0 or moved_on(inverse_transform(self._poses[self._keyframe]) @ placed)
        self._row, self._keyframe = k + 1, k if keyframe else self._keyframe
        near = scan.within(OdometrySettings().min_range, OdometrySettings().max_range)
        return OdometryStep(timestamp, placed, self._noise if k else np.zeros((6, 6)), near, keyframe, None)


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
class ScannerSettings:
    """Resolution and noise of the LiDAR; 64 rings and 2000 columns are those of a Velodyne HDL-64E.

    rings, columns   beams, one above the other, and firings a turn
    lowest, highest  elevations of the outer beams, rad
    reach, noise     longest range, and standard deviation of a range, m
    period           duration of a turn, s
    """

    rings: int = 32
    columns: int = 720
    lowest: float = -0.44
    highest: float = 0.06
    reach: float = 80.0
    noise: float = 0.02
    period: float = 0.1


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


SENSOR_HEIGHT = 1.8  # m above the ground
SMALL = ScannerSettings(rings=24, columns=360)


def street(seed: int = 0) -> StaticWorld:
    """Houses of different depth along a street on the x axis, 16 m wide, and across its end."""
    rng = np.random.default_rng(seed)
    label, position, size = [], [], []
    for side in (-1.0, 1.0):
        x = -60.0
        while x < 110.0:
            length, depth = rng.uniform(8.0, 20.0), rng.uniform(4.0, 8.0)
            label.append("house")
            position.append((x + length / 2, side * (8.0 + rng.uniform(0.0, 2.0) + depth / 2), 3.0))
            size.append((length, depth, 6.0))
            x += length + rng.uniform(2.0, 6.0)
        for x in np.arange(-20.0, 60.0, 11.0) + rng.uniform(0.0, 3.0):
            label.append("car")
            position.append((float(x), side * 5.0, 0.75))
            size.append((4.4, 1.8, 1.5))
    label.append("house")
    position.append((120.0, 0.0, 3.0))
    size.append((6.0, 60.0, 6.0))
    poles = np.array([[x, side * 7.0, 0.15, 5.0] for side in (-1, 1) for x in np.arange(-30.0, 80.0, 17.0) + 4 * side])
    n = len(label)
    return StaticWorld(Boxes.of(label, position, size, np.zeros(n), np.zeros((n, 2))), poles)


def drive(count: int, speed: float = 8.0, turn_rate: float = 0.05, period: float = 0.1) -> FloatArray:
    """world_T_lidar (count, 4, 4) of a sensor at `SENSOR_HEIGHT` that sways along; m/s, rad/s, s between poses."""
    poses = [yaw_transform(-5.0, -1.5, SENSOR_HEIGHT, 0.0)]
    for k in range(count - 1):
        rate = turn_rate * np.sin(2 * np.pi * k / 40)
        poses.append(poses[-1] @ yaw_transform(speed * period, 0.0, 0.0, rate * period))
    return np.array(poses)


def scans(
    world: StaticWorld, poses: FloatArray, seed: int = 0, settings: ScannerSettings = SMALL, skewed: bool = True
) -> list[Scan]:
    """One scan at each pose (K, 4, 4), K >= 2, skewed by the motion to the next unless `skewed` is False."""
    rng = np.random.default_rng(seed)
    period = settings.period
    taken = []
    for k, pose in enumerate(poses):
        a, b = min(k, len(poses) - 2), min(k, len(poses) - 2) + 1
        velocity = constant_velocity(inverse_transform(poses[a]) @ poses[b], period) if skewed else None
        taken.append(simulate_scan(world, pose, rng, settings, velocity))
    return taken


class SimulatedScans:
    """Scans of a drive along the street of a seed: `data_tools.lidar.scan.ScanSequence` with the true poses.

    world_T_lidar  (K, 4, 4), K >= 2, true poses; None for a drive of `count` scans
    world          in place of the street
    """

    def __init__(
        self,
        seed: int,
        count: int = 60,
        world_T_lidar: FloatArray | None = None,
        settings: ScannerSettings = SMALL,
        world: StaticWorld | None = None,
    ) -> None:
        self.world_T_ego: FloatArray = drive(count, period=settings.period) if world_T_lidar is None else world_T_lidar
        self.timestamps: FloatArray = settings.period * np.arange(len(self.world_T_ego), dtype=np.float64)
        self.ego_T_lidar: FloatArray = np.eye(4)
        self.world = street(seed) if world is None else world
        self._scans = scans(self.world, self.world_T_ego, seed, settings)

    def __len__(self) -> int:
        return len(self._scans)

    def __getitem__(self, row: int) -> Scan:
        return self._scans[row]


_FIELDS = ("x", "y", "z", "time")


def write_recording(scans: ScanSequence, folder: Path, mcap: Path | None = None, begin: int = 1_700_000_000) -> None:
    """Write scans with times as files NANOSECONDS.npz, and as PointCloud2 of MCAP; begin: s, of the first one."""
    from mcap_ros2.writer import Writer

    folder.mkdir()
    stamps = [begin * 10**9 + round(1e9 * time) for time in scans.timestamps.tolist()]
    for k, stamp in enumerate(stamps):
        np.savez(folder / f"{stamp}.npz", points=scans[k].points, time=np.asarray(scans[k].time))
    if mcap is None:
        return
    fields = [{"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate(_FIELDS)]
    with mcap.open("wb") as file:
        writer: Any = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/PointCloud2", definition("sensor_msgs/PointCloud2"))
        for k, stamp in enumerate(stamps):
            rows = np.column_stack([scans[k].points, np.asarray(scans[k].time)]).astype("<f4")
            layout = {"height": 1, "width": len(rows), "fields": fields, "is_bigendian": False, "is_dense": True}
            data = {"point_step": 4 * len(_FIELDS), "row_step": rows.nbytes, "data": rows.tobytes()}
            writer.write_message("/points", schema, {"header": header(stamp, "lidar"), **layout, **data}, stamp, stamp)
        writer.finish()


_OUTER, _WIDTH = (30.0, 20.0), 3.0  # m: the building, its corridor
_PERIOD = 0.2  # s between scans
_BIAS, _SPREAD = 0.006, 0.01  # rad per m that the wheels turn too far, and rad per root metre at random


@dataclass(frozen=True)
class LaserKind:
    """A laser and its robot.

    readings over `field`, rad; reach, noise (standard deviation) and steps between scans, m; missing: share of readings
    that hit nothing; wheels: ratio of the way that they tell to the true one; people: who walk ahead of the robot
    """

    readings: int = 180
    field: float = np.pi
    reach: float = 20.0
    noise: float = 0.01
    missing: float = 0.0
    step: float = 0.15
    wheels: float = 1.02
    people: int = 0


def laser_drive(seed: int, rounds: float = 1.5, kind: LaserKind | None = None) -> tuple[LaserLog, FloatArray]:
    """A log of a drive, and the true poses (n, 3, 3), the first one at the origin."""
    rng, kind = np.random.default_rng(seed), kind or LaserKind()
    walls = _walls(rng)
    x = _path(rounds, kind.step)
    n = len(x)
    whole = kind.readings - kind.readings % 2
    angles = np.asarray(kind.field * (np.arange(kind.readings) / whole - 0.5), dtype=np.float64)
    ranges = np.stack([_rays(_with_people(walls, kind.people, k, pose), pose, angles) for k, pose in enumerate(x)])
    ranges = ranges + kind.noise * rng.normal(size=ranges.shape)
    ranges[ranges > kind.reach] = np.nan
    if kind.missing > 0:
        ranges[rng.random(ranges.shape) < kind.missing] = np.nan
    true = transforms(x)
    steps = np.linalg.inv(true[:-1]) @ true[1:]
    way = np.hypot(steps[:, 0, 2], steps[:, 1, 2])
    turn = np.arctan2(steps[:, 1, 0], steps[:, 0, 0]) + _BIAS * way + _SPREAD * np.sqrt(way) * rng.normal(size=n - 1)
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    ahead = kind.wheels * way
    place = np.stack([np.cumsum(ahead * np.cos(heading[:-1])), np.cumsum(ahead * np.sin(heading[:-1]))], axis=1)
    odometry = np.column_stack([np.concatenate([np.zeros((1, 2)), place]), heading])
    time = np.asarray(_PERIOD * np.arange(n), dtype=np.float64)
    log = LaserLog(time, ranges, np.tile(angles, (n, 1)), odometry, np.zeros(3))
    return log, np.linalg.inv(true[0]) @ true


def _walls(rng: np.random.Generator) -> FloatArray:
    """Segments (k, 2, 2) of the walls."""
    (w, h), inset = _OUTER, _WIDTH
    boxes = [(0.0, 0.0, w, h), (inset, inset, w - inset, h - inset)]
    for _ in range(24):  # cupboards along the outer wall, and niches in it
        along, deep, long = rng.uniform(0.08, 0.92), rng.uniform(-0.8, 0.4), rng.uniform(0.4, 1.5)
        side = int(rng.integers(4))
        if side % 2 == 0:
            x, y = along * w, 0.0 if side == 0 else h
            boxes.append((x, y, x + long, y + (deep if side == 0 else -deep)))
        else:
            x, y = w if side == 1 else 0.0, along * h
            boxes.append((x, y, x + (-deep if side == 1 else deep), y + long))
    return _sides(boxes)


def _with_people(walls: FloatArray, people: int, k: int, pose: FloatArray) -> FloatArray:
    """Segments with boxes of people who walk ahead at scan k, each off to another side, and draw away by and by."""
    boxes = []
    for number in range(people):
        far = 1.5 + (0.01 * k + 2.5 * number) % 5
        turn = pose[2] + 0.3 * np.sin(0.05 * k + 2 * number)
        x, y = pose[:2] + far * np.array([np.cos(turn), np.sin(turn)])
        boxes.append((x - 0.15, y - 0.1, x + 0.15, y + 0.1))
    return np.concatenate([walls, _sides(boxes)]) if boxes else walls


def _sides(boxes: list[tuple[float, float, float, float]]) -> FloatArray:
    """Segments (k, 2, 2) of boxes: x and y of two corners."""
    corners = np.array([[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in boxes])
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def _path(rounds: float, step: float) -> FloatArray:
    """Poses (n, 3): x, y, heading along the middle of the corridor, with round corners."""
    (w, h), m, r = _OUTER, _WIDTH / 2, 1.0
    long, short = w - 2 * m - 2 * r, h - 2 * m - 2 * r
    lengths = np.array([long, r * np.pi / 2, short, r * np.pi / 2] * 2)
    ends = np.cumsum(lengths)
    way = np.arange(0.0, rounds * ends[-1], step)
    turned = 2 * np.pi * (way // ends[-1])
    part = np.searchsorted(ends, way % ends[-1], side="right")
    inside = way % ends[-1] - (ends - lengths)[part]
    heading = turned + np.pi / 2 * (part // 2) + np.where(part % 2 == 1, inside / r, 0.0)
    middle = (heading[1:] + heading[:-1]) / 2
    steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    place = np.array([m + r, m]) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([place, heading])


def _rays(walls: FloatArray, pose: FloatArray, angles: FloatArray) -> FloatArray:
    """Ranges (m,) from a pose (3,)."""
    u = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=1)
    a, e = walls[:, 0] - pose[:2], walls[:, 1] - walls[:, 0]
    across = u[:, None, 0] * e[None, :, 1] - u[:, None, 1] * e[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        far = (a[None, :, 0] * e[None, :, 1] - a[None, :, 1] * e[None, :, 0]) / across
        along = (a[None, :, 0] * u[:, None, 1] - a[None, :, 1] * u[:, None, 0]) / across
    hit = (far > 0.02) & (along >= 0) & (along <= 1)
    return np.asarray(np.where(hit, far, np.inf).min(axis=1))
