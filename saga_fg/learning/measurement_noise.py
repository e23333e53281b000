r"""Measurement noise from known errors: the sensor's noise model by robust maximum likelihood.

    (along, across) ~ (1 - e) N(0, f^2 (position^2 + (range_noise r)^2)) N(0, f^2 (position^2 + (bearing_noise r)^2))
                      + e / (area of the gate),                  f = 1 + low_score_growth (1 - p)

The uniform part models wrong matches. All parameters are positive and are estimated as logarithms; a normal prior of
width 1 about the values of all classes decides where there is little data.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from saga_fg.errors import InputError
from saga_fg.model.sensor import NoiseModel
from saga_fg.numerics.arrays import FloatArray

PRIOR = NoiseModel(position=0.2, range_noise=0.005, bearing_noise=0.005, low_score_growth=0.3)
PRIOR_WIDTH = 1.0  # of the logarithms
WRONG = 0.05  # share of wrong matches expected
POSITION = ("position", "range_noise", "bearing_noise", "low_score_growth")
LEAST = 1e-4  # smaller parameters count as zero
NINE_IN_TEN = 1.6448536269514722  # standard deviations of a normal distribution
FEWEST = 10  # errors, for a standard deviation


def fit_position_noise(
    along: FloatArray,
    across: FloatArray,
    distance: FloatArray,
    probability: FloatArray,
    gate: float,
    prior: NoiseModel = PRIOR,
) -> NoiseModel:
    """`prior` with the most probable noise of positions whose errors (N,), m, and ranges (N,), m, are these.

    probability (N,): calibrated scores; gate: the largest error a match may have, m. Raises `InputError` for no error.
    """
    if len(along) == 0:
        raise InputError("along: expected at least one error")
    start = np.log([max(getattr(prior, name), LEAST) for name in POSITION])
    spread = 1 - probability

    odds = math.log(WRONG / (1 - WRONG))

    def cost(theta: FloatArray) -> float:
        position, range_noise, bearing_noise, low_score_growth = np.exp(theta[:4])
        wrong = 1 / (1 + math.exp(-theta[4]))
        f = 1 + low_score_growth * spread
        var_along = (f**2) * (position**2 + (range_noise * distance) ** 2)
        var_across = (f**2) * (position**2 + (bearing_noise * distance) ** 2)
        density = np.exp(-0.5 * (along**2 / var_along + across**2 / var_across)) / (
            2 * np.pi * np.sqrt(var_along * var_across)
        )
        likelihood = np.log((1 - wrong) * density + wrong / (np.pi * gate**2))
        penalty = 0.5 * (((theta[:4] - start) / PRIOR_WIDTH) ** 2).sum() + 0.5 * (theta[4] - odds) ** 2
        return float(penalty - likelihood.sum()) / len(along)

    bounds = [(math.log(LEAST), math.log(30.0))] * 4 + [(-7.0, 1.0)]
    found = min(
        (
            minimize(cost, np.append(first, odds), method="L-BFGS-B", bounds=bounds)
            for first in (start, *_starts(prior))
        ),
        key=lambda result: float(result.fun),
    )
    fitted = {name: float(value) for name, value in zip(POSITION, np.exp(found.x[:4]), strict=True)}
    return replace(prior, **fitted)


def _starts(prior: NoiseModel) -> list[FloatArray]:
    """Starts near a good and near a poor sensor (logarithms): the cost also has a minimum with all matches wrong."""
    low = max(prior.low_score_growth, 0.1)
    return [np.log([0.1, 0.005, 0.005, low]), np.log([0.3, 0.03, 0.01, low])]


def robust_deviation(errors: FloatArray) -> float:
    """Standard deviation of the errors (N,), NaN left out, by the 90 % quantile.

    NaN for less than ten errors. Errors of velocity and heading have long tails, which a median would ignore.
    """
    known = errors[np.isfinite(errors)]
    return float(np.quantile(np.abs(known), 0.9)) / NINE_IN_TEN if len(known) >= FEWEST else math.nan
