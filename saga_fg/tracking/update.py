"""Update: the matched measurements correct position and velocity, box, stationarity and class of their tracks.

Where they are, and how fast, is remembered for the paths and speeds of others (`saga_fg.tracking.traffic`).
"""

from __future__ import annotations

import numpy as np

from factors import RangeRate
from saga_fg.model.discretisation import own_motion
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import IntArray, StrArray
from saga_fg.numerics.assignment import Matching
from saga_fg.numerics.chi_square import chi_square_quantile
from saga_fg.tracking.box_filter import MOVING
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.out_of_sequence import moved_to_present
from saga_fg.tracking.retrodiction import past_positions
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.traffic import Passages

LEAST_RANGE = 1.0  # m; nearer, the direction of the line of sight is not known well enough for a range rate


def update_tracks(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> None:
    """Take in the measurements that are matched to tracks."""
    _update_class(state, measurements, matching)
    table, boxes, delay = state.table, measurements.boxes, measurements.delay
    t, d = matching.track, matching.detection
    z = np.concatenate([boxes.position[d, :2] - state.origin, boxes.velocity[d]], axis=1)
    R, with_velocity = measurements.R[d], measurements.with_velocity[d]
    if state.settings.stationarity.prior > 0:
        position, P = past_positions(state, delay)
        moving = state.kinematics()._replace(position=position, P=P).select(t)
        table.stationarity.update(t, z, R, moving, with_velocity)
    relative = None if measurements.relative is None else measurements.relative.select(d)
    state.joint.update(table.id[t], table.label[t], z, R, with_velocity, delay, relative)
    update_range_rates(state, measurements, d, table.id[t], table.label[t])
    p, z_noise, yaw_noise = measurements.probability[d], measurements.z_noise[d], measurements.yaw_noise[d]
    table.box.update(t, boxes.size[d], p, boxes.position[d, 2], z_noise, boxes.yaw[d], yaw_noise)
    table.turn.update(t, boxes.yaw[d], yaw_noise)
    if len(table):
        now = state.reported_kinematics()
        speed = np.hypot(*now.velocity.T)
        moves = (speed > MOVING) & (speed > 3 * now.speed_deviation)
        table.box.face_motion(np.where(moves[:, None], now.velocity, 0.0))
        table.has_moved[t] |= moves[t]
        if state.settings.traffic.memory > 0:
            there = now.select(t)
            there = there._replace(position=there.position + state.origin)
            still = table.stationarity.probability[t]
            passing = Passages.of(table.id[t], table.label[t], there, table.box.yaw[t], moves[t], state.time, still)
            state.traffic.update(passing, state.time)


def infer_signals(state: TrackerState, matching: Matching) -> None:
    """Update the states of traffic lights by the tracks that have just been detected."""
    if state.map_nodes.infers and len(state.map_nodes.drivers):
        t, now = matching.track, state.reported_kinematics()
        P = now.P_velocity[t]
        variance = (P[:, 0, 0] + P[:, 1, 1]) / 2
        state.map_nodes.infer(state.table.id[t], now.velocity[t], variance, state.time)


def _update_class(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> None:
    groups, table = state.class_groups, state.table
    if len(groups):
        likelihood = measurements.class_likelihood[matching.detection]
        table.class_belief[matching.track] = groups.updated(table.class_belief[matching.track], likelihood)
        table.label = groups.labels(table.class_belief, table.label)


def update_range_rates(
    state: TrackerState, measurements: FrameMeasurements, rows: IntArray, ids: IntArray, label: StrArray
) -> None:
    """Take in the range rates of the measurements `rows` (k,) of tracks `ids` (k,), after their positions.

    Every estimator takes the same linear measurement: the range rate linearised at the present estimate, moved back by
    the delay of the frame along own motion. Left out are tracks within `LEAST_RANGE` of the sensor, and range rates
    outside the gate of the class.
    """
    measured = np.isfinite(measurements.range_rate[rows])
    if measurements.viewpoint is None or not measured.any():
        return
    rows, ids, label = rows[measured], ids[measured], label[measured]
    rate, variance = measurements.range_rate[rows], measurements.range_rate_variance[rows]
    gate = np.array([chi_square_quantile(share, 1) for share in state.class_values(label, "gate")[0]])
    viewpoint, delay, joint = measurements.viewpoint - state.origin, measurements.delay, state.joint
    for node_type, of_type in joint.rows_by_type(label, moving=True):
        if not node_type.has(VELOCITY):
            continue
        at_p, at_v = node_type.index(POSITION).tolist(), node_type.index(VELOCITY).tolist()
        x = joint.estimator.mean(ids[of_type])
        if delay > 0:
            x = x @ np.linalg.inv(own_motion(node_type, delay)[0]).T
        clear = np.hypot(*(x[:, at_p] - viewpoint).T) >= LEAST_RANGE
        chosen, x = of_type[clear], x[clear]
        if len(chosen) == 0:
            continue
        model = RangeRate(node_type.dim, tuple(at_p), tuple(at_v), (float(viewpoint[0]), float(viewpoint[1]), 0.0))
        H = model.jacobian(x)
        innovation, R = rate[chosen, None] - model.predict(x), variance[chosen, None, None]
        H_now, R_now = moved_to_present(node_type, H, R, delay) if delay > 0 else (H, R)
        S = H_now @ joint.estimator.covariance(ids[chosen]) @ np.swapaxes(H_now, 1, 2) + R_now
        likely = innovation[:, 0] ** 2 <= gate[chosen] * S[:, 0, 0]
        z = innovation + (H @ x[:, :, None])[:, :, 0]
        joint.measure(node_type, ids[chosen][likely], z[likely], H[likely], R[likely], delay)
