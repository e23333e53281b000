"""What is filtered track by track beside the joint state: box, turn rate, stationarity.

Size, height and heading of tracks, which the graph does not couple, filtered track by track.

size      running mean weighted by detection probability
height    scalar Kalman filter, random walk
heading   scalar Kalman filter on the circle, random walk; a detector's heading may be off by half a turn, so that a
          measurement is first turned to the side of the estimate. The detections vote on which side is the front,
          each with its probability, and a clear motion decides

Turn rates of tracks from their measured headings, each estimated by itself beside the joint state.

    h' = h + w tau (1 - exp(-dt / tau)),   w' = w exp(-dt / tau) + noise of the stationary deviation sigma
    heading z = h + v,   v ~ N(0, r^2),   S = max(P_h + r^2, (z - h)^2 / 4)

S is the variance of the innovation z - h; beyond twice its expected deviation a heading is an outlier and counts less.

A heading may be off by half a turn, and is turned to the side of the estimate. Most objects go straight most of the
time, while w is noise. So what is predicted with is the mean of w, and its variance, under the prior that a share of
objects turns, `Curvilinear.turning_share`:

    w_known = w ( g sigma_t^2 / (P + sigma_t^2) + (1 - g) sigma_s^2 / (P + sigma_s^2) ),   g = P(turns | w)

with sigma_t the deviation of the rates of those that turn, sigma_s of the others. Sources: Singer (1970) for the
first-order decay; Huber (1981) for the weights; the shrinkage is the posterior mean under a mixture of two Gaussians.

Stationary or moving: a discrete state of every track beside its Gaussian one, and its use.

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
from typing import NamedTuple

import numpy as np

from saga_fg.kernels.paths import known_turning, predicted_turning, updated_turning
from saga_fg.kernels.tracks import (
    faced_boxes,
    predicted_places,
    reported_moments,
    turned_headings,
    updated_boxes,
    updated_places,
)
from saga_fg.numerics import (
    BoolArray,
    Columns,
    FloatArray,
    IntArray,
    inverse_transform,
    mahalanobis_of_pairs,
    transform_points,
)
from saga_fg.types import MAX_POSITION, MAX_SPEED, speed_deviation


class Kinematics(NamedTuple):
    """Position (n, 2) and velocity (n, 2) of n tracks and their covariances (n, 2, 2); 0 for the velocity of fixed
    nodes."""

    position: FloatArray
    velocity: FloatArray
    P: FloatArray
    P_velocity: FloatArray

    def select(self, rows: IntArray) -> Kinematics:
        """The tracks `rows` (k,)."""
        x, v, P, P_v = self
        return Kinematics(x.take(rows, 0), v.take(rows, 0), P.take(rows, 0), P_v.take(rows, 0))

    def append(self, other: Kinematics) -> Kinematics:
        """With the tracks of another after these."""
        return Kinematics(*[np.concatenate(columns) for columns in zip(self, other, strict=True)])

    @property
    def speed_deviation(self) -> FloatArray:
        """(n,) standard deviation of the velocity in a mean direction, m/s."""
        return speed_deviation(self.P_velocity)

    @property
    def deviation(self) -> FloatArray:
        """(n,) standard deviation of the position in the direction in which it is largest, m."""
        middle, half = (self.P[:, 0, 0] + self.P[:, 1, 1]) / 2, (self.P[:, 0, 0] - self.P[:, 1, 1]) / 2
        return np.asarray(np.sqrt(middle + np.hypot(half, self.P[:, 0, 1])))

    def within_limits(self, origin: FloatArray) -> BoolArray:
        """(n,) which states are finite and inside the limits of detections; positions are from `origin` (2,).

        Means and standard deviations have to be within `MAX_POSITION` and `MAX_SPEED`, variances of positions above 0,
        of velocities at least 0. NaN never is within.
        """
        P, P_velocity = (np.diagonal(C, axis1=1, axis2=2) for C in (self.P, self.P_velocity))
        placed = (np.abs(self.position + origin) <= MAX_POSITION) & (P > 0) & (P <= MAX_POSITION**2)
        slow = (np.abs(self.velocity) <= MAX_SPEED) & (P_velocity >= 0) & (P_velocity <= MAX_SPEED**2)
        return np.asarray((placed & slow).all(axis=1))


@dataclass(frozen=True, eq=False)
class RelativePositions(Columns):
    """m positions (m, 3) in the vehicle's frame, m, with covariances (m, 2, 2) in its axes, m^2."""

    z: FloatArray
    R: FloatArray

    @classmethod
    def from_world(cls, world_T_ego: FloatArray, position: FloatArray, R: FloatArray) -> RelativePositions:
        """Transform positions (m, 3) and covariances (m, 2, 2) in the world into the frame of a pose."""
        turn = world_T_ego[:2, :2]
        return cls(transform_points(inverse_transform(world_T_ego), position), turn.T @ R @ turn)


