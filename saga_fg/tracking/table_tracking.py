"""Tracking of a whole table of detections in one call, which refuses one whose contents contradict how it is read."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from saga_fg.model import Sensor, acting_classes, sensor_model
from saga_fg.tables import (
    RawTable,
    Table,
    TableImport,
    idle_rules,
    raw_table,
    scenes_of,
    seems_dense_traffic,
    table_like,
    tell,
)
from saga_fg.tracking.dense_traffic import dense_traffic_settings
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.tracker import Tracker
from saga_fg.types import DEFAULT, Scene, Tracks

UNKNOWN_SENSORS: Mapping[str, Sensor] = {DEFAULT: Sensor(calibrate_noise=True)}
"""Models of sensors of which nothing is known: their detections tell how noisy they are."""

UNNAMED = "object"
"""Class of detections without a column of classes; any name will do."""


def track(
    detections: Table,
    settings: TrackerSettings | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    columns: Mapping[str, str] | None = None,
    classes: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    coordinates: Literal["", "world", "ego", "sensor", "camera"] = "",
    as_given: bool = False,
) -> Table:
    """Track a table of detections, of pandas, Polars or Arrow, and return one of tracks, a row for each and moment.

    detections   a row for each: timestamp (s, or dates), x, y (m), and where known z, label, score, sensor, length,
                 width, height, yaw (rad), vx, vy, range_rate, cov_xx, cov_xy, cov_yy (m^2), scene, and ego_x,
                 ego_y, ego_yaw, the vehicle's pose; a row without x and y is a moment at which nothing was detected
    settings     of the tracker; by default tracks are reported from their second detection on, and dense road traffic
                 seen by a sensor that stands or hovers has settings of its own (`saga_fg.tracking.dense_traffic`)
    sensors      models by name of the sensor; by default the noise of each is told by its detections
    columns      names of columns in the table, by ours, where they are not found: {"x": "pos_e"}
    classes      our name of a class by that in the table, an empty one to leave its objects out
    units        {"angle": "deg", "time": "ns", "speed": "km/h", ...}, as of `saga-fg track file --units`
    coordinates  of positions, headings and velocities: world, ego, sensor or camera
    as_given     read the table as these arguments say even where its contents contradict them

    Frames are taken in order of time, each by what came before it. The table of tracks is of the same kind; it has a
    column `scene` if the detections have one, and each scene has a tracker of its own. Warns (`UserWarning`) of what is
    probably wrong, by the checks of `saga-fg inspect`. Raises `InputError` for a table that can't be used, and for one
    whose contents contradict how it is read: units of angles, times, lengths or speeds, coordinates, exchanged columns.
    """
    how = TableImport(columns or {}, classes or {}, units or {}, coordinates, as_given=as_given)
    sensors = UNKNOWN_SENSORS if sensors is None else sensors
    raw = raw_table(detections, how)
    scenes = scenes_of(raw)
    if settings is None:
        settings = fitting_settings(scenes)
    check_scenes(raw, scenes, settings, sensors)
    found = []
    for scene in scenes:
        tracker = Tracker(settings, sensors)
        for frame in scene.frames:
            tracks = tracker.step(frame).table_columns()
            name = {"scene": np.full(len(tracks["id"]), scene.name)} if "scene" in raw.columns else {}
            found.append({**name, **tracks})
    return table_like(detections, found or [Tracks.empty(0.0).table_columns()])


def fitting_settings(scenes: Sequence[Scene]) -> TrackerSettings:
    """Settings for scenes of which nothing is known, by what the first looks like; warns of those for dense traffic."""
    why = seems_dense_traffic(scenes[0].frames) if scenes else ""
    if not why:
        return TrackerSettings(min_hits=2)
    warnings.warn(
        f"settings for dense traffic: {why}; settings=TrackerSettings(min_hits=2) takes the plain ones", stacklevel=3
    )
    return dense_traffic_settings()


def check_scenes(raw: RawTable, scenes: list[Scene], settings: TrackerSettings, sensors: Mapping[str, Sensor]) -> None:
    """Warn of what is doubtful in the scenes of a table, at the caller's caller; raise as `tell`."""
    frames = [frame for scene in scenes for frame in scene.frames]
    labels = {name for frame in frames for name in frame.detections.boxes.label.tolist()}
    logits = any(sensor_model(sensors, name).score == "logit" for name in {frame.sensor for frame in frames})
    found = [one for scene in scenes for one in scene.findings or () if one.kind != "scores" or not logits]
    rules = idle_rules(acting_classes(settings.edges), labels - {UNNAMED})
    tell([*found, *([] if rules is None else [rules])], raw, depth=4)
