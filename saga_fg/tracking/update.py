"""Update: matched measurements correct the state, and existence follows from all that was in view.

Visibility is the probability that a sensor has an object in view, apart from the probability that it exists. Every
frame is asked where it could have detected a track before its misses are held against it. The field of view of its
sensor decides the one half, other objects the other: v = 0 outside, and inside the belief v that the object is not
hidden follows a chain of two states,

    before a frame   v <- g + (v - g) exp(-dt / MEMORY),   g = 1 - HIDING c     c: the share that nearer boxes cover
    missed           v <- v (1 - p_D) / (1 - v p_D)
    detected         v <- 1

so that of a covered object, one miss makes it probable that it is hidden, and stays so while it is missed, whereas one
in plain view has no such excuse. The chance of a detection is r p_D v, with r the existence and p_D the sensor's
detection probability. It decides

    association   a track that nobody can see hardly takes a detection
    existence     r falls by misses only as far as the object should have been seen
    hit ratio     of a hidden object (v below 1/2), a miss is no opportunity
    score         of a box without a detection: times the v of the sensor that sees it best
    report        no box without a detection outside every field of view; an unconfirmed track is reported and deleted
                  by r v, so that false ones do not outlive their misses behind others

Source: Musicki and Evans, Joint Integrated Probabilistic Data Association, IEEE Transactions on Aerospace and
Electronic Systems 40(3), 2004: existence of targets that are observable or not, as a Markov chain.

The share of a box that others cover, as seen from a sensor: the azimuth interval an object's footprint fills, seen from
the sensor, is cut into equal cells, one ray through the middle of each. A ray enters the object's footprint at range r.
A nearer box on the ray of height h, between ranges r0 (where the ray enters it) and r1 (where it leaves), throws a
shadow of the sensor, mounted at height H, that reaches

    H + (h - H) r / r1   if h < H,          H + (h - H) r / r0   otherwise

high at range r, on level ground. The share of the object's height above the highest shadow is what is visible on that
ray; the mean over the rays is the visible share.

The matched measurements correct position and velocity, box, stationarity and class of their tracks. Where a detection
may be another track's, with the share w < 1 (`saga_fg.tracking.association`), the gain of its update is w times the
usual one, by a noise of

    R_w = S / w - H P H^T = R / w + (1 - w) / w H P H^T

so that a wrong detection hardly turns a track, and the mean of two detections, of which the tracks of a pair would
both make one, is never taken (the coalescence of JPDA: Bar-Shalom and Li, Multitarget-Multisensor Tracking, 1995,
section 6.2).

Where they are, and how fast, is remembered for the paths and speeds of others (`saga_fg.tracking.traffic`).

The probability r that a track is a real object is updated by Bayes' rule, and so is the score of its box.

    miss    r <- r (1 - p_D v) / (1 - r p_D v) exp(-dt / lifetime)
    match   r / (1 - r) <- r / (1 - r)  p / (1 - p)  (1 - c) / c

p_D is the sensor's chance to detect what it has in view, v the probability that it has the track in view,
p the detection's probability, and c that at which a detection is no evidence.

Source: Musicki, Evans, Stankovic, Integrated Probabilistic Data Association, IEEE Transactions on Automatic Control
39(6), 1994.
"""

import math
from dataclasses import replace

import numpy as np

from factors import RangeRate
from saga_fg.kernels.pairs import visible_shares
from saga_fg.model import POSITION, VELOCITY, own_motion
from saga_fg.numerics import BoolArray, FloatArray, IntArray, Matching, StrArray, chi_square_quantile
from saga_fg.tracking.joint_state import moved_to_present
from saga_fg.tracking.measurements import FrameMeasurements, relative_covariances
from saga_fg.tracking.track_filters import MOVING, Kinematics
from saga_fg.tracking.tracker_state import LIFETIME, TrackerState
from saga_fg.tracking.traffic import Passages
from saga_fg.types import Boxes

