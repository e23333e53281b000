"""Logs of the vehicle's own sensors as tables: inertial samples, speeds of the wheels, satellite fixes.

A file begins with a line of columns, each a name and its unit in brackets, in any order; others are left out:

    imu      time [s], acceleration_x [m/s^2], ..y, ..z, angular_rate_x [rad/s], ..y, ..z
    wheels   time [s], speed [m/s]
    gps      time [s], x [m], y [m], z [m];  or  latitude [deg], longitude [deg], altitude [m]

Commas or semicolons separate columns. Units: s, ms, us, ns; m/s^2, g; rad/s, deg/s; m/s, km/h, mph; m, km, ft; deg,
rad. Rows are in order of time. Latitude and longitude become metres east and north of an origin, by the Mercator
projection at its scale (as KITTI's development kit does). Accelerations are specific forces: (0, 0, 9.81) at rest.
"""

import logging
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_tools.datasets.kitti.dataset import FRAME_PERIOD, read_sensors, world_position
from data_tools.files import LARGEST, TextTable, read_lines
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, checked, refuse
from saga_fg.slam.sensors import SensorBuffer, SensorName, SensorSettings
from saga_fg.types import EgoMeasurements

_AXES = ("x", "y", "z")
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_LENGTH = {"m": 1.0, "km": 1000.0, "ft": 0.3048}
_ANGLE = {"deg": math.pi / 180, "rad": 1.0}
_UNITS: Mapping[str, Mapping[str, float]] = {
    "time": _TIME,
    **{f"acceleration_{axis}": {"m/s^2": 1.0, "g": 9.80665} for axis in _AXES},
    **{f"angular_rate_{axis}": {"rad/s": 1.0, "deg/s": math.pi / 180} for axis in _AXES},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704},
    **dict.fromkeys((*_AXES, "altitude"), _LENGTH),
    **dict.fromkeys(("latitude", "longitude"), _ANGLE),
}
_COLUMNS: Mapping[SensorName, tuple[str, ...]] = {
    "imu": tuple(name for name in _UNITS if name.startswith(("acceleration", "angular_rate"))),
    "wheels": ("speed",),
    "gps": _AXES,
}
_GEODETIC = ("latitude", "longitude", "altitude")
_MAX = {"latitude": math.radians(85.0), "longitude": math.radians(180.0), "altitude": 1e5}  # rad and m; others: 1e15
_log = logging.getLogger(__name__)
_HEADER = re.compile(r"\s*([A-Za-z_]+)\s*\[\s*([^\]]*?)\s*\]\s*")


def read_sensor_log(
    path: str | Path, sensor: SensorName, origin: Callable[[], tuple[float, float, float]] | None = None
) -> FloatArray:
    """Read a log: times (n,), s, and what was measured then, (n, 1 + d), in SI units.

    origin: gives latitude, longitude (deg) and altitude (m) of the world's origin, asked for where fixes are so; None:
    the first fix. Raises `InputError` naming the file and the line for a column without unit, an unknown unit, a
    missing column, time that runs backwards, and a fix beyond 85 degrees north or south.
    """
    path = Path(path)
    lines = [(number, line) for number, line in enumerate(read_lines(path), start=1) if line.strip()]
    if not lines:
        raise InputError(f"{path}: expected a line of columns, the file is empty")
    header = lines[0][1].removeprefix("\ufeff")  # byte-order mark
    separator = ";" if ";" in header else ","
    titles = [_HEADER.fullmatch(title) for title in header.split(separator)]
    found = {title[1]: (column, title[2]) for column, title in enumerate(titles) if title is not None}
    names = _GEODETIC if sensor == "gps" and "latitude" in found else _COLUMNS[sensor]
    wanted = ("time", *names)
    for name in wanted:
        if name not in found:
            unit = next(iter(_UNITS[name]))
            raise InputError(
                f"{path}: line {lines[0][0]}: expected a column {name} with its unit, such as {name} [{unit}]"
            )
        if found[name][1] not in _UNITS[name]:
            known = ", ".join(_UNITS[name])
            raise InputError(
                f"{path}: line {lines[0][0]}: {name}: expected one of {known}, got {found[name][1][:20]!r}"
            )
    rows = [(number, line.split(separator)) for number, line in lines[1:]]
    for number, row in rows:
        if len(row) != len(titles):
            raise InputError(f"{path}: line {number}: expected {len(titles)} columns, got {len(row)}")
    table = TextTable.from_rows(path, [row for _, row in rows], [number for number, _ in rows], len(titles))
    units = [_UNITS[name][found[name][1]] for name in wanted]
    most = tuple(_MAX[name] / unit if name in _MAX else LARGEST for name, unit in zip(wanted, units, strict=True))
    numbers = table.numbers([found[name][0] for name in wanted], wanted, most) * units
    time = numbers[:, 0]
    refuse(
        np.diff(time, prepend=-np.inf) <= 0,
        lambda row: table.fault(row, f"time: expected one after {time[row - 1]:.6f} s, got {time[row]:.6f} s"),
    )
    if names == _GEODETIC and len(numbers):
        degrees = numbers[:, 1:] * [180 / math.pi, 180 / math.pi, 1.0]
        begin = degrees[0] if origin is None else np.array(origin())
        numbers[:, 1:] = world_position(degrees[:, 0], degrees[:, 1], degrees[:, 2], begin)
    return numbers


