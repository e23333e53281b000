"""OpenACC platoons: `platoons.parquet`, in; recorded traffic without a road map, out.

    setting, run     text; a recording is one run of one setting, SETTING-RUN
    t                s, every 0.1
    veh              number in the platoon, 1 leads
    speed            m/s
    east, north      m, local
    gap_to_next      m, bumper to bumper to the next number

Headings are those of the way travelled, velocities the recorded speed along them. Lengths follow from the gaps: the
distance of two centres less the gap is the mean of both lengths. A moment without position or speed, and both ends of
a step that differs from the speed by more than 5 m/s (a jump of the receiver), are left out.

Source: Makridis et al., OpenACC, Transport Research Part C 2021; JRC of the European Commission. Parquet needs pyarrow
(extra [parquet]).
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.recorded_traffic import PERIOD, RecordedTraffic, StateRows
from data_tools.files.arrow_tables import NUMBERS, WHOLE, all_of, read_arrow_arrays
from data_tools.files.error_messages import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.types.boxes import MAX_POSITION, MAX_SPEED

FILE = "platoons.parquet"
JUMP = 5.0  # m/s, between a step and the speed
SIZE = (4.6, 1.85)  # m, of a car of which nothing is known
LENGTHS = (2.5, 7.0)  # m, within which a car is
_TEXT = "OUT"  # kinds of NumPy's types
_COLUMNS = {
    "setting": _TEXT,
    "run": _TEXT,
    "t": NUMBERS,
    "veh": WHOLE,
    **dict.fromkeys(("speed", "east", "north"), NUMBERS),
}
_GAP = "gap_to_next"
_TRAVELLED = 0.5  # m, from which a way has a direction
_LATEST = 1e6  # s


class OpenAccPlatoons:
    """The platoons of a folder with platoons.parquet.

    Raises `InputError` for a folder or a file that is not as above, `MissingExtraError` without pyarrow.
    """

    def __init__(self, root: str | Path) -> None:
        self._path = Path(root) / FILE
        self._columns = _columns(self._path)
        settings, runs = self._columns["setting"], self._columns["run"]
        if not len(settings):
            raise InputError(f"{self._path}: expected rows, there are none")
        names = np.char.replace(np.char.add(np.char.add(settings, "-"), runs), " ", "_")
        self._rows = {str(name): np.flatnonzero(names == name) for name in np.unique(names)}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the runs."""
        return tuple(self._rows)

    def recording(self, name: str) -> RecordedTraffic:
        """Read a run; raises `InputError` for an unknown name, and for numbers that cannot be."""
        if name not in self._rows:
            raise InputError(f"{self._path}: {unknown_name('run', name, self.names)}")
        row = self._rows[name]
        row = row[np.lexsort((self._columns["t"][row], self._columns["veh"][row]))]
        time, vehicle, speed, east, north, gap = (
            self._columns[key][row] for key in ("t", "veh", "speed", "east", "north", _GAP)
        )
        with error_context(f"{self._path}: {name}"):
            moment = _moments(time)
            position = np.column_stack([east, north])
            for column, values, largest in (("east, north", position, MAX_POSITION), ("speed", speed, MAX_SPEED)):
                if (np.abs(values) > largest).any():  # not of NaN
                    raise InputError(f"{column}: expected numbers within {largest:g}")
            kept = np.isfinite(position).all(axis=1) & np.isfinite(speed)
            kept &= ~_jumps(moment, vehicle, position, speed)
            if not kept.any():
                raise InputError("expected positions and speeds, there are none")
            length = _lengths(moment[kept], vehicle[kept], position[kept], gap[kept])
            moment, vehicle, position, speed = moment[kept], vehicle[kept], position[kept], speed[kept]
            yaw = _courses(vehicle, position)
        velocity = np.maximum(speed, 0.0)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        sizes = {str(number): ("car", each, SIZE[1]) for number, each in length.items()}
        states = StateRows(moment - moment.min(), vehicle.astype(np.str_), position, velocity, yaw)
        with error_context(str(self._path)):
            return states.traffic(name, sizes)


