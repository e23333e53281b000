r"""Turn rates of tracks from their measured headings, each estimated by itself beside the joint state.

    h' = h + w tau (1 - exp(-dt / tau)),   w' = w exp(-dt / tau) + noise of the stationary deviation sigma
    heading z = h + v,   v ~ N(0, r^2),   S = max(P_h + r^2, (z - h)^2 / 4)

S is the variance of the innovation z - h; beyond twice its expected deviation a heading is an outlier and counts less.

A heading may be off by half a turn, and is turned to the side of the estimate. Most objects go straight most of the
time, while w is noise. So what is predicted with is the mean of w, and its variance, under the prior that a share of
objects turns, `Curvilinear.turning_share`:

    w_known = w ( g sigma_t^2 / (P + sigma_t^2) + (1 - g) sigma_s^2 / (P + sigma_s^2) ),   g = P(turns | w)

with sigma_t the deviation of the rates of those that turn, sigma_s of the others. Sources: Singer (1970) for the
first-order decay; Huber (1981) for the weights; the shrinkage is the posterior mean under a mixture of two Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.columns import Columns
from saga_fg.numerics.geometry import wrap_angle

DEVIATION = 0.15  # rad/s, stationary standard deviation of a rate: a bend of 50 m at 7 m/s
TURNING = 0.3  # rad/s, deviation of their rates: a crossing is a quarter turn in some 5 s
STRAIGHT = 0.01  # rad/s, deviation of the others' rates: corrections within the lane
_LEAST_TIME = 1e-3  # s, so that a fading time of 0 divides nothing by 0: the rate is gone at once
OUTLIER = 2.0  # standard deviations of an innovation, which 95 % of good headings don't exceed


@dataclass(eq=False)
class TurnRate(Columns):
    """Columns over n tracks: heading (n,), NaN is unknown, rate (n,), rad/s, and their covariance P (n, 2, 2)."""

    heading: FloatArray
    rate: FloatArray
    P: FloatArray

    @classmethod
    def empty(cls) -> TurnRate:
        return cls.initiated(np.empty(0), np.empty(0))

    @classmethod
    def initiated(cls, yaw: FloatArray, yaw_noise: FloatArray) -> TurnRate:
        """Return the rows of new tracks; yaw_noise (n,) standard deviation."""
        P = np.zeros((len(yaw), 2, 2))
        P[:, 0, 0], P[:, 1, 1] = yaw_noise**2, DEVIATION**2
        return cls(yaw.copy(), np.zeros(len(yaw)), P)

    def predict(self, dt: float, fading_time: FloatArray) -> None:
        """Predict by `dt` s; fading_time (n,), s, 0 where turns are not modelled."""
        tau = np.maximum(fading_time, _LEAST_TIME)
        kept = np.exp(-dt / tau)
        turned, variance = tau * (1 - kept), DEVIATION**2
        F, Q = np.tile(np.eye(2), (len(tau), 1, 1)), np.empty((len(tau), 2, 2))
        F[:, 0, 1], F[:, 1, 1] = turned, kept
        Q[:, 0, 0] = variance * tau * (2 * dt - tau * (3 - 4 * kept + kept**2))
        Q[:, 0, 1] = Q[:, 1, 0] = variance * turned * (1 - kept)
        Q[:, 1, 1] = variance * (1 - kept**2)
        self.heading = wrap_angle(self.heading + turned * self.rate)
        self.rate = kept * self.rate
        self.P = F @ self.P @ np.swapaxes(F, 1, 2) + Q

    def update(self, rows: IntArray, yaw: FloatArray, yaw_noise: FloatArray) -> None:
        """Take in one heading each of the tracks `rows` (k,); NaN is none."""
        measured = np.isfinite(yaw)
        rows, yaw, variance = rows[measured], yaw[measured], yaw_noise[measured] ** 2
        new = ~np.isfinite(self.heading[rows])
        self.heading[rows[new]], self.P[rows[new], 0, 0] = yaw[new], variance[new]
        self.P[rows[new], 0, 1] = self.P[rows[new], 1, 0] = 0.0
        rows, yaw, variance = rows[~new], yaw[~new], variance[~new]
        innovation = wrap_angle(2 * (yaw - self.heading[rows])) / 2
        P = self.P[rows]
        S = np.maximum(P[:, 0, 0] + variance, (innovation / OUTLIER) ** 2)
        gain = P[:, :, 0] / S[:, None]
        self.heading[rows] = wrap_angle(self.heading[rows] + gain[:, 0] * innovation)
        self.rate[rows] += gain[:, 1] * innovation
        self.P[rows] = P - gain[:, :, None] * P[:, None, 0]

    def known(self, rows: IntArray, turning_share: float) -> tuple[FloatArray, FloatArray]:
        """Turn rates of tracks `rows` (k,) to predict with, rad/s, and their variances (k,)."""
        rate, P, share = self.rate[rows], self.P[rows, 1, 1], min(max(turning_share, 1e-9), 1 - 1e-9)
        straight, turning = P + STRAIGHT**2, P + TURNING**2
        log_odds = np.log(share / (1 - share)) + 0.5 * np.log(straight / turning)
        turns = 1 / (1 + np.exp(np.clip(-log_odds - 0.5 * rate**2 * (1 / straight - 1 / turning), -50, 50)))
        if_turning, if_straight = TURNING**2 / turning, STRAIGHT**2 / straight
        kept = turns * if_turning + (1 - turns) * if_straight
        between = turns * (1 - turns) * (rate * (if_turning - if_straight)) ** 2
        return rate * kept, P * kept + between