HIDING = 0.25  # share of covered objects that are hidden; detected are 0.73 to 0.84 of the cars that are detected
# in plain view, 0.5 to 0.85 of the pedestrians (two detectors on nuScenes, KITTI)
SOLID = 0.5  # existence from which a track hides others
WORTH = 0.05  # existence from which it is worth asking whether a track is covered
LOWEST_SENSOR = 1.5  # m above the ground, where the pose does not say so
RAYS = 12


def look(state: TrackerState, measurements: FrameMeasurements) -> None:
    """Note the probability that the sensor of a frame has each track in view, before what it detected is known."""
    table, sensor, pose = state.table, measurements.sensor, measurements.world_T_ego
    now = state.kinematics()
    place = now.position + state.origin
    view = sensor.sees(place, pose).astype(np.float64)
    asked = ((view > 0) & (table.existence >= WORTH)).nonzero()[0]
    if pose is not None and len(asked):
        boxes = state.boxes(now.position, now.velocity)
        eye = (pose @ sensor.extrinsics.ego_T_sensor)[:3, 3]
        ground = np.nanmedian(boxes.position[asked, 2] - np.nan_to_num(boxes.size[asked, 2]) / 2)
        eye[2] = max(eye[2] - ground, LOWEST_SENSOR)
        covered = 1 - visible_share(eye, boxes, asked, solid=table.existence >= SOLID)
        view[asked] -= HIDING * covered
    table.sensors.look(measurements.name, view, state.time - measurements.delay)


def visible_share(
    viewpoint: FloatArray, boxes: Boxes, targets: IntArray, rays: int = RAYS, solid: BoolArray | None = None
) -> FloatArray:
    """The share (K,), from 0 hidden to 1, of boxes[targets] (K,) visible from `viewpoint` (x, y, z), m.

    All boxes stand on the ground z = 0 of the frame they share with the viewpoint. Those of unknown size or heading
    are visible and hide nothing. solid: mask (N,) of the boxes that can hide others, of estimated ones, which hide
    nothing that they overlap; None: all, of true ones.
    """
    hiding = np.ones(len(boxes), dtype=np.bool_) if solid is None else solid
    estimated = solid is not None
    return visible_shares(viewpoint, boxes.position, boxes.yaw, boxes.size, targets, hiding, estimated, rays)


MIN_SHARE = 0.02  # of a detection, by which its track is still updated
MIN_RANGE = 1.0  # m; nearer, the direction of the line of sight is not known well enough for a range rate


def update_tracks(state: TrackerState, measurements: FrameMeasurements, matching: Matching) -> None:
    """Take in the measurements that are matched to tracks."""
    table, boxes, delay = state.table, measurements.boxes, measurements.delay
    t, d = matching.track, matching.detection
    z = np.concatenate([boxes.position[d, :2] - state.origin, boxes.velocity[d]], axis=1)
    R, with_velocity = measurements.R[d], measurements.with_velocity[d]
    relative = None if measurements.relative is None else measurements.relative.select(d)
    doubtful = (matching.share < 1).nonzero()[0]
    if len(doubtful):
        now = state.kinematics().select(t[doubtful])
        if relative is not None:
            at = t[doubtful]
            now = now._replace(P=relative_covariances(state.joint, table.id[at], table.label[at]))
        R[doubtful] = doubted(R[doubtful], matching.share[doubtful], now)
        if relative is not None and measurements.world_T_ego is not None:
            turn = measurements.world_T_ego[:2, :2]
            relative = replace(relative, R=turn.T @ R[:, :2, :2] @ turn)
    if state.settings.stationary_share > 0:
        position, P = state.past_positions(delay)
        moving = state.kinematics()._replace(position=position, P=P).select(t)
        table.stationarity.update(t, z, R, moving, with_velocity)
    state.joint.update(table.id[t], table.label[t], z, R, with_velocity, delay, relative)
    update_range_rates(state, measurements, d, table.id[t], table.label[t], matching.share)
    p, z_noise, yaw_noise = measurements.probability[d], measurements.z_noise[d], measurements.yaw_noise[d]
    table.box.update(t, boxes.size[d], p, boxes.position[d, 2], z_noise, boxes.yaw[d], yaw_noise)
    table.turn.update(t, boxes.yaw[d], yaw_noise)
    table.class_belief[t] = state.confused.updated(table.class_belief[t], measurements.class_likelihood[d])
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
            passing = Passages.from_tracks(
                table.id[t], table.label[t], there, table.box.yaw[t], moves[t], state.time, still
            )
            state.traffic.update(passing, state.time)
    state.reclassify()


