"""What pipelines ask of recorded LiDAR scans; `data_tools.datasets.kitti.KittiScans` is one."""

from __future__ import annotations

from typing import Protocol

from data_tools.lidar import Scan
from saga_fg.numerics.arrays import FloatArray


class ScanSequence(Protocol):
    """K scans in order of time, read when asked for.

    timestamps   (K,) s
    world_T_ego  (K, 4, 4) reference poses of the vehicle
    ego_T_lidar  (4, 4) place of the sensor on it
    """

    @property
    def timestamps(self) -> FloatArray: ...
    @property
    def world_T_ego(self) -> FloatArray: ...
    @property
    def ego_T_lidar(self) -> FloatArray: ...
    def __len__(self) -> int: ...
    def __getitem__(self, row: int) -> Scan: ...
