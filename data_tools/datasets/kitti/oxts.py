"""Poses of the vehicle from KITTI's GPS/IMU records (oxts).

A record gives latitude, longitude (degrees), altitude (m) and roll, pitch, yaw (rad) first, then velocities and more.
As in the official development kit, positions come from the Mercator projection scaled at the first latitude, and
rotations are R = Rz(yaw) Ry(pitch) Rx(roll):

    s = cos(lat_0),  x = s r lon,  y = s r ln tan(pi/4 + lat/2),  z = alt,      r = 6378137 m

World coordinates have their axes east, north, up and their origin at the first record: unlike the kit's, which are
turned into the first vehicle frame, they are level, so that z is up. The ego frame is the IMU's: x ahead, y left, z up.
Source: Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.text_tables import TextTable, read_table
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray

EARTH_RADIUS = 6378137.0  # m
_COLUMNS = ("latitude", "longitude", "altitude", "roll", "pitch", "yaw")


def read_origin(path: str | Path) -> tuple[float, float, float]:
    """Latitude, longitude (deg) and altitude (m) of the first record. Raises `InputError` as `read_poses` does."""
    read_poses(path)
    latitude, longitude, altitude = _records(path).numbers(slice(0, 3), _COLUMNS[:3])[0].tolist()
    return latitude, longitude, altitude


def read_poses(path: str | Path) -> FloatArray:
    """world_T_imu (K, 4, 4) of the K records of a sequence. Raises `InputError` for records that are not as above."""
    table = _records(path)
    if not len(table):
        raise InputError(f"{path}: expected a record per frame, the file is empty")
    latitude, longitude, altitude, roll, pitch, yaw = table.numbers(slice(0, 6), _COLUMNS).T
    for name, angle, largest in (("latitude", latitude, 85.0), ("longitude", longitude, 180.0)):
        if (np.abs(angle) > largest).any():
            row = int(np.argmax(np.abs(angle) > largest))
            raise table.fault(row, f"{name}: expected degrees within {largest:g} of 0, got {angle[row]:g}")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = _turn(yaw, 0, 1) @ _turn(pitch, 2, 0) @ _turn(roll, 1, 2)
    poses[:, :3, 3] = world_position(latitude, longitude, altitude, np.array([latitude[0], longitude[0], altitude[0]]))
    return poses


def world_position(latitude: FloatArray, longitude: FloatArray, altitude: FloatArray, origin: FloatArray) -> FloatArray:
    """Positions (K, 3) east, north and up of an origin (3,), m; latitudes and longitudes in degrees, altitudes in m."""
    scale = EARTH_RADIUS * np.cos(np.radians(origin[0]))
    above = [np.log(np.tan(np.radians(90 + angle) / 2)) for angle in (latitude, origin[0])]
    return np.stack(
        [scale * np.radians(longitude - origin[1]), scale * (above[0] - above[1]), altitude - origin[2]], axis=1
    )


@dataclass(frozen=True, eq=False)
class SensorRecords:
    """K records in the vehicle's axes, without the poses.

    position (K, 3) as in `read_poses`, m; speed (K,) ahead, m/s; acceleration (K, 3) specific force, m/s^2;
    angular_rate (K, 3), rad/s
    """

    position: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    angular_rate: FloatArray


def read_sensors(path: str | Path) -> SensorRecords:
    """Read what the records say of velocity, acceleration and turn rate. Raises `InputError` as `read_poses` does."""
    position = read_poses(path)[:, :3, 3]
    table = _records(path)
    names = ("vf", "ax", "ay", "az", "wx", "wy", "wz")
    numbers = table.numbers([8, 11, 12, 13, 17, 18, 19], names)
    return SensorRecords(position, numbers[:, 0], numbers[:, 1:4], numbers[:, 4:])


def _records(path: str | Path) -> TextTable:
    return read_table(Path(path), (30,), "latitude, longitude, altitude, roll, pitch, yaw, ...")


def _turn(angle: FloatArray, from_axis: int, to_axis: int) -> FloatArray:
    """Rotations (K, 3, 3) that turn one axis towards another."""
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, from_axis, from_axis] = R[:, to_axis, to_axis] = np.cos(angle)
    R[:, to_axis, from_axis] = np.sin(angle)
    R[:, from_axis, to_axis] = -np.sin(angle)
    return R
