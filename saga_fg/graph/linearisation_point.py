"""Linearisation points of factors: the value of every variable, and its increment from the base.

A factor linearised at x says || J delta' + r || of the increment delta' from x. Counted from the base, with delta_0 the
increment of x and D the derivative of `saga_fg.graph.variables`,

    delta' = D (delta - delta_0),      || (J D) delta - (J D delta_0 - r) ||

so that factors linearised at different points speak of the same unknowns: exact for vectors, and for poses exact at x,
with the gradient and the covariance that factors linearised there have in GTSAM's own coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from factors import FactorError, Vector
from factors.gaussian import native_factor
from saga_fg.graph.variables import GraphVariable, transport
from saga_fg.numerics.arrays import FloatArray

LARGEST = 1e30  # of whitened numbers, whose squares numbers can hold


class LinearisationPoint:
    """values: where; base: of the variables of the graph. Both are read, never changed."""

    def __init__(self, variables: Mapping[int, GraphVariable], base: gtsam.Values, values: gtsam.Values) -> None:
        self.variables, self.base, self.values = variables, base, values
        self._vectors: dict[int, FloatArray] = {}
        self._transports: dict[int, FloatArray | None] = {}

    def base_vector(self, key: int) -> FloatArray:
        """The base (d,) of a vector."""
        if key not in self._vectors:
            self._vectors[key] = self.base.atVector(key)
        return self._vectors[key]

    def increment(self, key: int) -> FloatArray:
        """The increment (d,) of a variable from its base."""
        kind = self.variables[key].type
        return kind.local(kind.read(self.base, key), kind.read(self.values, key))

    def transport(self, key: int) -> FloatArray | None:
        """D (d, d) of a variable, None for the identity."""
        if key not in self._transports:
            kind = self.variables[key].type
            base = None if isinstance(kind, Vector) else kind.read(self.base, key)
            self._transports[key] = None if base is None else transport(kind, base, self.increment(key))
        return self._transports[key]

    def transported(self, keys: Sequence[int], P: FloatArray) -> FloatArray:
        """A joint covariance of variables, counted from the base, in the coordinates of where they are."""
        P, start = P.copy(), 0
        for key in keys:
            span, D = slice(start, start + self.variables[key].dim), self.transport(key)
            if D is not None:
                P[span] = D @ P[span]
                P[:, span] = P[:, span] @ D.T
            start = span.stop
        return P

    def dims(self, keys: Sequence[int]) -> list[int]:
        """Dimensions of variables."""
        return [self.variables[key].dim for key in keys]

    def from_base(self, keys: Sequence[int], augmented: FloatArray) -> gtsam.JacobianFactor:
        """A factor [J | -r] (m, sum(d) + 1), whitened, on increments from the values, on those from the base.

        Raises `FactorError` for other columns than the variables have dimensions, and numbers that are not finite.
        """
        result = np.array(augmented, order="F")
        dims = self.dims(keys)
        if result.shape[1] != sum(dims) + 1:
            raise FactorError(f"expected Jacobians of {sum(dims)} columns together, got {result.shape[1] - 1}")
        if not (np.abs(result) <= LARGEST).all():
            raise FactorError(
                f"expected a residual and Jacobians of finite numbers, at most {LARGEST:g} standard deviations"
            )
        column = 0
        for key in keys:
            columns = slice(column, column + self.variables[key].dim)
            D = self.transport(key)
            if D is not None:
                result[:, columns] = result[:, columns] @ D
            result[:, -1] += result[:, columns] @ self.increment(key)
            column = columns.stop
        return native_factor(keys, dims, result)
