"""One table of tracks: all columns, those of sub-tables too, are selected, appended and copied together."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from saga_fg import Tracker
from saga_fg.numerics.arrays import Columns
from saga_fg.tracking.track_table import TrackTable
from tests.saga_fg.traffic_frames import frame


def table(*x: float) -> TrackTable:
    """The tracks of a tracker after a frame of cars at these places."""
    tracker = Tracker()
    tracker.step(frame(0.0, [(each, 0.0) for each in x]))
    return tracker.snapshot().table


def arrays(columns: Columns, path: str = "") -> dict[str, np.ndarray]:
    """All columns by their names, those of sub-tables as table.column."""
    found = {}
    for one in fields(columns):  # type: ignore[arg-type]
        value = getattr(columns, one.name)
        if isinstance(value, Columns):
            found |= arrays(value, f"{path}{one.name}.")
        elif isinstance(value, np.ndarray):
            found[path + one.name] = value
    return found


def test_all_columns_are_appended_and_selected_together():
    a, b = table(0.0, 10.0), table(20.0)
    both = a.append(b)
    assert len(both) == 3
    assert {len(column) for column in arrays(both).values()} == {3}
    assert both.sensors.sensors == a.sensors.sensors
    for name, column in arrays(both.select(np.array([False, False, True]))).items():
        np.testing.assert_array_equal(column, arrays(b)[name])


def test_a_snapshot_shares_no_array_that_can_be_written():
    tracks = table(0.0, 10.0)
    kept = tracks.copied()
    for name, column in arrays(kept).items():
        np.testing.assert_array_equal(column, arrays(tracks)[name])
        assert not (np.shares_memory(column, arrays(tracks)[name]) and column.flags.writeable)


def test_an_empty_table_takes_tracks():
    tracks = table(0.0, 10.0)
    sensors = tracks.sensors.empty(0, tracks.sensors.sensors)
    empty = TrackTable.empty()
    empty.sensors = sensors
    for name, column in arrays(empty.append(tracks)).items():
        np.testing.assert_array_equal(column, arrays(tracks)[name])
