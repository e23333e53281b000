"""Comparison of the sensors' clocks by the objects in their frames, while a tracker runs.

A frame that was used is compared by its detections that were matched to tracks, with the velocities of these; a frame
that was left out for its time by all of its detections, without any influence on the tracks. A sensor whose offset is
steady, well known and worth it is corrected from then on: so one whose frames were left out comes back.
"""

from __future__ import annotations

import logging

import numpy as np

from saga_fg.model.sensor import Sensor
from saga_fg.numerics.assignment import Matching
from saga_fg.tracking.clock_offsets import MOST_OBJECTS, SeenObjects
from saga_fg.tracking.measurements import FrameMeasurements, frame_measurements
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.frame import Frame

log = logging.getLogger(__name__)


def compare_used_frame(state: TrackerState, stamp: float, measurements: FrameMeasurements, matching: Matching) -> None:
    """Compare a frame with this timestamp, s, that has updated the tracks."""
    if len(state.clock.sensors) < 2 or measurements.relative is not None:
        return
    t, d = matching.track[:MOST_OBJECTS], matching.detection[:MOST_OBJECTS]
    now = state.kinematics()
    _compare(state, stamp, measurements, d, now.velocity[t], now.speed_deviation[t] ** 2)


def compare_left_out_frame(state: TrackerState, stamp: float, frame: Frame, sensor: Sensor) -> None:
    """Compare a frame with this timestamp, s, whose time is out of consensus."""
    placed = frame.coordinates == "world" or frame.world_T_ego is not None
    if len(state.clock.sensors) < 2 or not placed or not len(frame) or len(state) == 0:
        return
    measurements = frame_measurements(frame, sensor, state.settings.classes)
    d = np.argsort(-measurements.probability, kind="stable")[:MOST_OBJECTS]
    unknown = np.full((len(d), 2), np.nan)
    _compare(state, stamp, measurements, d, unknown, unknown[:, 0])


def _compare(
    state: TrackerState,
    stamp: float,
    measurements: FrameMeasurements,
    d: np.ndarray[tuple[int], np.dtype[np.int64]],
    velocity: np.ndarray[tuple[int, int], np.dtype[np.float64]],
    velocity_variance: np.ndarray[tuple[int], np.dtype[np.float64]],
) -> None:
    """Take in the objects `d` (k,) of a frame, and correct the clocks of which enough is known now."""
    boxes, R = measurements.boxes, measurements.R[d]
    variance = (R[:, 0, 0] + R[:, 1, 1]) / 2
    label, position = boxes.label[d], boxes.position[d, :2]
    objects = SeenObjects(measurements.name, stamp, label, position, variance, velocity, velocity_variance)
    before = state.shared
    state.shared = before.with_frame(objects, state.clock.elapsed)
    if all(a.estimate is b.estimate for a, b in zip(before.pairs, state.shared.pairs, strict=False)):
        return
    for name, found in state.shared.estimates(state.clock.records()).items():
        own = state.clock.sensor(name)
        assert own is not None
        if found.significant or (found.steady and own.offset != 0):
            offset = round(found.offset, 6)
            if own.offset == 0:
                text = "the clock of %s is %+.3f s off (+- %.3f s), by %d objects in common: corrected from now on"
                log.warning(text, name, offset, found.deviation, found.observations)
            state.clock = state.clock.corrected(name, offset)
