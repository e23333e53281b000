"""Detections: measurements of single nodes.

    z = h(x) + v,    v ~ N(0, R)            phi  =  rho( || z - h(x) ||_R )

h is a measurement model (see `factors.measurement`); it names the components of the state it reads, so that any state
can be measured. Linear models, h(x) = H x, give native linear factors; all give nonlinear ones, robust if wished.

A linear model with an angle among its measurements is linear up to whole turns. Its linear factor needs a state nearby,
`near`: the measurement is turned until it lies within pi of what is expected there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.differences import wrap_angles
from factors.errors import FactorError
from factors.gaussian import gaussian_factor, gaussian_factors
from factors.measurement import MeasurementModel
from factors.nonlinear import ResidualFactor
from factors.robust import RobustLoss
from factors.stacked import ResidualFactors
from factors.validation import FloatArray, KeyArray, checked, checked_covariances, checked_key_array
from factors.variables import Vector


def detection_factor(
    key: int, model: MeasurementModel, z: ArrayLike, R: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactor:
    """Return the factor rho(|| h(x) - z ||_R) on the vector variable `key`.

    z: (m,) measured; R: (m, m), positive definite. Raises `FactorError`, now or when linearised where h is undefined.
    """
    measured = checked("z", z, (model.dim,)).copy()
    function = _Detection(model, measured)
    return ResidualFactor(
        keys=(key,),
        variables=(Vector(model.state_dim),),
        residual=function.residual,
        covariance=checked("R", R, (model.dim, model.dim)),
        jacobians=function.jacobians,
        robust=robust,
        angles=tuple(model.angles),
        name=f"{model.name} detection",
    )


def detection_factors(
    keys: ArrayLike, model: MeasurementModel, z: ArrayLike, R: ArrayLike, robust: RobustLoss | None = None
) -> ResidualFactors:
    """Return n factors of one model, linearised together; keys: (n,), z: (n, m), R: (n, m, m), or (m, m) for all."""
    measured = checked("z", z, (None, model.dim)).copy()
    function = _Detection(model, measured)
    return ResidualFactors(
        rows=_column(keys, len(measured)),
        dims=(model.state_dim,),
        residual=function.residual,
        covariances=checked_covariances("R", R, len(measured), model.dim),
        jacobians=function.jacobians,
        robust=robust,
        angles=tuple(model.angles),
        name=f"{model.name} detections",
    )


def linear_detection_factor(
    key: int, model: MeasurementModel, z: ArrayLike, R: ArrayLike, near: ArrayLike | None = None
) -> gtsam.JacobianFactor:
    """Return the native factor || H x - z ||_R of a linear model.

    near: a state (d,) close by, needed by models that measure an angle. Raises `FactorError` for a nonlinear model.
    """
    measured = checked("z", z, (model.dim,))
    H = linear_matrix(model)
    reference = None if near is None else checked("near", near, (model.state_dim,))
    return gaussian_factor([key], [H], _unwrapped(model, H, measured, reference), R)


def linear_detection_factors(
    keys: ArrayLike, model: MeasurementModel, z: ArrayLike, R: ArrayLike, near: ArrayLike | None = None
) -> list[gtsam.JacobianFactor]:
    """Return n native factors of one linear model; keys: (n,), z: (n, m), R: (n, m, m) or (m, m), near: (n, d)."""
    measured = checked("z", z, (None, model.dim))
    H = linear_matrix(model)
    reference = None if near is None else checked("near", near, (len(measured), model.state_dim))
    blocks = np.broadcast_to(H, (len(measured), *H.shape))
    return gaussian_factors(
        _column(keys, len(measured)),
        [blocks],
        _unwrapped(model, H, measured, reference),
        checked_covariances("R", R, len(measured), model.dim),
    )


def linear_matrix(model: MeasurementModel) -> FloatArray:
    """Return H (m, d) of a linear model; raise `FactorError` for another."""
    if not model.linear:
        raise FactorError(f"model: expected a linear one, {model.name} is not")
    return model.jacobian(np.zeros(model.state_dim))


def _column(keys: ArrayLike, n: int) -> KeyArray:
    names = checked_key_array("keys", keys)
    if len(names) != n:
        raise FactorError(f"keys: expected {n}, one per measurement, got {len(names)}")
    return names[:, None]


def _unwrapped(model: MeasurementModel, H: FloatArray, z: FloatArray, near: FloatArray | None) -> FloatArray:
    if not model.angles:
        return z
    if near is None:
        raise FactorError(f"near: expected a state, because {model.name} measures an angle")
    expected = near @ H.T
    turned = wrap_angles(z - expected, model.angles)
    index = list(model.angles)
    result = z.copy()
    result[..., index] = expected[..., index] + turned[..., index]
    return result


@dataclass(frozen=True)
class _Detection:
    model: MeasurementModel
    z: FloatArray

    def residual(self, x: FloatArray) -> FloatArray:
        return self.model.predict(x) - self.z

    def jacobians(self, x: FloatArray) -> Sequence[FloatArray]:
        return [self.model.jacobian(x)]