def _moments(time: FloatArray) -> IntArray:
    """Numbers (n,) of the moments, from 0."""
    if not (np.abs(time) <= _LATEST).all():
        raise InputError(f"t: expected seconds within {_LATEST:g}")
    step = (time - time.min()) / PERIOD
    odd = np.abs(step - np.round(step)) > 0.2
    if odd.any():
        raise InputError(f"t: expected times every {PERIOD} s, got {time[np.argmax(odd)]:g}")
    return np.asarray(np.round(step).astype(np.int64))


def _jumps(moment: IntArray, vehicle: IntArray, position: FloatArray, speed: FloatArray) -> BoolArray:
    """Mask (n,) of both ends of steps that do not fit the speed; rows by vehicle and time."""
    travelled = np.hypot(*np.diff(position, axis=0).T) / PERIOD
    excess = np.abs(travelled - (speed[1:] + speed[:-1]) / 2)
    step = (vehicle[1:] == vehicle[:-1]) & (np.diff(moment) == 1) & (excess > JUMP)  # NaN is no jump
    return np.asarray(np.append(step, False) | np.append(False, step))


def _lengths(moment: IntArray, vehicle: IntArray, position: FloatArray, gap: FloatArray) -> dict[int, float]:
    """Length of each vehicle, m: least squares of half the sums that the gaps give, drawn to a usual one."""
    numbers = np.unique(vehicle).tolist()
    rows, sums = [], []
    for k, (one, other) in enumerate(pairwise(numbers)):
        if other != one + 1:
            continue
        a, b = np.flatnonzero(vehicle == one), np.flatnonzero(vehicle == other)
        _, ia, ib = np.intersect1d(moment[a], moment[b], return_indices=True)
        between = np.hypot(*(position[a[ia]] - position[b[ib]]).T) - gap[a[ia]]
        if np.isfinite(between).any():
            rows.append(np.eye(len(numbers))[[k, k + 1]].mean(axis=0))
            sums.append(float(np.nanmedian(between)))
    weak = 0.5
    A = np.concatenate([np.array(rows).reshape(-1, len(numbers)), weak * np.eye(len(numbers))])
    b = np.append(np.array(sums), np.full(len(numbers), weak * SIZE[0]))
    length = np.clip(np.linalg.lstsq(A, b, rcond=None)[0], *LENGTHS)
    return dict(zip(numbers, length.tolist(), strict=True))


def _courses(vehicle: IntArray, position: FloatArray) -> FloatArray:
    """Yaw (n,), rad: the direction of at least half a metre travelled about each row; rows by vehicle and time."""
    yaw = np.zeros(len(vehicle))
    for number in np.unique(vehicle).tolist():
        row = np.flatnonzero(vehicle == number)
        p = position[row]
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(p, axis=0).T)))
        before = np.maximum(np.searchsorted(way, way - _TRAVELLED, side="right") - 1, 0)
        after = np.minimum(np.searchsorted(way, way + _TRAVELLED), len(way) - 1)
        across = p[after] - p[before]
        known = np.hypot(*across.T) >= _TRAVELLED
        if known.any():
            at = np.flatnonzero(known)
            course = np.unwrap(np.arctan2(across[at, 1], across[at, 0]))
            yaw[row] = course[np.clip(np.searchsorted(at, np.arange(len(row)), side="right") - 1, 0, None)]
    return yaw


def _columns(path: Path) -> dict[str, Any]:
    """The columns of the file as arrays; numbers may be NaN where the file has nothing."""
    filled = ("setting", "run", "t", "veh")
    columns = read_arrow_arrays(path, all_of(path, (*_COLUMNS, _GAP)), _COLUMNS, filled)
    types = {_TEXT: np.str_, WHOLE: np.int64, NUMBERS: np.float64}
    return {name: column.astype(types[_COLUMNS.get(name, NUMBERS)]) for name, column in columns.items()}
