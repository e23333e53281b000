"""A simulated drive with a LiDAR, in the shape in which recorded scans come."""

from __future__ import annotations

import numpy as np

from data_tools.lidar import Scan
from data_tools.simulator.scanner import ScannerSettings
from data_tools.simulator.street import SMALL, drive, scans, street
from saga_fg.numerics.arrays import FloatArray


class SimulatedScans:
    """Scans of a drive along the street of a seed: `data_tools.lidar.scan_sequence.ScanSequence` with the true poses.

    world_T_lidar  (K, 4, 4), K >= 2, true poses; None for a drive of `count` scans
    kerbs          whether the street has them
    """

    def __init__(
        self,
        seed: int,
        count: int = 60,
        world_T_lidar: FloatArray | None = None,
        settings: ScannerSettings = SMALL,
        kerbs: bool = False,
    ) -> None:
        self.world_T_ego: FloatArray = drive(count, period=settings.period) if world_T_lidar is None else world_T_lidar
        self.timestamps: FloatArray = settings.period * np.arange(len(self.world_T_ego), dtype=np.float64)
        self.ego_T_lidar: FloatArray = np.eye(4)
        self.world = street(seed, kerbs)
        self._scans = scans(self.world, self.world_T_ego, seed, settings)

    def __len__(self) -> int:
        return len(self._scans)

    def __getitem__(self, row: int) -> Scan:
        return self._scans[row]