_GRAVITY, _IN_G, _FASTEST_TURN = 9.80665, (0.7, 1.4), 12.0  # m/s^2; medians of forces in g; rad/s, of any vehicle


def plausible_inertial(table: FloatArray) -> FloatArray:
    """Inertial samples (n, 7) in SI units, those that are clearly in g or in deg/s converted, with a warning.

    The median of specific forces is near 1 g on every vehicle, and none turns at 12 rad/s for a hundredth of its drive.
    """
    if not len(table):
        return table
    force, rate = np.linalg.norm(table[:, 1:4], axis=1), np.linalg.norm(table[:, 4:], axis=1)
    middle, fastest, factor = float(np.median(force)), float(np.quantile(rate, 0.99)), np.ones(7)
    if _IN_G[0] < middle < _IN_G[1]:
        _log.warning("imu: accelerations have a median of %.2f, taken for g: they are multiplied by 9.80665", middle)
        factor[1:4] = _GRAVITY
    elif abs(middle - _GRAVITY) > _GRAVITY / 3:
        _log.warning("imu: accelerations have a median of %.2f m/s^2, where gravity is 9.81: check their unit", middle)
    if fastest > _FASTEST_TURN:
        _log.warning("imu: turn rates reach %.0f, taken for deg/s: they are multiplied by pi / 180", fastest)
        factor[4:] = math.pi / 180
    return table * factor


@dataclass(eq=False)
class SensorLog:
    """Tables of a drive by sensor, (n, 1 + d) with the time first.

    settings: noise and places of the sensors
    """

    tables: Mapping[SensorName, FloatArray]
    settings: SensorSettings = field(default_factory=SensorSettings)

    def __post_init__(self) -> None:
        for name, table in self.tables.items():
            checked(name, table, (None, 1 + len(_COLUMNS[name])))

    def until(self, times: FloatArray) -> Iterator[tuple[float, EgoMeasurements]]:
        """Each of some times (K,), s, increasing, with what was measured since the one before."""
        buffer, first = SensorBuffer(), -math.inf
        for until in times.tolist():
            for name, table in self.tables.items():
                rows = slice(*np.searchsorted(table[:, 0], [first, until], side="right").tolist())
                for time, *values in table[rows].tolist():
                    if name == "imu":
                        buffer.add_imu(time, np.array(values[:3]), np.array(values[3:]))
                    elif name == "wheels":
                        buffer.add_wheels(time, values[0])
                    else:
                        buffer.add_gps(time, np.array(values))
            yield until, buffer.take(until)
            first = until


_GPS_NOISE, _WHEELS_NOISE = 1.0, 0.05  # m and m/s, of the fixes and speeds made from GPS/IMU records


def kitti_sensor_log(path: str | Path, sensors: tuple[SensorName, ...], seed: int) -> SensorLog:
    """Return the sensors of a KITTI sequence from its GPS/IMU records.

    Inertial samples are those recorded. Fixes and speeds are of the filtered solution that the estimate is compared
    with; so they get noise from `seed`: 1 m by axis, and 0.05 m/s with a scale that is wrong by 1 %.
    """
    measured, rng = read_sensors(path), np.random.default_rng(seed)
    time = FRAME_PERIOD * np.arange(len(measured["gps"]))
    measured["wheels"] = (1 + rng.choice([-0.01, 0.01])) * measured["wheels"]
    measured["wheels"] += rng.normal(0, _WHEELS_NOISE, (len(time), 1))
    measured["gps"] = measured["gps"] + rng.normal(0, _GPS_NOISE, (len(time), 3))
    return SensorLog({name: np.column_stack([time, measured[name]]) for name in sensors})
