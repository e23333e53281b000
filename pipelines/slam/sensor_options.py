"""The options of a command that say which sensors of the vehicle take part, and where their measurements are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast, get_args

import numpy as np

from data_tools.datasets.kitti.dataset import FRAME_PERIOD
from data_tools.datasets.kitti.oxts import read_origin, world_position
from data_tools.sensor_logs import SensorLog, kitti_sensor_log, read_sensor_log
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.sensors import SensorName

GPS_NOISE, WHEELS_NOISE = 1.0, 0.05  # m and m/s, of the fixes and speeds made from GPS/IMU records


def sensor_log(
    records: Path,
    sensors: str,
    files: Sequence[str],
    seed: int,
    timestamps: FloatArray,
    origin: Callable[[], tuple[float, float, float]] | None = None,
) -> SensorLog | None:
    """Measurements of the sensors named, like "gps,imu", from KITTI's GPS/IMU records, and of files like "imu=FILE".

    timestamps: (K,) s, of the drive; origin: gives latitude, longitude (deg) and altitude (m) of the world's origin,
    asked for where fixes are so; by default where the records begin. Raises `InputError` for an unknown sensor, for one
    that is named twice, and for a file without a row within the drive.
    """
    named = [one.strip() for one in sensors.split(",") if one.strip()]
    given = [one.partition("=") for one in files]
    if unfinished := [name for name, _, path in given if not path]:
        raise InputError(f"--sensor-log: expected SENSOR=FILE, such as imu=imu.csv, got {unfinished[0][:40]!r}")
    known = get_args(SensorName)
    for option, names in (("--sensors", named), ("--sensor-log", [name for name, _, _ in given])):
        for name in names:
            if name not in known:
                raise InputError(f"{option}: expected some of {', '.join(known)}, got {name[:40]!r}")
    twice = [name for name in known if (*named, *(name for name, _, _ in given)).count(name) > 1]
    if twice:
        raise InputError(f"{twice[0]}: expected either --sensors or --sensor-log, once")
    if not named and not given:
        return None
    tables: dict[SensorName, FloatArray] = {}
    if named:
        chosen = tuple(cast(SensorName, name) for name in named)
        tables |= kitti_sensor_log(records, chosen, FRAME_PERIOD, GPS_NOISE, WHEELS_NOISE, seed).tables
        if origin is not None and "gps" in tables:
            latitude, longitude, altitude = (np.array([value]) for value in read_origin(records))
            off = world_position(latitude, longitude, altitude, np.array(origin()))[0]
            tables["gps"] = tables["gps"] + np.concatenate([[0.0], off])
    for name, _, path in given:
        table = read_sensor_log(path, cast(SensorName, name), origin or (lambda: read_origin(records)))
        _check_times(path, table[:, 0], timestamps)
        tables[cast(SensorName, name)] = table
    return SensorLog({name: np.asarray(table) for name, table in tables.items()})


def _check_times(path: str, times: FloatArray, timestamps: FloatArray) -> None:
    first, last = float(timestamps[0]), float(timestamps[-1])
    if not ((times >= first) & (times <= last)).any():
        got = f"rows from {times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "no rows"
        raise InputError(f"{path}: time: expected rows within the drive, from {first:.3f} to {last:.3f} s, got {got}")
