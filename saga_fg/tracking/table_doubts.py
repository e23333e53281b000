"""Warnings about tables of detections that can be read but are probably wrong: units, and names of classes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from saga_fg.model.edge_rules import acting_classes
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.types.pandas_tables import UNNAMED, Table, checked_table, numbers, texts

MANY = 0.01
"""Share of the values from which they are doubted."""


def table_doubts(table: Table, settings: TrackerSettings, sensors: Mapping[str, Sensor]) -> Iterator[str]:
    """Yield a line for each doubt, with what mends it; `saga_fg.track` has the columns and the arguments."""
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