HEIGHT_DRIFT = 0.1  # standard deviation after one second, m
MOVING = 2.0  # speed from which the motion tells front from rear, m/s
MAX_WEIGHT = 20.0  # limit on the weight of past sizes
MAX_VOTES = 5.0  # limit on the past votes, so that later ones can outvote them


@dataclass(eq=False)
class BoxFilter(Columns):
    """Columns over n tracks: size (n, 3), size_weight, z, z_variance, yaw, yaw_variance, votes (n,); NaN is unknown.

    votes: probability-weighted votes for the front at yaw less those against it; >= 0
    """

    size: FloatArray
    size_weight: FloatArray
    z: FloatArray
    z_variance: FloatArray
    yaw: FloatArray
    yaw_variance: FloatArray
    votes: FloatArray

    @classmethod
    def empty(cls) -> BoxFilter:
        none = np.empty(0)
        return cls(np.empty((0, 3)), none, none, none, none, none, none)

    @classmethod
    def initiated(
        cls,
        size: FloatArray,
        weight: FloatArray,
        z: FloatArray,
        z_noise: FloatArray,
        yaw: FloatArray,
        yaw_noise: FloatArray,
    ) -> BoxFilter:
        """Return the filters of new tracks from their first detections; noises are standard deviations."""
        known = np.isfinite(size).all(axis=1)
        votes = np.where(np.isfinite(yaw), weight, 0.0)
        return cls(size.copy(), np.where(known, weight, 0.0), z.copy(), z_noise**2, yaw.copy(), yaw_noise**2, votes)

    def predict(self, dt: float, yaw_drift: FloatArray) -> None:
        """Predict by `dt` s; yaw_drift (n,), rad after one second."""
        self.z_variance = self.z_variance + HEIGHT_DRIFT**2 * dt
        self.yaw_variance = self.yaw_variance + yaw_drift**2 * dt

    def update(
        self,
        rows: IntArray,
        size: FloatArray,
        weight: FloatArray,
        z: FloatArray,
        z_noise: FloatArray,
        yaw: FloatArray,
        yaw_noise: FloatArray,
    ) -> None:
        """Take in one detection each for the tracks `rows` (k,)."""
        later = updated_boxes(
            size=self.size,
            size_weight=self.size_weight,
            z=self.z,
            z_variance=self.z_variance,
            yaw=self.yaw,
            yaw_variance=self.yaw_variance,
            votes=self.votes,
            rows=rows,
            seen_size=size,
            weight=weight,
            seen_z=z,
            z_noise=z_noise,
            seen_yaw=yaw,
            yaw_noise=yaw_noise,
            most_weight=MAX_WEIGHT,
            most_votes=MAX_VOTES,
        )
        now = self.size, self.size_weight, self.z, self.z_variance, self.yaw, self.yaw_variance, self.votes
        for column, values in zip(now, later, strict=True):
            column[rows] = values

    def face_motion(self, velocity: FloatArray) -> None:
        """Reverse headings that point against a clear motion; velocity (n, 2), zero where it is not clear."""
        self.yaw, self.votes = faced_boxes(self.yaw, self.votes, velocity, MOVING, MAX_VOTES)

    def turn_with(self, before: FloatArray, after: FloatArray, coasting: BoolArray) -> None:
        """Turn the headings of moving, `coasting` (n,) tracks as their velocities (n, 2) turn in a prediction.

        Headings of detected tracks are left to their measurements, which are better than the course of neighbours.
        """
        self.yaw = turned_headings(self.yaw, before, after, coasting, MOVING)


