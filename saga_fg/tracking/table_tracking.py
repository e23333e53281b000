"""Tracking of a whole table of detections in one call."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping

from saga_fg.model.sensor import Sensor
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.table_doubts import table_doubts
from saga_fg.tracking.tracker import Tracker
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.pandas_tables import Table, moments_of_table, new_table
from saga_fg.types.track import Tracks


def track(
    detections: Table, settings: TrackerSettings | None = None, sensors: Mapping[str, Sensor] | None = None
) -> Table:
    """Track a `pandas.DataFrame` of detections, and return one of tracks: a row for each track and moment.

    detections  a row for each: timestamp (s, or times of pandas), x, y (m, in a frame that does not move), and where
                known z, label, score, sensor, length, width, height, yaw (rad), vx, vy, range_rate,
                cov_xx, cov_xy, cov_yy (m^2); a row without x and y is a moment at which nothing was detected
    settings    of the tracker; by default tracks are reported from their second detection on
    sensors     models by name of the sensor

    Frames are taken in order of time, each by what came before it. Warns (`UserWarning`) of scores in percent, headings
    in degrees, and classes on which no edge rule acts; `saga-fg track file` checks more.
    Raises `InputError` for a table that can't be used, `MissingExtraError` without pandas.
    """
    settings = TrackerSettings(min_hits=2) if settings is None else settings
    tracker = Tracker(settings, sensors)
    for doubt in table_doubts(detections, settings, sensors or {}):
        warnings.warn(doubt, stacklevel=2)
    found = [tracker.step(frame).table_columns() for frame in _frames(detections)]
    return new_table(found or [Tracks.empty(0.0).table_columns()])


def _frames(table: Table) -> Iterator[Frame]:
    for time, sensor, rows in moments_of_table(table):
        yield Frame(time, sensor, Detections.from_pandas(rows))
