"""The tracks of a tracker without edges along a recording, frame by frame, and the labelled objects that they hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import assign
from saga_fg.numerics.columns import Columns
from saga_fg.tracking import Tracker, TrackerSettings
from saga_fg.tracking.sensor_evidence import SensorEvidence
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.dataset import Scene
from saga_fg.types.labelled_objects import LabelledObjects

GATE = 2.0  # m, from a track to its object


@dataclass(eq=False)
class RecordedTracks(Columns):
    """n tracks at some moments of a recording, as the tracker had them.

    table         their rows; without the evidence of sensors, with times counted from the moment
    mean, P       (n, D), (n, D, D) of their states, padded to the largest
    """

    table: TrackTable
    mean: FloatArray
    P: FloatArray


def recorded_tracks(
    scene: Scene, settings: TrackerSettings, sensors: Mapping[str, Sensor], labels: LabelledObjects
) -> tuple[list[RecordedTracks], FloatArray, list[IntArray]]:
    """The tracks after each frame, in world coordinates; the times of the frames; the object of each track, -1: none.

    Only tracks that were just detected hold an object.
    """
    settings = replace(settings, edges=(), providers=(), estimator="kalman")
    tracker = Tracker(settings, sensors)
    state = TrackerState(settings, ())
    parts, times, held = [], [], []
    for frame in scene.frames:
        tracker.step(frame)
        if tracker.time_verdict == "late":
            continue
        state.restore(tracker.snapshot())
        table, time = state.table, state.start + state.time
        if len(table) == 0:
            continue
        kinds = state.joint.rows_by_type(table.label)
        D = max(kind.dim for kind, _ in kinds)
        mean, P = np.zeros((len(table), max(D, 6))), np.zeros((len(table), max(D, 6), max(D, 6)))
        for kind, rows in kinds:
            mean[rows, : kind.dim] = state.joint.estimator.mean(table.id[rows])
            P[rows, : kind.dim, : kind.dim] = state.joint.estimator.covariance(table.id[rows])
        position = mean[:, :2] + state.origin
        truth = labels.at(time)
        apart = np.hypot(*np.moveaxis(position[:, None] - truth[None], -1, 0))
        fresh = table.last_detected >= state.time - 1e-6
        possible = fresh[:, None] & (table.label[:, None] == labels.label) & (np.nan_to_num(apart, nan=np.inf) < GATE)
        row, column = assign(np.nan_to_num(apart, nan=1e9), possible, unmatched=GATE)
        owner = np.full(len(table), -1)
        owner[row] = column
        mean[:, :2] = position
        table.stationarity.position = table.stationarity.position + state.origin
        for name in ("initiated", "last_detected", "last_in_view"):
            setattr(table, name, getattr(table, name) - state.time)
        table.sensors = SensorEvidence.empty(len(table))
        parts.append(RecordedTracks(table, mean, P))
        times.append(time)
        held.append(owner)
    return parts, np.array(times), held
