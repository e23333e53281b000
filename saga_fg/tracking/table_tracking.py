"""Tracking of a whole table of detections in one call, with warnings of what is probably wrong in it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping

import numpy as np

from saga_fg.model.edge_rules import acting_classes
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.tracker import Tracker
from saga_fg.types.frame import Detections, Frame
from saga_fg.types.pandas_tables import UNNAMED, Table, checked_table, moments_of_table, new_table, numbers, texts
from saga_fg.types.track import Tracks

MANY = 0.01
"""Share of the values from which they are doubted."""


def table_findings(table: Table, settings: TrackerSettings, sensors: Mapping[str, Sensor]) -> Iterator[str]:
    """Yield a line for each finding, with what mends it; `saga_fg.track` has the columns and the arguments."""
    sensor = texts(checked_table(table), "sensor", "sensor")
    shares = [name for name in np.unique(sensor).tolist() if sensor_model(sensors, name).score != "logit"]
    score = numbers(table, "score")
    score = score[np.isin(sensor, shares) & np.isfinite(score)]
    if len(score) and np.mean((score < -1e-6) | (score > 1 + 1e-6)) > MANY:
        mend = 'divide percent by 100; logits need sensors={"default": Sensor(score="logit")}'
        yield f"score: expected 0 to 1, got {score.min():.3g} to {score.max():.3g}; {mend}"
    yaw = numbers(table, "yaw")
    yaw = np.abs(yaw[np.isfinite(yaw)])
    if len(yaw) and np.mean(yaw > 2 * np.pi + 0.1) > MANY:
        yield f"yaw: expected rad, got up to {yaw.max():.4g}, which looks like degrees; numpy.deg2rad converts them"
    acting = acting_classes(settings.edges)
    classes = set(texts(table, "label", UNNAMED).tolist()) - {UNNAMED}
    if acting and classes and not acting & classes:
        yield (
            f"label: no edges: the rules act on {', '.join(sorted(acting))}, the detections are of "
            f"{', '.join(sorted(classes))}; rename the classes, or give settings with edges=() to track one by one"
        )


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
    for finding in table_findings(detections, settings, sensors or {}):
        warnings.warn(finding, stacklevel=2)
    found = [tracker.step(frame).table_columns() for frame in _frames(detections)]
    return new_table(found or [Tracks.empty(0.0).table_columns()])


def _frames(table: Table) -> Iterator[Frame]:
    for time, sensor, rows in moments_of_table(table):
        yield Frame(time, sensor, Detections.from_pandas(rows))
