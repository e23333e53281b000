"""What a smoother answers: the marginals of a moment's nodes, given everything measured before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.estimators.backward import MarginalCovariances, SmoothedCovariance
from saga_fg.estimators.layout import Layout
from saga_fg.estimators.recording import Recording
from saga_fg.numerics.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The nodes of a moment, those that go afterwards too. The methods are those of `Estimator`.

    time (s, on the estimator's clock); layout of the joint state; state (D,) its smoothed mean; P its covariance,
    None where only means were asked for.
    """

    time: float
    layout: Layout
    state: FloatArray
    P: SmoothedCovariance | MarginalCovariances | None = None

    @property
    def nodes(self) -> IntArray:
        """(n,) ids in the order of the joint state."""
        return self.layout.nodes

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, d) means of nodes of equal size d."""
        return np.asarray(self.state[self.layout.spans(self.layout.rows(nodes))])

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, d, d) marginal covariances of nodes of equal size d."""
        rows = self.layout.rows(nodes)
        self.layout.spans(rows)
        return self._covariance().blocks(rows)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        """Stacked mean of some nodes, in the order given, of any sizes."""
        return np.asarray(self.state[self.layout.places(self.layout.rows(nodes))])

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        """Joint covariance of some nodes, in the order given, of any sizes."""
        return self._covariance().joint(self.layout.rows(nodes))

    def _covariance(self) -> SmoothedCovariance | MarginalCovariances:
        if self.P is None:
            raise InputError("covariances: only means were smoothed; ask for covariances")
        return self.P


def smoothed_moments(recording: Recording, covariances: bool, joint: bool) -> tuple[Smoothed, ...]:
    """Every moment of a recording, oldest first."""
    means = recording.means()
    P = recording.covariances(joint) if covariances else [None] * len(means)
    return tuple(
        Smoothed(moment.time, layout, mean, covariance)
        for moment, layout, mean, covariance in zip(recording.moments, recording.layouts, means, P, strict=True)
    )
