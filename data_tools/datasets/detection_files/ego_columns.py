"""The columns of a table of detections in which the vehicle says how it has moved and where it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_tools.datasets.detection_files.columns import GPS, ODOMETRY, RawTable
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.ego_measurements import EgoMeasurements, GpsFix, OdometryIncrement


@dataclass(frozen=True, eq=False)
class EgoColumns:
    """Odometry (N, 4), x, y, yaw and the time they took, and gps (N, 3) of N rows; NaN where nothing was measured."""

    odometry: FloatArray
    gps: FloatArray

    @classmethod
    def of(cls, raw: RawTable) -> EgoColumns | None:
        """Read those of a table, None where it has none. Raises `InputError` for a row with a part of them."""
        columns = []
        for names, least in ((ODOMETRY, 4), (GPS, 2)):
            values = np.stack([raw.numbers(name) for name in names], axis=-1)
            given = np.isfinite(values)
            part = given.any(axis=1) & ~given[:, :least].all(axis=1)
            if part.any():
                row = int(np.argmax(part))
                missing = names[int(np.argmin(given[row]))]
                raise raw.fault(
                    row, f"{missing}: expected a number, since {names[int(np.argmax(given[row]))]} is given"
                )
            columns.append(values)
        short = columns[0][:, 3] <= 0
        if short.any():
            row = int(np.argmax(short))
            raise raw.fault(row, f"odometry_dt: expected seconds > 0, got {columns[0][row, 3]:g}")
        return cls(*columns) if any(np.isfinite(values).any() for values in columns) else None

    def measured(self, rows: IntArray) -> EgoMeasurements:
        """Return what the rows of a frame measured, by the first of them that did."""
        odometry, gps = (_first(column[rows]) for column in (self.odometry, self.gps))
        fix = None if gps is None else GpsFix(gps[np.isfinite(gps)])
        return EgoMeasurements(None if odometry is None else _increment(*odometry.tolist()), fix)


def _increment(x: float, y: float, yaw: float, dt: float) -> OdometryIncrement:
    c, s = np.cos(yaw), np.sin(yaw)
    return OdometryIncrement(np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]]), dt)


def _first(values: FloatArray) -> FloatArray | None:
    given = np.isfinite(values[:, 0])
    return values[int(np.argmax(given))] if given.any() else None
