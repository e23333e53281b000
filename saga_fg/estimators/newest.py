"""What every estimator answers whose newest state is a Gaussian by components."""

from __future__ import annotations

from numpy.typing import ArrayLike

from saga_fg.estimators.block_gaussian import BlockGaussian
from saga_fg.estimators.layout import Layout
from saga_fg.numerics.arrays import FloatArray, IntArray


class NewestMarginals:
    """Marginals of the nodes that are there now. See `saga_fg.estimators.protocol.Estimator` for the methods."""

    def mean(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        mean: FloatArray = x.mean[x.layout.spans(rows)]
        return mean

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        x.layout.spans(rows)  # states of equal size, or an error that says so
        return x.covariances(rows)

    def joint_mean(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        mean: FloatArray = x.mean[x.layout.places(rows)]
        return mean

    def joint_covariance(self, nodes: ArrayLike) -> FloatArray:
        x, rows = self._at(nodes)
        return x.joint(rows)

    def _at(self, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
        """A Gaussian, and which of its rows are these nodes."""
        raise NotImplementedError


def live_rows(x: BlockGaussian, live: Layout, nodes: ArrayLike) -> tuple[BlockGaussian, IntArray]:
    """A Gaussian that may have nodes which have gone since, and which of its rows are `nodes`."""
    rows = live.rows(nodes)
    return x, rows if len(live) == len(x.layout) else x.layout.rows(live.nodes[rows])
