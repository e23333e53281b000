"""The calibration of a KITTI sequence: what leads from the vehicle to the camera and on to the image.

    x_camera = R_rect Tr_velo_cam Tr_imu_velo x_imu         rectified camera 0: x right, y down, z ahead
    (u w, v w, w) = P2 (x_camera, 1)                        pixel (u, v) of the left colour image

A calibration file holds one `key: numbers` a line, row-major. The tracking benchmark's own files leave out some colons
and shorten some keys; both spellings are read. Source: development kit of https://www.cvlibs.net/datasets/kitti
(tracking) and Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.text_tables import read_lines
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import is_rotation

_KEYS: dict[str, tuple[tuple[int, int], tuple[str, ...]]] = {
    "P2": ((3, 4), ("P2",)),
    "R_rect": ((3, 3), ("R_rect", "R0_rect")),
    "Tr_velo_cam": ((3, 4), ("Tr_velo_cam", "Tr_velo_to_cam")),
    "Tr_imu_velo": ((3, 4), ("Tr_imu_velo", "Tr_imu_to_velo")),
}


@dataclass(frozen=True, eq=False)
class Calibration:
    """camera_T_velodyne (4, 4) and camera_T_imu (4, 4), rigid, to the rectified camera; projection (3, 4) = P2."""

    camera_T_velodyne: FloatArray
    camera_T_imu: FloatArray
    projection: FloatArray


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file. Raises `InputError` for missing keys, missing numbers, rotations that are none."""
    path = Path(path)
    found: dict[str, tuple[int, list[str]]] = {}
    for number, line in enumerate(read_lines(path), start=1):
        key, *values = line.split() or [""]
        found[key.rstrip(":")] = (number, values)
    matrices = {name: _matrix(path, found, name) for name in _KEYS}
    camera_T_velodyne = _rigid(matrices["R_rect"]) @ _rigid(matrices["Tr_velo_cam"])
    return Calibration(
        camera_T_velodyne=camera_T_velodyne,
        camera_T_imu=camera_T_velodyne @ _rigid(matrices["Tr_imu_velo"]),
        projection=matrices["P2"],
    )


def _matrix(path: Path, found: dict[str, tuple[int, list[str]]], name: str) -> FloatArray:
    shape, spellings = _KEYS[name]
    key = next((spelling for spelling in spellings if spelling in found), None)
    if key is None:
        there = ", ".join(k for k in found if k) or "none"
        raise InputError(f"{path}: expected the key {' or '.join(spellings)}, the keys there are {there}")
    line, values = found[key]
    count = shape[0] * shape[1]
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError as error:
        raise InputError(f"{path}: line {line}: {key}: expected {count} numbers: {error}") from error
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"{path}: line {line}: {key}: expected {count} finite numbers, got {len(numbers)} values")
    matrix = numbers.reshape(shape)
    R = matrix[:, :3]
    if name != "P2" and not is_rotation(R, 1e-4):
        raise InputError(f"{path}: line {line}: {key}: expected a rotation in the first three columns")
    return matrix


def _rigid(matrix: FloatArray) -> FloatArray:
    """(4, 4) transform with the rotation nearest to that of the file, which is rounded to seven digits."""
    U, _, Vt = np.linalg.svd(matrix[:, :3])
    transform = np.eye(4)
    transform[:3, :3] = U @ Vt
    transform[:3, 3] = matrix[:, 3] if matrix.shape[1] == 4 else 0.0
    return transform
