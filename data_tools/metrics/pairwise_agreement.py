"""Agreement of an estimated and a true grouping of observations: pairwise precision, recall and F1.

    precision = pairs joined in both / pairs joined in the estimate,     recall = pairs joined in both / ... in truth
    F1 = 2 precision recall / (precision + recall)

over all pairs of observations. Names of groups have no influence. Source: Manning, Raghavan and Schuetze,
Introduction to Information Retrieval, 2008, section 16.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.numerics.arrays import IntArray, checked_rows


@dataclass(frozen=True)
class PairwiseAgreement:
    """precision, recall, f1; precision and recall are 1 without pairs in their denominator."""

    precision: float
    recall: float
    f1: float


def pairwise_agreement(estimated: ArrayLike, true: ArrayLike) -> PairwiseAgreement:
    """The agreement of two groupings (n,), given as the group of each observation.

    Raises `InputError` for groupings of different lengths.
    """
    groups = checked_rows("estimated", estimated)
    truth = checked_rows("true", true, len(groups))
    both = np.unique(np.stack([groups, truth], axis=1), axis=0, return_counts=True)[1]
    common, claimed, actual = _pairs(both), _pairs(_counts(groups)), _pairs(_counts(truth))
    precision = common / claimed if claimed else 1.0
    recall = common / actual if actual else 1.0
    return PairwiseAgreement(precision, recall, 2 * precision * recall / max(precision + recall, 1e-300))


def _counts(groups: IntArray) -> IntArray:
    return np.unique(groups, return_counts=True)[1].astype(np.int64)


def _pairs(counts: IntArray) -> float:
    return float((counts * (counts - 1) // 2).sum())