def doubted(R: FloatArray, share: FloatArray, now: Kinematics) -> FloatArray:
    """R_w (k, 4, 4) of measurements of noise R (k, 4, 4) with shares (k,) of tracks that are predicted at `now`."""
    w, P = np.maximum(share, MIN_SHARE)[:, None, None], np.zeros_like(R)
    P[:, :2, :2], P[:, 2:, 2:] = now.P, now.P_velocity
    return np.asarray(R / w + (1 - w) / w * P)


def follow_encounters(
    state: TrackerState, measurements: FrameMeasurements, matching: Matching, rivals: IntArray, elapsed: float
) -> None:
    """Begin the encounters of `rivals` (e, 2), rows of predicted tracks, and follow all; elapsed: s since the frame
    before. Those of tracks that have no velocity, or no longer, end."""
    table, joint, places = state.table, state.joint, state.joint.places(state.table.label)
    known = state.encounters.live(table.id[(places >= 0).all(axis=1)], state.time)
    if len(rivals):
        rivals = rivals[(places[rivals] >= 0).all(axis=(1, 2))]
        x, P = joint.estimator.planar_marginals(table.id[rivals.ravel()], places[rivals.ravel()])
        known = known.begun(table.id[rivals], x.reshape(-1, 2, 4), P.reshape(-1, 2, 4, 4), state.time)
    if len(known):
        rows, detection = table.rows(known.ids), np.full(len(table), -1)
        detection[matching.track] = matching.detection
        d = detection[rows]
        seen, z, R = d >= 0, np.zeros((len(known), 2, 2)), np.zeros((len(known), 2, 2, 2))
        z[seen] = measurements.boxes.position[d[seen], :2] - state.origin
        R[seen] = measurements.R[d[seen], :2, :2]
        label = table.label[rows[:, 0]].tolist()
        types = {name: joint.type_of(name) for name in set(label)}
        of_class = {name: own_motion(each, 1.0)[1][each.planar[2], each.planar[2]] for name, each in types.items()}
        noise = np.array([of_class[name] for name in label])
        known = known.followed(noise, np.where(known.since < state.time, elapsed, 0.0), z, R, seen)
    state.encounters = known


def exchange_identities(state: TrackerState, matching: Matching) -> Matching:
    """Exchange the tracks of the encounter that have probably exchanged their objects, one a frame; returns the
    matching by the rows that then have the detections."""
    for a, b, since in state.encounters.exchanges(state.table.id[state.table.coasting(state.time) == 0]):
        order = state.exchange(a, b, since)
        matching = replace(matching, track=order[matching.track])
        state.encounters = state.encounters.without(a, b)
    return matching


def infer_signals(state: TrackerState, matching: Matching) -> None:
    """Update the states of traffic lights by the tracks that have just been detected."""
    if state.map_nodes.beliefs and len(state.map_nodes.drivers):
        t, now = matching.track, state.reported_kinematics()
        P = now.P_velocity[t]
        variance = (P[:, 0, 0] + P[:, 1, 1]) / 2
        state.map_nodes.infer(state.table.id[t], now.velocity[t], variance, state.time)


