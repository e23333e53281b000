"""The LiDAR scans of nuScenes keyframes: samples/LIDAR_TOP/*.pcd.bin, named by `sample_data`.

Many copies of the tables come without the files; a keyframe whose file is not there has no scan.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from data_tools.datasets.nuscenes.dataset import NuScenes
from data_tools.datasets.nuscenes.scenes import LIDAR, rigid_transform
from data_tools.datasets.nuscenes.tables import read_table
from data_tools.files.error_messages import error_context
from data_tools.lidar import Scan, read_scan
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class NuScenesScans:
    """The K scans of a scene, read one at a time.

    timestamps   (K,) s; world_T_ego (K, 4, 4) poses of the vehicle at them
    ego_T_lidar  (4, 4) place of the sensor on the vehicle
    """

    files: Sequence[Path]
    timestamps: FloatArray
    world_T_ego: FloatArray
    ego_T_lidar: FloatArray

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, row: int) -> Scan:
        return read_scan(self.files[row])

    def __iter__(self) -> Iterator[Scan]:
        return (self[row] for row in range(len(self)))


def nuscenes_scans(dataset: NuScenes, dataroot: str | Path) -> dict[str, NuScenesScans]:
    """The scans of the dataset's scenes, by name; scenes without any are left out.

    Raises `InputError` for broken tables, and for names of files outside the dataroot.
    """
    lidars = {
        token for token, channel in read_table(dataset.folder, "sensor", ("token", "channel")) if channel == LIDAR
    }
    wanted = {token for record in dataset.records.values() for token in record.tokens}
    fields = ("sample_token", "calibrated_sensor_token", "is_key_frame", "filename")
    mounted = {
        token: (translation, rotation)
        for token, sensor, translation, rotation in read_table(
            dataset.folder, "calibrated_sensor", ("token", "sensor_token", "translation", "rotation")
        )
        if sensor in lidars
    }
    taken: dict[str, tuple[Path, str]] = {}
    for sample, sensor, key, name in read_table(dataset.folder, "sample_data", fields):
        if key and sensor in mounted and sample in wanted:
            file = file_below(Path(dataroot), dataset.folder, sample, name)
            if file.is_file():
                taken[sample] = (file, sensor)
    scans = {}
    for scene, record in dataset.records.items():
        rows = [k for k, token in enumerate(record.tokens) if token in taken]
        if not rows:
            continue
        sensor = taken[record.tokens[rows[0]]][1]
        with error_context(f"{dataset.folder / 'calibrated_sensor.json'}: record {sensor}"):
            ego_T_lidar = rigid_transform(*mounted[sensor])
        files = [taken[record.tokens[k]][0] for k in rows]
        scans[scene] = NuScenesScans(files, record.timestamps[rows], record.world_T_ego[np.array(rows)], ego_T_lidar)
    return scans


def file_below(dataroot: Path, folder: Path, sample: str, name: object) -> Path:
    """The file that `sample_data` in `folder` names. Raises `InputError` for one outside the dataroot."""
    path = PurePosixPath(name) if isinstance(name, str) else PurePosixPath("..")
    if path.is_absolute() or ".." in path.parts:
        where = f"{folder / 'sample_data.json'}: sample {sample}: filename"
        raise InputError(f"{where}: expected a file below the dataroot, got {name!r}")
    return dataroot / path
