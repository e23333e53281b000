"""Agreement of an estimated and a true grouping of observations: pairwise precision, recall and F1.

    precision = pairs joined in both / pairs joined in the estimate,     recall = pairs joined in both / ... in truth
    F1 = 2 precision recall / (precision + recall)

over all pairs of observations. Names of groups have no influence. Source: Manning, Raghavan and Schuetze,
Introduction to Information Retrieval, 2008, section 16.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Agreement(NamedTuple):
    """Precision and recall are 1 without pairs in their denominator."""

    precision: float
    recall: float
    f1: float


def pairwise_agreement(estimated: ArrayLike, true: ArrayLike) -> Agreement:
    """The agreement of two groupings (n,), given as the group of each observation."""
    groups, truth = np.asarray(estimated), np.asarray(true)
    common, claimed, actual = (_pairs(table) for table in (np.stack([groups, truth]), groups[None], truth[None]))
    precision = common / claimed if claimed else 1.0
    recall = common / actual if actual else 1.0
    return Agreement(precision, recall, 2 * precision * recall / max(precision + recall, 1e-300))


def _pairs(groups: np.ndarray) -> float:
    """Number of pairs of equal columns (k, n)."""
    counts = np.unique(groups, axis=1, return_counts=True)[1]
    return float((counts * (counts - 1) // 2).sum())
