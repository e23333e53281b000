r"""Update of the probability r that a track is a real object, by Bayes' rule, and of the score of its box.

    miss    r <- r (1 - p_D) / (1 - r p_D) exp(-dt / lifetime)
    match   r / (1 - r) <- r / (1 - r)  p / (1 - p)  (1 - c) / c

p_D is the chance of a detection at the track (0 outside the field of view), p the detection's probability, and c the
probability at which a detection is no evidence. Source: Musicki, Evans, Stankovic, Integrated Probabilistic Data
Association, IEEE Transactions on Automatic Control 39(6), 1994.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.covariances import existences
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.assignment import Matching
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.settings import ExistenceSettings
from saga_fg.tracking.tracker_state import TrackerState

SCORE_MEMORY = 0.15  # time for which the latest detection of each sensor counts in a track's score, s


def update_existence(state: TrackerState, measurements: FrameMeasurements, matching: Matching, elapsed: float) -> None:
    """Update existence, score and confirmation of all tracks; elapsed: time since the latest frame, s."""
    table, settings = state.table, state.settings.existence
    if len(table) == 0:
        return
    time, t, d = state.time - measurements.delay, matching.track, matching.detection
    missed = np.ones(len(table), dtype=bool)
    missed[t] = False
    now, sensor = state.kinematics(), measurements.sensor
    visible = sensor.sees(now.position + state.origin, measurements.world_T_ego)
    table.last_in_view[table.sensors.look(measurements.name, visible)] = state.time
    p_detect = np.where(visible, sensor.detection_chance(table.label), 0.0)
    # a track that another sensor has just detected exists, whether this one misses it or not
    excused = table.sensors.detected_by_others(measurements.name, time, SCORE_MEMORY)
    p, p_miss, resolved = measurements.probability[d], np.where(excused, 0.0, p_detect), table.unresolved[t] == 0
    # a detection of an unresolved track may be of the track that it overlaps
    table.existence = _existence(table.existence, missed, p_miss, t[resolved], p[resolved], elapsed, settings)
    table.last_existence[t] = table.existence[t]
    table.confirmed |= table.existence >= settings.confirm_above
    table.sensors.update(measurements.name, time, t, p, missed & visible, p_detect)
    fused = table.sensors.probability(state.time, max(SCORE_MEMORY, measurements.delay))
    table.score = np.where(np.isfinite(fused), fused, table.score)
    table.best_score = np.maximum(table.best_score, table.score)
    table.hits, table.opportunities = table.sensors.best_hits()
    table.covariance_scale[t], table.position_bias[t] = measurements.covariance_scale[d], measurements.position_bias[d]
    table.last_detected[t] = np.maximum(table.last_detected[t], time)
    table.last_in_view[t] = state.time


def _existence(
    before: FloatArray,
    missed: BoolArray,
    chance: FloatArray,
    rows: IntArray,
    probability: FloatArray,
    elapsed: float,
    settings: ExistenceSettings,
) -> FloatArray:
    """Existence (n,) after a frame in which tracks are `missed` (n,), by the chance (n,) to detect them, and those of
    `rows` (k,) have detections of a probability (k,)."""
    survival = math.exp(-elapsed / settings.lifetime)
    return existences(before, missed, chance, rows, probability, survival, settings.neutral_score)
