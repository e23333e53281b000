"""Initiate: detections that belong to no track, and are probable enough, begin new ones.

A new track begins with its measurement and the prior of its class: where no velocity was measured, with that of the
traffic around it (`saga_fg.tracking.traffic`). Returns of lost objects are left out before
(`saga_fg.tracking.relinking`); a new track over another one is tentative (`saga_fg.tracking.unresolved`).
"""

import numpy as np

from saga_fg.numerics import FloatArray, IntArray, Matching
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.relinking import CONFIRMING, initiating
from saga_fg.tracking.track_filters import BoxFilter, Kinematics, Stationarity, TurnRate, after_evidence, log_density
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.unresolved import unresolved_frames
from saga_fg.tracking.update import update_range_rates
from saga_fg.types import Boxes


def initiate_tracks(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> IntArray:
    """Append new tracks; returns the rows of their measurements, whose delay the tracks are predicted by."""
    rows = initiating(state, measurements, matching)
    if len(rows) == 0:
        return rows
    k, delay, boxes, p = len(rows), measurements.delay, measurements.boxes.select(rows), measurements.probability[rows]
    ids = np.arange(state.next_id, state.next_id + k, dtype=np.int64)
    state.next_id += k
    unresolved = unresolved_frames(state, matching, boxes, p, measurements.R[rows, :2, :2])
    kinematics, stationary = initial_kinematics(state, measurements, rows, boxes)
    relative = None if measurements.relative is None else measurements.relative.select(rows)
    state.joint.add(ids, boxes.label, kinematics, delay, relative, appended=True)
    update_range_rates(state, measurements, rows, ids, boxes.label, np.ones(k))
    time, alone = state.time - delay, measurements.sensor.initiation == "alone"
    z_noise, yaw_noise = measurements.z_noise[rows], measurements.yaw_noise[rows]
    new = TrackTable(
        ids,
        boxes.label,
        existence=p.copy(),
        last_existence=p.copy(),
        score=p.copy(),
        best_score=p.copy(),
        covariance_scale=measurements.covariance_scale[rows],
        position_bias=measurements.position_bias[rows],
        initiated=np.full(k, time),
        last_detected=np.full(k, time),
        confirmed=(p >= state.settings.existence.confirm_above) & (unresolved == 0),
        has_moved=np.zeros(k, dtype=bool),
        required_hits=np.full(k, float(state.settings.min_hits if alone else CONFIRMING)),
        overlooked=np.full(k, np.nan if alone else -np.inf),
        unresolved=unresolved,
        class_belief=state.confused.initial(measurements.class_likelihood[rows]),
        box=BoxFilter.initiated(boxes.size, p, boxes.position[:, 2], z_noise, boxes.yaw, yaw_noise),
        stationarity=Stationarity.initiated(kinematics, stationary),
        turn=TurnRate.initiated(boxes.yaw, yaw_noise),
        sensors=state.table.sensors.initiated(measurements.name, p, time),
    )
    state.table = state.table.append(new)
    return rows


def initial_kinematics(
    state: TrackerState, measurements: FrameMeasurements, rows: IntArray, boxes: Boxes
) -> tuple[Kinematics, FloatArray]:
    """The kinematics of new tracks from the measurements `rows` (k,), with their boxes, if they move; and the
    probability (k,) that they are stationary."""
    R, prior, measured = measurements.R[rows], state.settings.stationary_share, measurements.with_velocity[rows]
    place = boxes.position[:, :2]
    velocity, P_velocity, stationary = state.unmeasured_velocity(boxes.label, place, boxes.yaw, prior)
    if not measured.any():
        return Kinematics(place - state.origin, velocity, R[:, :2, :2], P_velocity), stationary
    if prior > 0:
        z, R_v = np.nan_to_num(boxes.velocity), R[:, 2:, 2:]
        evidence = log_density(z, R_v) - log_density(z - velocity, P_velocity + R_v)
        stationary = np.where(measured, after_evidence(stationary, evidence), stationary)
    kinematics = Kinematics(
        place - state.origin,
        np.where(measured[:, None], boxes.velocity, velocity),
        R[:, :2, :2],
        np.where(measured[:, None, None], R[:, 2:, 2:], P_velocity),
    )
    return kinematics, stationary