def update_range_rates(
    state: TrackerState,
    measurements: FrameMeasurements,
    rows: IntArray,
    ids: IntArray,
    label: StrArray,
    share: FloatArray,
) -> None:
    """Take in the range rates of the measurements `rows` (k,) of tracks `ids` (k,), after their positions.

    Every estimator takes the same linear measurement: the range rate linearised at the present estimate, moved back by
    the delay of the frame along own motion, doubted by its `share` (k,). Left out are tracks within `MIN_RANGE` of
    the sensor, and range rates outside the gate of the class.
    """
    measured = np.isfinite(measurements.range_rate[rows])
    if measurements.viewpoint is None or not measured.any():
        return
    rows, ids, label, share = rows[measured], ids[measured], label[measured], np.maximum(share[measured], MIN_SHARE)
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
        clear = np.hypot(*(x[:, at_p] - viewpoint).T) >= MIN_RANGE
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
        R = R + (1 / share[chosen, None, None] - 1) * S  # R_w, as S = R + H P H^T
        joint.measure(node_type, ids[chosen][likely], z[likely], H[likely], R[likely], delay)


SCORE_MEMORY = 0.15  # time for which the latest detection of each sensor counts in a track's score, s


def existences(
    before: FloatArray,
    missed: BoolArray,
    chance: FloatArray,
    rows: IntArray,
    probability: FloatArray,
    survival: float,
    neutral: float,
) -> FloatArray:
    """Existence (n,) of tracks after a frame, see the module.

        missed: r (1 - c) / (1 - r c) survival,   detected: odds of r times p (1 - neutral) / ((1 - p) neutral)

    missed (n,) ones, by the chance (n,) to detect them; detections of a probability (k,) of the tracks `rows` (k,)
    """
    after = np.where(missed, before * (1 - chance) / np.maximum(1 - before * chance, 1e-9) * survival, before)
    r = np.clip(before[rows], 1e-3, 1 - 1e-3)
    odds = probability / (1 - probability) * (1 - neutral) / neutral * (r / (1 - r))
    after[rows] = np.clip(odds / (1 + odds), 0.0, 0.999)
    return after


def update_existence(state: TrackerState, measurements: FrameMeasurements, matching: Matching, elapsed: float) -> None:
    """Update existence, score and confirmation of all tracks; elapsed: time since the latest frame, s."""
    table, settings = state.table, state.settings.existence
    if len(table) == 0:
        return
    time, t, d = state.time - measurements.delay, matching.track, matching.detection
    missed = np.ones(len(table), dtype=bool)
    missed[t] = False
    if measurements.sensor.initiation == "alone" and measurements.viewpoint is not None:
        table.overlooked[table.sensors.overlooked_by(measurements.name, missed) & ~np.isnan(table.overlooked)] = time
    p_detect = measurements.sensor.detection_chance(table.label)
    p_seen = p_detect * table.sensors.seen_by(measurements.name)
    # a track that another sensor has just detected exists, whether this one misses it or not
    excused = table.sensors.detected_by_others(measurements.name, time, SCORE_MEMORY)
    p, p_miss, resolved = measurements.probability[d], np.where(excused, 0.0, p_seen), table.unresolved[t] == 0
    # a detection of an unresolved track may be of the track that it overlaps
    survival = math.exp(-elapsed / LIFETIME)
    table.existence = existences(
        table.existence, missed, p_miss, t[resolved], p[resolved], survival, settings.neutral_score
    )
    table.last_existence[t] = table.existence[t]
    table.confirmed |= table.existence >= settings.confirm_above
    table.sensors.update(measurements.name, time, t, p, missed, p_detect)
    fused = table.sensors.probability(state.time, max(SCORE_MEMORY, measurements.delay))
    table.score = np.where(np.isfinite(fused), fused, table.score)
    table.best_score = np.maximum(table.best_score, table.score)
    table.covariance_scale[t], table.position_bias[t] = measurements.covariance_scale[d], measurements.position_bias[d]
    table.last_detected[t] = np.maximum(table.last_detected[t], time)
