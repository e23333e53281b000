"""Look ahead: the tracks that are reported now at future times, predicted jointly, with edges that go on to act.

The interval to a horizon is predicted in steps of at most `STEP`, each with the edges of the estimates at its start: as
the leader slows down, gaps and rates change. With s the probability that a track is stationary, and P the joint
covariance of the filter, the covariance between tracks i and j is

    (1 - s_i) P_ij (1 - s_j)     i != j

since whether an object is stationary is its own affair; the mean and the block i = j are those of
`saga_fg.tracking.stationarity`. The calibration of reported covariances is left out: it is about the errors of
detections (`saga_fg.tracking.reporting`), which soon are the smaller part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.tracking.prediction import predict
from saga_fg.tracking.reporting import reported_rows
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.predicted_tracks import PredictedTracks

STEP = 0.5  # s, the longest with the same edges; a shorter `max_step` counts


@dataclass(eq=False)
class _Prediction(Columns):
    """The tracks at one time: id (n,), position and velocity (n, 2), yaw (n,), covariances (n, 2, 2)."""

    id: IntArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    P: FloatArray
    P_velocity: FloatArray


def look_ahead(state: TrackerState, horizons: FloatArray, joint: bool = False) -> PredictedTracks:
    """Predict the reported tracks to `horizons` (H,), s; changes the state, which is to be a copy.

    Left out are tracks that can't be predicted to the last of them. joint: with their joint covariances.
    """
    newest, reported = state.clock.newest, state.table.id[reported_rows(state)]
    predicted, together = [], []
    for horizon in horizons.tolist():
        _predict_to(state, state.relative(newest) + horizon)
        rows = np.flatnonzero(np.isin(state.table.id, reported))
        predicted.append(_prediction(state, rows))
        together.append(_joint_covariance(state, rows, predicted[-1].P) if joint else np.empty((0, 0)))
    last = predicted[-1]
    rows_of = [np.flatnonzero(np.isin(each.id, last.id)) for each in predicted]
    at = [each.select(rows) for each, rows in zip(predicted, rows_of, strict=True)]
    return PredictedTracks(
        newest,
        horizons,
        last.id,
        state.table.label[np.isin(state.table.id, last.id)],
        np.stack([each.position + state.origin for each in at]),
        np.stack([each.velocity for each in at]),
        np.stack([each.yaw for each in at]),
        np.stack([each.P for each in at]),
        np.stack([each.P_velocity for each in at]),
        np.stack([P[np.ix_(k, k)] for P, k in zip(together, map(_pairs, rows_of), strict=True)]) if joint else None,
    )


def _predict_to(state: TrackerState, time: float) -> None:
    """Predict to a time counted from the state's start, s, in short steps."""
    begin, elapsed = state.time, time - state.time
    steps = math.ceil(elapsed / STEP - 1e-9)
    for k in range(1, steps + 1):
        predict(state, time if k == steps else begin + k * elapsed / steps, ahead=True)


def _prediction(state: TrackerState, rows: IntArray) -> _Prediction:
    table, now = state.table.select(rows), state.reported_kinematics().select(rows)
    return _Prediction(table.id, now.position, now.velocity, table.box.yaw, now.P, now.P_velocity)


def _joint_covariance(state: TrackerState, rows: IntArray, own: FloatArray) -> FloatArray:
    """(2n, 2n) of the positions of the tracks `rows` (n,), whose own covariances are `own` (n, 2, 2)."""
    table, n = state.table.select(rows), len(rows)
    P = state.joint.position_covariance(table.id, table.label).reshape(n, 2, n, 2)
    if state.settings.stationarity.prior > 0:
        moves = np.where(table.coasting(state.time) > 0, 1 - table.stationarity.probability, 1.0)
        P = P * (moves[:, None] * moves)[:, None, :, None]
    P[np.arange(n), :, np.arange(n)] = own
    return np.asarray(P.reshape(2 * n, 2 * n))


def _pairs(rows: IntArray) -> IntArray:
    """(2k,) places of the coordinates of `rows` (k,)."""
    return np.asarray((2 * rows[:, None] + [0, 1]).ravel())
