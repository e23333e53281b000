"""A simulated LiDAR drive along a random street with houses on both sides, parked cars and poles."""

from __future__ import annotations

import numpy as np

from data_tools.lidar import Scan, constant_velocity
from data_tools.simulator.scanner import ScannerSettings, StaticWorld, simulate_scan
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, yaw_transform
from saga_fg.types.boxes import Boxes

SENSOR_HEIGHT = 1.8  # m above the ground
CURB = 6.4  # m, from the middle of the road to its edge
SMALL = ScannerSettings(rings=24, columns=360)


def street(seed: int = 0, curbs: bool = False) -> StaticWorld:
    """Houses of different depth along a street on the x axis, 16 m wide, and across its end.

    curbs: raised pavements on both sides, `CURB` m from the middle of the road
    """
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
    for side in (-1.0, 1.0) if curbs else ():
        label.append("pavement")
        position.append((25.0, side * (CURB + 0.75), 0.075))
        size.append((170.0, 1.5, 0.15))
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
    curbs          pavements with curbs on both sides
    world          in place of the street
    """

    def __init__(
        self,
        seed: int,
        count: int = 60,
        world_T_lidar: FloatArray | None = None,
        settings: ScannerSettings = SMALL,
        curbs: bool = False,
        world: StaticWorld | None = None,
    ) -> None:
        self.world_T_ego: FloatArray = drive(count, period=settings.period) if world_T_lidar is None else world_T_lidar
        self.timestamps: FloatArray = settings.period * np.arange(len(self.world_T_ego), dtype=np.float64)
        self.ego_T_lidar: FloatArray = np.eye(4)
        self.world = street(seed, curbs) if world is None else world
        self._scans = scans(self.world, self.world_T_ego, seed, settings)

    def __len__(self) -> int:
        return len(self._scans)

    def __getitem__(self, row: int) -> Scan:
        return self._scans[row]
