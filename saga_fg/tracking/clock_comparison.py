"""Comparison of the sensors' clocks by the objects in their frames, while a tracker runs.

A frame that was left out for its time is compared like one that was used, without any influence on the tracks. A sensor
whose offset is steady, well known and worth it is corrected from then on: so one whose frames were left out comes back.
"""

from __future__ import annotations

import logging

import numpy as np

from saga_fg.model.sensor import Sensor
from saga_fg.tracking.clock_offsets import MOST_OBJECTS, SeenObjects
from saga_fg.tracking.measurements import FrameMeasurements, frame_measurements
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.frame import Frame

log = logging.getLogger(__name__)


def compare_clocks(state: TrackerState, stamp: float, measurements: FrameMeasurements) -> None:
    """Compare a frame with this timestamp, s, with those of the other sensors, and correct the clocks that are known.

    Nothing happens with a single sensor, and where positions depend on an estimated pose of the vehicle.
    """
    if len(state.clock.sensors) < 2 or measurements.relative is not None:
        return
    d = np.argsort(-measurements.probability, kind="stable")[:MOST_OBJECTS]
    R, boxes = measurements.R[d], measurements.boxes
    variance = (R[:, 0, 0] + R[:, 1, 1]) / 2
    objects = SeenObjects.of(measurements.name, stamp, boxes.label[d], boxes.position[d, :2], variance)
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


def compare_left_out(state: TrackerState, stamp: float, frame: Frame, sensor: Sensor) -> None:
    """Compare the clocks by a frame with this timestamp, s, that was left out."""
    if len(state.clock.sensors) > 1 and len(frame) and (frame.coordinates == "world" or frame.world_T_ego is not None):
        compare_clocks(state, stamp, frame_measurements(frame, sensor, state.settings.classes))
