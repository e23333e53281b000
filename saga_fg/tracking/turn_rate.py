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

from saga_fg.kernels.turning import known_turning, predicted_turning, updated_turning
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.columns import Columns

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
        before, scales = (self.heading, self.rate, self.P), (DEVIATION, _LEAST_TIME)
        self.heading, self.rate, self.P = predicted_turning(*before, dt, fading_time, *scales)

    def update(self, rows: IntArray, yaw: FloatArray, yaw_noise: FloatArray) -> None:
        """Take in one heading each of the tracks `rows` (k,); NaN is none."""
        now = updated_turning(self.heading, self.rate, self.P, rows, yaw, yaw_noise, OUTLIER)
        self.heading[rows], self.rate[rows], self.P[rows] = now

    def known(self, rows: IntArray, turning_share: float) -> tuple[FloatArray, FloatArray]:
        """Turn rates of tracks `rows` (k,) to predict with, rad/s, and their variances (k,)."""
        share = min(max(turning_share, 1e-9), 1 - 1e-9)
        return known_turning(self.rate, self.P, rows, share, TURNING, STRAIGHT)