DEVIATION = 0.15  # rad/s, stationary standard deviation of a rate: a bend of 50 m at 7 m/s
TURNING = 0.3  # rad/s, deviation of their rates: a crossing is a quarter turn in some 5 s
STRAIGHT = 0.01  # rad/s, deviation of the others' rates: corrections within the lane
_MIN_TIME = 1e-3  # s, so that a fading time of 0 divides nothing by 0: the rate is gone at once
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
        self.heading, self.rate, self.P = predicted_turning(
            self.heading, self.rate, self.P, dt, fading_time, DEVIATION, _MIN_TIME
        )

    def update(self, rows: IntArray, yaw: FloatArray, yaw_noise: FloatArray) -> None:
        """Take in one heading each of the tracks `rows` (k,); NaN is none."""
        now = updated_turning(self.heading, self.rate, self.P, rows, yaw, yaw_noise, OUTLIER)
        self.heading[rows], self.rate[rows], self.P[rows] = now

    def known(self, rows: IntArray, turning_share: float) -> tuple[FloatArray, FloatArray]:
        """Turn rates of tracks `rows` (k,) to predict with, rad/s, and their variances (k,)."""
        share = min(max(turning_share, 1e-9), 1 - 1e-9)
        return known_turning(self.rate, self.P, rows, share, TURNING, STRAIGHT)


HALTING_SPEED = 1.0  # m/s, scale of the speeds from which an object comes to rest at once: walking, or the last metre
_MAX_LOG_ODDS = 12.0  # so that later evidence can still change the probability
NOISE_SCALE = 0.05  # factor on the process noise of a stationary object
START_RATE = 0.02  # 1/s, of stationary objects that start; to 0.1
STOP_RATE = 0.05  # 1/s, of slow ones that halt; to 0.1
DRIFT = 0.02  # m, usual 0 to 0.1, standard deviation of the drift of a stationary position in one second


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

    def predict(self, dt: float, moving: Kinematics) -> None:
        """Predict by `dt` s; `moving` is the joint filter's state before."""
        self.probability, self.position, self.P = predicted_places(
            s=self.probability,
            place=self.position,
            D=self.P,
            position=moving.position,
            velocity=moving.velocity,
            P=moving.P,
            P_velocity=moving.P_velocity,
            dt=dt,
            start=START_RATE,
            stop=STOP_RATE,
            drift=DRIFT,
            halting_speed=HALTING_SPEED,
        )

    def update(
        self, rows: IntArray, z: FloatArray, R: FloatArray, moving: Kinematics, with_velocity: BoolArray
    ) -> None:
        """Take in one detection each for the tracks `rows` (k,).

        z (k, 4) position and velocity, R (k, 4, 4); `moving`: the joint filter's prediction of these tracks
        """
        if len(rows):
            self.probability[rows], self.position[rows], self.P[rows] = updated_places(
                s=self.probability,
                place=self.position,
                D=self.P,
                rows=rows,
                z=z,
                R=R,
                position=moving.position,
                velocity=moving.velocity,
                P=moving.P,
                P_velocity=moving.P_velocity,
                with_velocity=with_velocity,
                most_log_odds=_MAX_LOG_ODDS,
            )

    @property
    def noise_scale(self) -> FloatArray:
        """(n,) factor on the process noise, expected over both states."""
        return np.asarray(1 - self.probability * (1 - NOISE_SCALE))

    def reported(self, moving: Kinematics, coasting: BoolArray) -> Kinematics:
        """Mean and covariance over both cases; positions where `coasting` (n,).

        moving: the joint filter's state, which has the detected positions
        """
        found = reported_moments(
            s=self.probability,
            unseen=coasting,
            position=moving.position,
            velocity=moving.velocity,
            P=moving.P,
            P_velocity=moving.P_velocity,
            place=self.position,
            D=self.P,
        )
        return Kinematics(*found)


def after_evidence(probability: FloatArray, evidence: FloatArray) -> FloatArray:
    """Probability (k,) after evidence (k,), the log of a ratio of likelihoods."""
    before = np.clip(probability, 1e-9, 1 - 1e-9)
    odds = np.clip(np.log(before / (1 - before)) + evidence, -_MAX_LOG_ODDS, _MAX_LOG_ODDS)
    return np.asarray(1 / (1 + np.exp(-odds)))


def log_density(innovation: FloatArray, S: FloatArray) -> FloatArray:
    """(k,) log N(innovation; 0, S) in the plane, up to a constant."""
    distance, log_det = mahalanobis_of_pairs(innovation, S)
    return np.asarray(-0.5 * (distance + log_det))
