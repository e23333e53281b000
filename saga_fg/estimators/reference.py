"""The textbook: Kalman filter and Rauch-Tung-Striebel smoother on dense joint states, as plain as they can be.

Everything else in the package is measured against these functions, in correctness and in speed (Bar-Shalom, Li,
Kirubarajan 2001, sections 5.2 and 8.6; Rauch, Tung, Striebel 1965).
"""

from typing import NamedTuple

import numpy as np

from saga_fg.numerics import FloatArray


class Gaussian(NamedTuple):
    """mean (D,), covariance (D, D)."""

    mean: FloatArray
    covariance: FloatArray


def kalman_predict(x: Gaussian, F: FloatArray, b: FloatArray, Q: FloatArray) -> Gaussian:
    """Prior of F x + b + q, q ~ N(0, Q)."""
    return Gaussian(F @ x.mean + b, F @ x.covariance @ F.T + Q)


def kalman_update(x: Gaussian, z: FloatArray, H: FloatArray, R: FloatArray) -> tuple[Gaussian, float]:
    """Posterior given z = H x + v, v ~ N(0, R) (Joseph form), and the log-likelihood of the innovation."""
    innovation = z - H @ x.mean
    S = H @ x.covariance @ H.T + R
    K = np.linalg.solve(S, H @ x.covariance).T
    I_KH = np.eye(len(x.mean)) - K @ H
    log_likelihood = -0.5 * (
        innovation @ np.linalg.solve(S, innovation) + np.linalg.slogdet(S)[1] + len(z) * np.log(2 * np.pi)
    )
    return Gaussian(x.mean + K @ innovation, I_KH @ x.covariance @ I_KH.T + K @ R @ K.T), float(log_likelihood)


def rts_smooth(filtered: list[Gaussian], predicted: list[Gaussian], F: list[FloatArray]) -> list[Gaussian]:
    """Smoothed marginals of every step.

    filtered[k] is the posterior after step k, predicted[k] and F[k] lead from filtered[k] to step k + 1 (both lists are
    one shorter). Nodes may come and go: F[k] is (D_{k+1}, D_k), with zero rows for a node that appears, whose prior is
    then part of predicted[k], and zero columns for one that leaves.
    """
    smoothed = [filtered[-1]]
    for k in range(len(F) - 1, -1, -1):
        G = np.linalg.solve(predicted[k].covariance, F[k] @ filtered[k].covariance).T
        mean = filtered[k].mean + G @ (smoothed[0].mean - predicted[k].mean)
        covariance = filtered[k].covariance + G @ (smoothed[0].covariance - predicted[k].covariance) @ G.T
        smoothed.insert(0, Gaussian(mean, covariance))
    return smoothed
