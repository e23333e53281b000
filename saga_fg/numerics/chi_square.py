"""Quantiles of the chi-square distribution: gates, and ellipses that hold a given share.

`scipy.stats` has them, too, and takes half a second to import, which every start of the command would pay.
"""

from __future__ import annotations

from scipy.special import gammaincinv


def chi_square_quantile(probability: float, degrees: float) -> float:
    """The value that a chi-square variable of so many degrees of freedom stays below with this probability."""
    return float(2 * gammaincinv(degrees / 2, probability))
