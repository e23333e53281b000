r"""Score calibration: the logistic model of the probability that a detection with a given score is true.

    logit P(true) = offset + slope s,   s the logit of the score        maximum likelihood, with two weak priors:
    slope ~ N(1, 1), offset ~ N(0, 1.5^2)                               for classes with few detections

Source: Platt, Probabilistic outputs for support vector machines, 1999. Solved by Newton's method.
"""

from __future__ import annotations

import numpy as np

from saga_fg.model.sensor import ScoreCalibration
from saga_fg.numerics.arrays import BoolArray, FloatArray

PRIOR_MEAN = np.array([0.0, 1.0])  # offset, slope
PRIOR_PRECISION = np.array([1 / 1.5**2, 1.0])
LEAST_SLOPE = 0.05  # a falling calibration is taken for one without information


def fit_score_calibration(
    logit: FloatArray, true: BoolArray, prior: ScoreCalibration | None = None
) -> ScoreCalibration:
    """The most probable calibration of detections with these logits of their scores (N,), true or not (N,).

    prior: for classes with few detections, in place of the identity.
    """
    mean = PRIOR_MEAN if prior is None else np.array([prior.offset, prior.slope])
    X = np.column_stack([np.ones(len(logit)), logit])
    y = np.asarray(true, dtype=np.float64)
    beta = mean.copy()
    for _ in range(100):
        p = 1 / (1 + np.exp(-np.clip(X @ beta, -50, 50)))
        gradient = X.T @ (y - p) - PRIOR_PRECISION * (beta - mean)
        hessian = X.T @ (X * (p * (1 - p))[:, None]) + np.diag(PRIOR_PRECISION)
        step = np.linalg.solve(hessian, gradient)
        beta = beta + step * min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-9:
            break
    return ScoreCalibration(slope=max(float(beta[1]), LEAST_SLOPE), offset=float(beta[0]))
