r"""Stationary or moving: a discrete state of every track beside its Gaussian one, and its use.

    s <- b + (s - b) exp(-(start + halt) dt),   b = halt / (start + halt)       prediction over dt
    halt = stop E[ exp(-|v|^2 / (2 h^2)) ],   h = `HALTING_SPEED`,   v ~ N(v, P_v)
    s / (1 - s) <- s / (1 - s)  N(z; a, D + R) / N(z; H m, H P H^T + R)         update with a detection z

s is the probability that the object is stationary. If it moves, its state is that of the joint filter, N(m, P). If it
is stationary, it has a position of its own, N(a, D), which drifts slowly and of which all its detections are
measurements; the position of an object that has just halted is that of the joint filter, and the two are merged by
their moments. Only slow objects halt, so that no outlier, and no gap, brings a fast one to rest. A measured velocity is
a second piece of evidence, N(z_v; 0, R_v) against N(z_v; v, P_v + R_v), taken for independent of the first.

The probability is used in two places. The joint filter's process noise over the next interval is the one expected
under it, (1 - s + s * noise) Qc, frozen with the interval as the edges are. The reported velocity is the mixture,

    v_reported = (1 - s) v     P_reported = (1 - s) P_v + s (1 - s) v v^T

and so is the reported position of a track that is not detected: stationary objects stay where they were seen.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 11.6: the
interacting multiple model, here without mixing the stationary state into the moving one, so that the joint filter stays
a Kalman filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.kernels.stationarity import predicted_places, reported_moments, updated_places
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.assignment import mahalanobis_of_pairs
from saga_fg.numerics.columns import Columns
from saga_fg.settings import Fraction, NonNegative, Settings, setting
from saga_fg.tracking.kinematics import Kinematics

HALTING_SPEED = 1.0  # m/s, scale of the speeds from which an object comes to rest at once: walking, or the last metre
_MOST_LOG_ODDS = 12.0  # so that later evidence can still change the probability
NOISE_SCALE = 0.05  # factor on the process noise of a stationary object


@dataclass(frozen=True)
class StationaritySettings(Settings):
    """Probability that an object is stationary."""

    prior: Fraction = setting(
        0.0, "share of new objects that are stationary; 0: off; usual 0.5 where many cars are parked"
    )
    start_rate: NonNegative = setting(
        0.02, "rate at which stationary objects start to move, 1/s; higher: departing cars are followed sooner"
    )
    stop_rate: NonNegative = setting(
        0.05,
        "rate at which slow objects come to rest, 1/s; usual 0.02 to 0.1; higher: they are held as stationary sooner",
    )
    drift: NonNegative = setting(
        0.02, "standard deviation of the drift of a stationary position in one second, m; usual 0 to 0.1"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prior == 1 or NOISE_SCALE == 0:
            raise InputError(
                "prior and noise_scale: expected a prior below 1 and a scale above 0, since everything may move"
            )


@dataclass(eq=False)
class Stationarity(Columns):
    """Columns over n tracks: probability (n,) of being stationary; then, position (n, 2), local, m, and its covariance
    P (n, 2, 2)."""

    position: FloatArray
    P: FloatArray
    probability: FloatArray

    @classmethod
    def empty(cls) -> Stationarity:
        return cls(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))

    @classmethod
    def initiated(cls, now: Kinematics, probability: FloatArray) -> Stationarity:
        """Return the rows of new tracks."""
        return cls(now.position.copy(), now.P.copy(), probability)

    def predict(self, dt: float, moving: Kinematics, settings: StationaritySettings) -> None:
        """Predict by `dt` s; `moving` is the joint filter's state before."""
        rates = dt, settings.start_rate, settings.stop_rate, settings.drift, HALTING_SPEED
        self.probability, self.position, self.P = predicted_places(
            self.probability, self.position, self.P, *moving, *rates
        )

    def update(
        self, rows: IntArray, z: FloatArray, R: FloatArray, moving: Kinematics, with_velocity: BoolArray
    ) -> None:
        """Take in one detection each for the tracks `rows` (k,).

        z (k, 4) position and velocity, R (k, 4, 4); `moving`: the joint filter's prediction of these tracks
        """
        if len(rows):
            still = self.probability, self.position, self.P, rows
            self.probability[rows], self.position[rows], self.P[rows] = updated_places(
                *still, z, R, *moving, with_velocity, _MOST_LOG_ODDS
            )

    def noise_scale(self, settings: StationaritySettings) -> FloatArray:
        """(n,) factor on the process noise, expected over both states."""
        return np.asarray(1 - self.probability * (1 - NOISE_SCALE))

    def reported(self, moving: Kinematics, coasting: BoolArray) -> Kinematics:
        """Mean and covariance over both cases; positions where `coasting` (n,).

        moving: the joint filter's state, which has the detected positions
        """
        return Kinematics(*reported_moments(self.probability, coasting, *moving, self.position, self.P))


def after_evidence(probability: FloatArray, evidence: FloatArray, most_log_odds: float = _MOST_LOG_ODDS) -> FloatArray:
    """Probability (k,) after evidence (k,), the log of a ratio of likelihoods."""
    before = np.clip(probability, 1e-9, 1 - 1e-9)
    odds = np.clip(np.log(before / (1 - before)) + evidence, -most_log_odds, most_log_odds)
    return np.asarray(1 / (1 + np.exp(-odds)))


def log_density(innovation: FloatArray, S: FloatArray) -> FloatArray:
    """(k,) log N(innovation; 0, S) in the plane, up to a constant."""
    distance, log_det = mahalanobis_of_pairs(innovation, S)
    return np.asarray(-0.5 * (distance + log_det))
