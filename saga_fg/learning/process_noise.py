r"""Process noise of constant-velocity motion by maximum likelihood.

    q* = argmax_q  sum over objects and times of  log N( z - H m ; 0, H P H^T + R )

m and P are the prediction of the object's own Kalman filter with the acceleration's spectral density q (the prediction
error decomposition; Harvey 1989, section 3.4). All objects are filtered side by side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.optimize import minimize_scalar

from saga_fg.errors import InputError
from saga_fg.model.motion import ConstantVelocity
from saga_fg.numerics.arrays import FloatArray, IntArray, checked
from saga_fg.types.by_class import DEFAULT

FEWEST_OBJECTS = 10  # a class with fewer has the noise of all objects together
WRONG_REACH = 4.0  # m


@dataclass(frozen=True, eq=False)
class MeasuredTrajectory:
    """Measured positions of one object: time (T,) s, not decreasing; position (T, 2) m; R (T, 2, 2) m^2.

    yaw, yaw_noise  (T,) rad, measured headings and their standard deviations, NaN where unknown: everywhere if left out
    """

    time: FloatArray
    position: FloatArray
    R: FloatArray
    yaw: FloatArray = None  # type: ignore[assignment]  # an array from construction on
    yaw_noise: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        time = checked("time", self.time, (None,))
        if (np.diff(time) < 0).any():
            raise InputError(f"time[{int(np.argmax(np.diff(time) < 0)) + 1}]: expected times that do not decrease")
        position, R = checked("position", self.position, (len(time), 2)), checked("R", self.R, (len(time), 2, 2))
        vars(self).update(time=time, position=position, R=R)
        for name in ("yaw", "yaw_noise"):
            given = getattr(self, name)
            vars(self)[name] = np.full(len(time), np.nan) if given is None else np.asarray(given, dtype=np.float64)

    def __len__(self) -> int:
        return len(self.time)

    def pieces(self, longest: int) -> list[Self]:
        """Cut into pieces of about the same length, of at most `longest` measurements."""
        parts = np.array_split(np.arange(len(self)), math.ceil(len(self) / longest))
        columns = (self.time, self.position, self.R, self.yaw, self.yaw_noise)
        return [type(self)(*(column[rows] for column in columns)) for rows in parts]


def fit_acceleration_noise(
    objects: Sequence[MeasuredTrajectory],
    initial_speed_deviation: float = 10.0,
    bounds: tuple[float, float] = (1e-4, 1e2),
) -> float:
    """The most likely `ConstantVelocity.acceleration_noise`, m^2/s^3, of some objects.

    initial_speed_deviation: standard deviation of a velocity component before the second measurement, m/s.
    Raises `InputError` when no object was seen at least three times.
    """
    useful = [o for o in objects if len(o) >= 3]
    if not useful:
        raise InputError("objects: expected at least one object seen three times or more")
    low, high = np.log(bounds)
    found = minimize_scalar(
        lambda log_q: -log_likelihood(useful, float(np.exp(log_q)), initial_speed_deviation),
        bounds=(low, high),
        method="bounded",
    )
    return float(np.exp(found.x))


def fit_acceleration_noise_by_class(objects: Mapping[str, Sequence[MeasuredTrajectory]]) -> dict[str, float]:
    """The acceleration noise, m^2/s^3, of each class with at least ten objects, and of all together as `default`.

    Raises `InputError` when no object was seen at least three times.
    """
    noise = {DEFAULT: fit_acceleration_noise([found for same in objects.values() for found in same])}
    for label, same in sorted(objects.items()):
        if sum(len(found) >= 3 for found in same) >= FEWEST_OBJECTS:
            noise[label] = fit_acceleration_noise(same)
    return noise


def log_likelihood(
    objects: Sequence[MeasuredTrajectory], acceleration_noise: float, initial_speed_deviation: float = 10.0
) -> float:
    """Log-likelihood of all measurements but each object's first, under independent constant-velocity motion."""
    order = sorted(objects, key=len, reverse=True)
    columns = [np.concatenate([getattr(o, name) for o in order]) for name in ("time", "position", "R")]
    return innovation_likelihood(
        np.array([len(o) for o in order]),
        columns[0],
        columns[1],
        columns[2],
        acceleration_noise,
        initial_speed_deviation,
    )


def innovation_likelihood(
    lengths: IntArray,
    time: FloatArray,
    position: FloatArray,
    R: FloatArray,
    acceleration_noise: float,
    initial_speed_deviation: float,
    wrong: float = 0.0,
) -> float:
    """Log-likelihood of all measurements but each object's first, of objects of these lengths (n,), the longest first.

    time (N,), position (N, 2) and R (N, 2, 2) hold one object after another. wrong: share of measurements that are of
    something else, anywhere within `WRONG_REACH`; a measurement that is more likely one of those does not update.
    """
    start = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    diffusion = ConstantVelocity(acceleration_noise).diffusion[2:, 2:]
    mean = np.zeros((len(lengths), 4))
    mean[:, :2] = position[start]
    P = np.zeros((len(lengths), 4, 4))
    P[:, :2, :2] = R[start]
    P[:, 2:, 2:] = initial_speed_deviation**2 * np.eye(2)
    anything = wrong / (math.pi * WRONG_REACH**2)
    total = 0.0
    for k in range(1, int(lengths[0])):
        n = int((lengths > k).sum())  # objects seen again: the longest come first
        at = start[:n] + k
        dt = (time[at] - time[at - 1])[:, None, None]
        F = np.tile(np.eye(4), (n, 1, 1))
        F[:, :2, 2:] = dt * np.eye(2)
        Q = np.zeros((n, 4, 4))
        Q[:, :2, :2], Q[:, 2:, 2:] = dt**3 / 3 * diffusion, dt * diffusion
        Q[:, :2, 2:] = Q[:, 2:, :2] = dt**2 / 2 * diffusion
        m, P_n = (F @ mean[:n, :, None])[..., 0], F @ P[:n] @ np.swapaxes(F, 1, 2) + Q
        S = P_n[:, :2, :2] + R[at]
        innovation = position[at] - m[:, :2]
        gain = np.swapaxes(np.linalg.solve(S, P_n[:, :2, :]), 1, 2)
        whitened = np.linalg.solve(S, innovation[:, :, None])[..., 0]
        log_density = -0.5 * ((innovation * whitened).sum(axis=1) + np.log(np.linalg.det(S)) + 2 * np.log(2 * np.pi))
        if wrong:
            right = math.log(1 - wrong) + log_density
            gain[right < math.log(anything)] = 0.0
            log_density = np.logaddexp(right, math.log(anything))
        total += float(log_density.sum())
        mean[:n] = m + (gain @ innovation[:, :, None])[..., 0]
        P[:n] = P_n - gain @ P_n[:, :2, :]
    return total
