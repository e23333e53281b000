"""The LiDAR scans of a KITTI tracking sequence: velodyne/NNNN/KKKKKK.bin, one for each frame that has one.

The Velodyne turns clockwise, ten times a second, and looks ahead when the cameras are triggered, which is the time of
the frame. Its points carry no times; those of their azimuths are given here, for scans that are not compensated for the
vehicle's motion. A copy of the dataset does not say whether its scans are: `timed=False` leaves the times out. Sources:
Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013; KISS-ICP, which takes azimuths for times as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_tools.datasets.kitti.dataset import FRAME_PERIOD, KittiTracking
from data_tools.lidar import Scan, azimuth_times, read_scan
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform


class KittiScans:
    """The scans of a sequence, the first `most` or all of them, read one at a time; `timed`: with times of points.

    With `blind` there is one for each GPS/IMU record, without any points, for what needs none.

    frames         (K,) their frame numbers, in order; timestamps (K,) s
    ego_T_lidar    (4, 4) place of the sensor on the vehicle
    world_T_ego    (K, 4, 4) pose of the vehicle by GPS/IMU at each scan

    Raises `InputError` where there are none, and for a scan without a GPS/IMU record.
    """

    def __init__(
        self, dataroot: str | Path, sequence: str, timed: bool = True, most: int | None = None, blind: bool = False
    ) -> None:
        root = Path(dataroot)
        root = root / "training" if (root / "training").is_dir() else root
        dataset = KittiTracking(dataroot, sequences=[sequence])
        calibration = dataset.calibration(sequence)
        poses = dataset.scene(sequence).world_T_ego
        self._files = () if blind else _files(root / "velodyne" / sequence, len(poses))[:most]
        frames = range(len(poses))[:most] if blind else [int(path.stem) for path in self._files]
        self.frames = np.array(frames, dtype=np.int64)
        self.timestamps: FloatArray = self.frames.astype(np.float64) * FRAME_PERIOD
        self.world_T_ego: FloatArray = poses[self.frames]
        self.ego_T_lidar: FloatArray = inverse_transform(calibration.camera_T_imu) @ calibration.camera_T_velodyne
        self._timed = timed

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, row: int) -> Scan:
        if not self._files:
            return Scan(np.empty((0, 3)), np.empty(0))
        scan = read_scan(self._files[row])
        return replace(scan, time=azimuth_times(scan.points, FRAME_PERIOD)) if self._timed else scan

    def __iter__(self) -> Iterator[Scan]:
        return (self[row] for row in range(len(self)))


def _files(folder: Path, records: int) -> tuple[Path, ...]:
    """The scans in a folder, in order."""
    files = tuple(sorted(path for path in folder.glob("*.bin") if path.stem.isdigit()))
    if not files:
        raise InputError(f"{folder}: expected LiDAR scans KKKKKK.bin, there are none")
    if int(files[-1].stem) >= records:
        raise InputError(f"{files[-1]}: expected frames 0 to {records - 1}, as there are GPS/IMU records")
    return files
