"""Tracking of a whole table of detections in one call, with warnings of what is probably wrong in it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence

from saga_fg.model.edge_rules import acting_classes
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.tracker import Tracker
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.pandas_tables import UNNAMED, Table, moments_of_table, new_table, numbers, texts
from saga_fg.types.plausibility import Sample, findings_of, headings_in_degrees, headings_of_frames, idle_rules
from saga_fg.types.track import Tracks


def table_findings(
    table: Table, frames: Sequence[Frame], settings: TrackerSettings, sensors: Mapping[str, Sensor]
) -> Iterator[str]:
    """Yield a line for each finding of `saga_fg.types.plausibility`; `saga_fg.track` has the columns and arguments."""
    found = (
        headings_in_degrees(numbers(table, "yaw")),
        headings_of_frames(frames),
        idle_rules(acting_classes(settings.edges), set(texts(table, "label", UNNAMED).tolist()) - {UNNAMED}),
        *findings_of(Sample.from_frames(frames), lambda name: sensor_model(sensors, name).score == "logit"),
    )
    return (finding.text() for finding in found if finding is not None)


def track(
    detections: Table, settings: TrackerSettings | None = None, sensors: Mapping[str, Sensor] | None = None
) -> Table:
    """Track a `pandas.DataFrame` of detections, and return one of tracks: a row for each track and moment.

    detections  a row for each: timestamp (s, or times of pandas), x, y (m, in a frame that does not move), and where
                known z, label, score, sensor, length, width, height, yaw (rad), vx, vy, range_rate,
                cov_xx, cov_xy, cov_yy (m^2); a row without x and y is a moment at which nothing was detected
    settings    of the tracker; by default tracks are reported from their second detection on
    sensors     models by name of the sensor

    Frames are taken in order of time, each by what came before it. Warns (`UserWarning`) of what is probably wrong, by
    the checks of `saga-fg inspect`: units, scores, headings, sizes, times, classes on which no edge rule acts.
    Raises `InputError` for a table that can't be used, `MissingExtraError` without pandas.
    """
    settings = TrackerSettings(min_hits=2) if settings is None else settings
    tracker = Tracker(settings, sensors)
    frames = list(_frames(detections))
    if frames:
        for finding in table_findings(detections, frames, settings, sensors or {}):
            warnings.warn(finding, stacklevel=2)
    found = [tracker.step(frame).table_columns() for frame in frames]
    return new_table(found or [Tracks.empty(0.0).table_columns()])


def _frames(table: Table) -> Iterator[Frame]:
    for time, sensor, rows in moments_of_table(table):
        yield Frame(time, sensor, Detections.from_pandas(rows))
