r"""Update of the probability r that a track is a real object, by Bayes' rule, and of the score of its box.

    miss    r <- r (1 - p_D) / (1 - r p_D) exp(-dt / lifetime)
    match   r / (1 - r) <- r / (1 - r)  p / (1 - p)  (1 - c) / c

p_D is the chance of a detection at the track (0 outside the field of view), p the detection's probability, and c the
probability at which a detection is no evidence. Source: Musicki, Evans, Stankovic, Integrated Probabilistic Data
Association, IEEE Transactions on Automatic Control 39(6), 1994.

Boxes behind other boxes have a smaller chance of a detection, by the share of their bearings that is covered:

    covered_i = max over j nearer than i of   | [a_i, b_i] and [a_j, b_j] | / (b_i - a_i)

[a, b] is the interval of bearings of a box. A box is nearer if its centre is by at least half its diagonal. Heights are
left out, so that a low object in front of a tall one covers more than it hides.
"""

from __future__ import annotations

import math

import numpy as np

from saga_fg.kernels.covariances import existences
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.assignment import Matching
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.numerics.near_pairs import near_pairs
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.settings import ExistenceSettings
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.boxes import Boxes

HAIR = 1e-9  # rad

HIDDEN = 0.5  # covered share from which a frame is no opportunity to detect a box


def update_existence(state: TrackerState, measurements: FrameMeasurements, matching: Matching, elapsed: float) -> None:
    """Update existence, score and confirmation of all tracks; elapsed: time since the latest frame, s."""
    table, settings, memory = state.table, state.settings.existence, state.settings.score_memory
    if len(table) == 0:
        return
    time, t, d = state.time - measurements.delay, matching.track, matching.detection
    missed = np.ones(len(table), dtype=bool)
    missed[t] = False
    now, sensor = state.kinematics(), measurements.sensor
    visible = sensor.sees(now.position + state.origin, measurements.world_T_ego)
    table.last_in_view[table.sensors.look(measurements.name, visible)] = state.time
    p_detect = np.where(visible, sensor.detection_chance(table.label), 0.0)
    if settings.occlusion_weight > 0 and measurements.viewpoint is not None and missed.any():
        boxes = state.boxes(now.position, now.velocity)
        hidden = settings.occlusion_weight * covered(boxes, measurements.viewpoint, ~missed)
        p_detect, visible = p_detect * (1 - hidden), visible & (hidden < HIDDEN)
    # a track that another sensor has just detected exists, whether this one misses it or not
    excused = table.sensors.detected_by_others(measurements.name, time, memory)
    p, p_miss, resolved = measurements.probability[d], np.where(excused, 0.0, p_detect), table.unresolved[t] == 0
    # a detection of an unresolved track may be of the track that it overlaps
    table.existence = _existence(table.existence, missed, p_miss, t[resolved], p[resolved], elapsed, settings)
    table.last_existence[t] = table.existence[t]
    table.confirmed |= table.existence >= settings.confirm_above
    table.sensors.update(measurements.name, time, t, p, missed & visible, p_detect)
    fused = table.sensors.probability(state.time, max(memory, measurements.delay))
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


def covered(boxes: Boxes, viewpoint: FloatArray, opaque: BoolArray) -> FloatArray:
    """(n,) covered shares between 0 and 1; boxes of unknown size or heading neither cover nor are covered.

    viewpoint (2,) in the frame of the boxes; opaque (n,): which boxes can cover others
    """
    known = np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw)
    rows = np.flatnonzero(known)
    share = np.zeros(len(boxes))
    if not (known & opaque).any():
        return share
    seen = boxes.select(rows)
    offset = seen.position[:, :2] - viewpoint
    distance, bearing = np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
    corners = seen.corners() - viewpoint
    turn = wrap_angle(np.arctan2(corners[..., 1], corners[..., 0]) - bearing[:, None])
    low, high = turn.min(axis=1), turn.max(axis=1)
    front = np.flatnonzero(opaque[rows])
    angle, half = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1), np.maximum(-low, high) + HAIR
    i, j = near_pairs(angle, angle[front], half, half[front])  # a chord is shorter than its arc
    j = front[j]
    apart = wrap_angle(bearing[j] - bearing[i])
    common = np.minimum(high[i], apart + high[j]) - np.maximum(low[i], apart + low[j])
    nearer = distance[j] + np.hypot(*seen.size[j, :2].T) / 2 < distance[i]
    part = np.zeros(len(rows))
    np.maximum.at(part, i[nearer], (common / np.maximum(high - low, 1e-6)[i])[nearer])
    share[rows] = np.clip(part, 0.0, 1.0)
    return share
