r"""Process noise of constant-velocity motion by maximum likelihood.

    q* = argmax_q  sum over objects and times of  log N( z - H m ; 0, H P H^T + R )

m and P are the prediction of the object's own Kalman filter with the acceleration's spectral density q (the prediction
error decomposition; Harvey 1989, section 3.4). All objects are filtered side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from saga_fg.arrays import FloatArray, checked
from saga_fg.errors import InputError
from saga_fg.node import ConstantVelocity


@dataclass(frozen=True, eq=False)
class Sightings:
    """Measured positions of one object: time (T,) s, not decreasing; position (T, 2) m; R (T, 2, 2) m^2."""

    time: FloatArray
    position: FloatArray
    R: FloatArray

    def __post_init__(self) -> None:
        time = checked("time", self.time, (None,))
        if (np.diff(time) < 0).any():
            raise InputError(f"time[{int(np.argmax(np.diff(time) < 0)) + 1}]: expected times that do not decrease")
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "position", checked("position", self.position, (len(time), 2)))
        object.__setattr__(self, "R", checked("R", self.R, (len(time), 2, 2)))

    def __len__(self) -> int:
        return len(self.time)


def fit_acceleration_noise(
    objects: Sequence[Sightings], birth_speed: float = 10.0, bounds: tuple[float, float] = (1e-4, 1e2)
) -> float:
    """The most likely `ConstantVelocity.acceleration_noise`, m^2/s^3, of some objects.

    birth_speed: standard deviation of a velocity component before the second sighting, m/s. Raises `InputError` when
    no object was seen at least three times.
    """
    useful = [o for o in objects if len(o) >= 3]
    if not useful:
        raise InputError("objects: expected at least one object seen three times or more")
    low, high = np.log(bounds)
    found = minimize_scalar(
        lambda log_q: -log_likelihood(useful, float(np.exp(log_q)), birth_speed), bounds=(low, high), method="bounded"
    )
    return float(np.exp(found.x))


def log_likelihood(objects: Sequence[Sightings], acceleration_noise: float, birth_speed: float = 10.0) -> float:
    """Log-likelihood of all sightings but each object's first, under independent constant-velocity motion."""
    order = sorted(objects, key=len, reverse=True)
    count = np.array([len(o) for o in order])
    diffusion = ConstantVelocity(acceleration_noise).diffusion[2:, 2:]
    mean = np.zeros((len(order), 4))
    mean[:, :2] = [o.position[0] for o in order]
    P = np.zeros((len(order), 4, 4))
    P[:, :2, :2] = [o.R[0] for o in order]
    P[:, 2:, 2:] = birth_speed**2 * np.eye(2)
    total = 0.0
    for k in range(1, int(count[0])):
        n = int((count > k).sum())  # objects seen again: the longest come first
        dt = np.array([o.time[k] - o.time[k - 1] for o in order[:n]])[:, None, None]
        z, R = np.array([o.position[k] for o in order[:n]]), np.array([o.R[k] for o in order[:n]])
        F = np.tile(np.eye(4), (n, 1, 1))
        F[:, :2, 2:] = dt * np.eye(2)
        Q = np.zeros((n, 4, 4))
        Q[:, :2, :2], Q[:, 2:, 2:] = dt**3 / 3 * diffusion, dt * diffusion
        Q[:, :2, 2:] = Q[:, 2:, :2] = dt**2 / 2 * diffusion
        m, P_n = (F @ mean[:n, :, None])[..., 0], F @ P[:n] @ np.swapaxes(F, 1, 2) + Q
        S = P_n[:, :2, :2] + R
        innovation = z - m[:, :2]
        gain = np.swapaxes(np.linalg.solve(S, P_n[:, :2, :]), 1, 2)
        whitened = np.linalg.solve(S, innovation[:, :, None])[..., 0]
        total -= 0.5 * float((innovation * whitened).sum() + np.log(np.linalg.det(S)).sum() + 2 * n * np.log(2 * np.pi))
        mean[:n] = m + (gain @ innovation[:, :, None])[..., 0]
        P[:n] = P_n - gain @ P_n[:, :2, :]
    return total
