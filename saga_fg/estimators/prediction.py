"""What a prediction will be like, before it is made: where it lies, how large it is, how much of that is noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saga_fg.errors import InputError
from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.dynamics import Dynamics
from saga_fg.estimators.partition import Partition
from saga_fg.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Prediction:
    """The prior after an interval, roughly.

    components  what will be correlated
    mean        (D,), exact
    scale       (D,) standard deviations as if nodes were not correlated yet
    ratio       (n,) largest variance of a node's state in units of its process noise; infinite where it has none
    """

    components: Partition
    mean: FloatArray
    scale: FloatArray
    ratio: FloatArray

    @staticmethod
    def of(x: BlockGaussian, dynamics: Dynamics) -> Prediction:
        """Raises `InputError` where the prediction is not finite."""
        layout = x.layout
        own = {d: np.zeros((len(layout), d, d)) for d in np.unique(layout.dims).tolist()}
        predicted = {d: np.zeros_like(blocks) for d, blocks in own.items()}
        for d, blocks in own.items():
            rows = np.flatnonzero(layout.dims == d)
            blocks[rows] = x.covariances(rows)
        for F in dynamics.F:
            _, d_i, d_j = F.values.shape
            np.add.at(predicted[d_i], F.target, F.values @ own[d_j][F.source] @ np.swapaxes(F.values, 1, 2))
        ratio = np.full(len(layout), np.inf)
        for Q in dynamics.Q:
            d = Q.values.shape[1]
            predicted[d][Q.target] += Q.values
            ratio[Q.target] = _ratio(predicted[d][Q.target], Q.values)
        variances = np.empty(layout.size)
        for d, blocks in predicted.items():
            rows = np.flatnonzero(layout.dims == d)
            variances[layout.spans(rows)] = np.diagonal(blocks[rows], axis1=1, axis2=2)
        mean = dynamics.moved(x.mean) + dynamics.b
        if not (np.isfinite(mean).all() and np.isfinite(variances).all() and (variances > 0).all()):
            raise InputError("transition: the prediction is not finite, the dynamics grow beyond all numbers")
        return Prediction(dynamics.joined(x.partition), mean, np.sqrt(variances), ratio)


def _ratio(P: FloatArray, Q: FloatArray) -> FloatArray:
    """(m,) trace of Q^-1 P; infinite where Q is singular."""
    try:
        L = np.linalg.cholesky(Q)
    except np.linalg.LinAlgError:
        if len(Q) == 1:
            return np.array([np.inf])
        half = len(Q) // 2
        return np.concatenate([_ratio(P[:half], Q[:half]), _ratio(P[half:], Q[half:])])
    half_done = np.linalg.solve(L, P)
    return np.asarray(np.trace(np.linalg.solve(L, np.swapaxes(half_done, 1, 2)), axis1=1, axis2=2))
