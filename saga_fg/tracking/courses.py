"""Courses of vehicles while they are predicted: known from headings, or from the path that they are on.

A track that is not detected goes on along its path: that of earlier traffic where there is any
(`saga_fg.tracking.traffic`), else that of its own heading and turn. On it, it takes on the speed of earlier traffic,
and its leaders are found. All is found anew for every interval and recorded with it (`saga_fg.model.turning`).
"""

import numpy as np

from saga_fg.kernels.paths import mean_courses
from saga_fg.model import Curvilinear, KnownCourses, Paths, Unseen, turning_time
from saga_fg.numerics import BoolArray, FloatArray, unchecked, wrap_angle
from saga_fg.tracking.track_filters import MOVING, TURNING
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.tracking.traffic import STEP, paths

ACROSS = 0.3  # m/s, deviation of the velocity of a vehicle across its path: it moves within its lane
LEAVING = 1.0  # m/s, where no earlier traffic tells the path: it may turn, or leave its lane
WIDEST = 0.3  # rad, of a course, however slow the vehicle
TURNING_OFF = 0.05  # share of vehicles that begin to turn where no earlier traffic tells it
HARDEST_TURN = 2.0  # m/s^2, across the path: of fast vehicles, comfort limits the turn
SHARPEST_TURN = 4.0  # m/s^2, across the path, that drivers hardly exceed (Reymond et al., Human Factors 43, 2001)
TURNING_TIME = 1.0  # s: a path is not known better than by what it turns within this time
FLOW_TIME = 3.0  # s, in which a vehicle takes on the speed of earlier traffic
STEPS = 20  # of a path, as far as leaders are looked for
_ASTRAY = 0.5  # rad between heading and motion, from which the motion is noise
_TINY = 1e-9  # so that nothing is divided by 0


def predicted_paths(state: TrackerState, unseen: BoolArray, dt: float) -> Paths:
    """The paths of the `unseen` (n,) vehicles that keep to their courses, of `STEPS` steps, in local positions.

    dt  s, until they are predicted anew
    """
    table, headed = state.table, unseen & np.isfinite(state.table.box.yaw)
    rate = np.zeros(len(table))
    able = np.zeros(len(table), dtype=np.bool_)
    for node_type, rows in state.joint.rows_by_type(table.label, moving=True):
        if isinstance(node_type.motion, Curvilinear) and node_type.motion.course_time > 0:
            rows = rows[headed[rows]]
            able[rows] = True
            if node_type.motion.turn_time > 0:
                rate[rows] = table.turn.known(rows, node_type.motion.turning_share)[0]
    rows = able.nonzero()[0]
    now = state.kinematics().select(rows)
    speed = np.hypot(*now.velocity.T)
    curvature = np.where(speed > MOVING, rate[rows], 0.0) / np.maximum(speed, MOVING)
    box, v, P = table.box, now.velocity, now.P_velocity
    heading = mean_courses(box.yaw[rows], box.yaw_variance[rows], v, P, _ASTRAY, _TINY)
    lasting = np.maximum(speed, MOVING)
    sharpest = SHARPEST_TURN / lasting[:, None] * np.column_stack([np.full(len(rows), dt), STEP / lasting])
    found = paths(state.traffic, table.id[rows], now.position + state.origin, heading, curvature, sharpest, STEPS)
    return unchecked(Paths, **vars(found) | {"row": rows, "position": found.position - state.origin})


def known_courses(state: TrackerState, dt: float, paths: Paths) -> tuple[tuple[KnownCourses, ...], FloatArray]:
    """The courses of vehicles with a heading over the next `dt` s, by motion; their turn rates are predicted after.

    Returned as well: the headings after it (n,), rad, of those that keep to their `paths`, NaN of others.
    """
    table, velocity = state.table, state.kinematics().velocity
    turn_time, found, after = np.zeros(len(table)), [], np.full(len(table), np.nan)
    path = np.full(len(table), -1)
    path[paths.row] = np.arange(len(paths))
    for node_type, rows in state.joint.rows_by_type(table.label, moving=True):
        motion = node_type.motion
        if not isinstance(motion, Curvilinear):
            continue
        turn_time[rows] = motion.turn_time
        rows = rows[np.isfinite(table.box.yaw[rows])]
        if len(rows) == 0:
            continue
        rate, variance = table.turn.known(rows, motion.turning_share)
        speed = np.hypot(*velocity[rows].T)
        turns = (motion.turn_time > 0) & (speed > MOVING)
        rate, variance = np.where(turns, rate, 0.0), np.where(turns, variance, 0.0)
        heading, (settling, across, pull) = table.box.yaw[rows], np.zeros((3, len(rows)))
        led = (path[rows] >= 0).nonzero()[0]
        if len(led):
            own, distance = paths.select(path[rows[led]]), speed[led] * dt
            turn = _at(own.heading, distance) - own.heading[:, 0]
            heading[led] = own.heading[:, 0]
            coasting = table.coasting(state.time)[rows[led]]
            settling[led], across[led] = _across(own, speed[led], coasting, motion.course_time)
            typical, weight = typical_speed(own, distance)
            pull[led] = weight / (weight + 1) * np.where(speed[led] > MOVING, typical - speed[led], 0.0) / FLOW_TIME
            after[rows[led]] = wrap_angle(heading[led] + turn)
            rate[led] = turn / turning_time(motion, dt)
        mean = state.joint.estimator.mean(table.id[rows])
        ids, unseen = table.id[rows], Unseen(settling, across, pull)
        found.append(KnownCourses.from_turn_rates(node_type, ids, heading, rate, variance, mean, dt, unseen))
    if turn_time.any():
        table.turn.predict(dt, turn_time)
    return tuple(found), after


def typical_speed(paths: Paths, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The speed (k,) of earlier traffic at a distance (k,), m, along k paths, m/s, and its weight (k,)."""
    weight = _at(paths.weight, distance)
    return _at(paths.weight * paths.speed, distance) / np.maximum(weight, _TINY), weight


def _across(paths: Paths, speed: FloatArray, unseen: FloatArray, course_time: float) -> tuple[FloatArray, FloatArray]:
    """Rate (k,), 1/s, with which the velocity across paths settles, and its variance (k,), (m/s)^2.

    It is that within the path, of the correlation time `course_time`, and that of those that have begun to turn off
    since they were seen, `unseen` (k,) s ago, with the acceleration a:

        s^2 = s_0^2 + a^2 t^2,   2 s^2 / k = 2 s_0^2 course_time + a^2 t^3      growth of the variance of the position
    """
    own = np.minimum(ACROSS**2 + (1 - paths.certainty) * LEAVING**2, (WIDEST * speed) ** 2)
    turn = _at(paths.heading, speed * TURNING_TIME) - paths.heading[:, 0]
    own = own + (paths.disagreement + turn**2) * speed**2
    off = (1 - paths.certainty) ** 2 * TURNING_OFF * np.minimum(TURNING * speed, HARDEST_TURN) ** 2 * unseen**2
    return 2 * (own + off) / np.maximum(2 * own * course_time + off * unseen, _TINY), own + off


def _at(column: FloatArray, distance: FloatArray) -> FloatArray:
    """Values (k,) of a column (k, m + 1) of paths at a distance (k,), m, interpolated."""
    most, each = column.shape[1] - 1, np.arange(len(column))
    share = np.minimum(distance / STEP, most)
    k = np.minimum(share.astype(np.int64), most - 1)
    return np.asarray(column[each, k] + (share - k) * (column[each, k + 1] - column[each, k]))
