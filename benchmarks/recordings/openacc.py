"""OpenACC platoons: `platoons.parquet`, in; recorded traffic without a road map, out.

    setting, run     text; a recording is one run of one setting, SETTING-RUN
    t                s, every 0.1
    veh              number in the platoon, 1 leads
    speed            m/s
    east, north      m, local
    gap_to_next      m, bumper to bumper to the next number

Headings are those of the direction travelled, velocities the recorded speed along them. Lengths follow from the gaps:
the distance of two centres less the gap is the mean of both lengths. A moment without position or speed, and both ends
of a step that differs from the speed by more than 5 m/s (a jump of the receiver), are left out.

Source: Makridis et al., OpenACC, Transport Research Part C 2021; JRC of the European Commission. Parquet needs pyarrow
(extra [parquet]).
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings, on_grid
from data_tools.files import NUMBERS, WHOLE, arrow_arrays
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.types import MAX_POSITION, MAX_SPEED

FILE = "platoons.parquet"
JUMP = 5.0  # m/s, between a step and the speed
SIZE = (4.6, 1.85)  # m, of a car of which nothing is known
LENGTHS = (2.5, 7.0)  # m, within which a car is
_WEAK = 0.5  # weight of the usual length
_TEXT = "OUT"  # kinds of NumPy's types
_KINDS = {"setting": _TEXT, "run": _TEXT, "veh": WHOLE}
_COLUMNS = ("setting", "run", "t", "veh", "speed", "east", "north", "gap_to_next")
_TYPES = {_TEXT: np.str_, WHOLE: np.int64, NUMBERS: np.float64}
_TRAVELLED = 0.5  # m, from which a distance has a direction
_LATEST = 1e6  # s


def openacc_platoons(root: Path) -> Recordings:
    """The platoons of a folder with platoons.parquet.

    Raises `InputError` for a folder or a file that is not as above, `MissingExtraError` without pyarrow.
    """
    path = root / FILE
    found = arrow_arrays(path, _COLUMNS, _KINDS, gaps=_COLUMNS[4:])
    columns = {name: column.astype(_TYPES[_KINDS.get(name, NUMBERS)]) for name, column in found.items()}
    if not len(columns["t"]):
        raise InputError(f"{path}: expected rows, there are none")
    run = np.char.replace(np.char.add(np.char.add(columns["setting"], "-"), columns["run"]), " ", "_")

    def read(name: str) -> RecordedTraffic:
        row = np.flatnonzero(run == name)
        if not len(row):
            raise InputError(f"{path}: {unknown_name('platoon', name, np.unique(run).tolist())}")
        row = row[np.lexsort((columns["t"][row], columns["veh"][row]))]
        time, vehicle, speed, east, north, gap = (columns[key][row] for key in _COLUMNS[2:])
        position = np.column_stack([east, north])
        with error_context(f"{path}: {name}"):
            moment = _moments(time)
            for column, values, largest in (("east, north", position, MAX_POSITION), ("speed", speed, MAX_SPEED)):
                if (np.abs(values) > largest).any():  # not of NaN
                    raise InputError(f"{column}: expected numbers within {largest:g}")
            kept = np.isfinite(position).all(axis=1) & np.isfinite(speed)
            kept &= ~_jumps(moment, vehicle, position, speed)
            if not kept.any():
                raise InputError("expected positions and speeds, there are none")
        moment, vehicle, position, speed = moment[kept], vehicle[kept], position[kept], speed[kept]
        lengths, yaw = _lengths(moment, vehicle, position, gap[kept]), _courses(vehicle, position)
        velocity = np.maximum(speed, 0.0)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        sizes = {str(number): ("car", length, SIZE[1]) for number, length in lengths.items()}
        with error_context(str(path)):
            return on_grid(name, moment - moment.min(), vehicle.astype(np.str_), (position, velocity, yaw), sizes)

    return Recordings(tuple(np.unique(run).tolist()), read)


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
    unit = np.eye(len(numbers))
    rows, sums = [], []
    for k, (one, other) in enumerate(pairwise(numbers)):
        a, b = np.flatnonzero(vehicle == one), np.flatnonzero(vehicle == other)
        _, ia, ib = np.intersect1d(moment[a], moment[b], return_indices=True)
        between = np.hypot(*(position[a[ia]] - position[b[ib]]).T) - gap[a[ia]]
        if other == one + 1 and np.isfinite(between).any():
            rows.append(unit[[k, k + 1]].mean(axis=0))
            sums.append(float(np.nanmedian(between)))
    A = np.concatenate([np.array(rows).reshape(-1, len(numbers)), _WEAK * unit])
    b = np.append(np.array(sums), np.full(len(numbers), _WEAK * SIZE[0]))
    length = np.clip(np.linalg.lstsq(A, b, rcond=None)[0], *LENGTHS)
    return dict(zip(numbers, length.tolist(), strict=True))


def _courses(vehicle: IntArray, position: FloatArray) -> FloatArray:
    """Yaw (n,), rad: the direction of at least half a metre travelled about each row; rows by vehicle and time."""
    yaw = np.zeros(len(vehicle))
    for number in np.unique(vehicle).tolist():
        row = np.flatnonzero(vehicle == number)
        p = position[row]
        distance = np.append(0.0, np.cumsum(np.hypot(*np.diff(p, axis=0).T)))
        before = np.maximum(np.searchsorted(distance, distance - _TRAVELLED, side="right") - 1, 0)
        after = np.minimum(np.searchsorted(distance, distance + _TRAVELLED), len(distance) - 1)
        across = p[after] - p[before]
        at = np.flatnonzero(np.hypot(*across.T) >= _TRAVELLED)
        if len(at):
            course = np.unwrap(np.arctan2(across[at, 1], across[at, 0]))
            yaw[row] = course[np.clip(np.searchsorted(at, np.arange(len(row)), side="right") - 1, 0, None)]
    return yaw
