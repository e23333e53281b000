"""The vehicle's place by satellites: r = t + R a - z, with a the antenna's place on the vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Robust, position_factor
from saga_fg.errors import InputError
from saga_fg.graph.keys import EGO_POSE
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.numerics.chi_square import chi_square_quantile
from saga_fg.providers.start import NO_POSE
from saga_fg.settings import Fraction, Positive, PositiveOrInf, Settings, setting


@dataclass(frozen=True)
class Gps(Settings):
    """Adds GPS fixes (`frame.ego.gps`) on the vehicle's pose that pass the gate."""

    deviation: Positive = setting(1.0, "standard deviation of a horizontal coordinate of fixes without a covariance, m")
    height_deviation: Positive = setting(2.0, "standard deviation of the height of fixes without a covariance, m")
    antenna: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "position of the antenna in the vehicle's frame, m")
    gate: Fraction = setting(0.999, "gate probability: share of true fixes inside the chi-square gate; 1: use all")
    outlier_scale: PositiveOrInf = setting(
        math.inf, "residual from which the Cauchy loss discounts a fix, standard deviations; .inf: never"
    )
    name: str = setting("gps", "name in messages")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.antenna) != 3 or not all(map(math.isfinite, self.antenna)):
            raise InputError(f"antenna: expected three finite numbers, got {self.antenna!r}")

    def factors(self, view: GraphView) -> Additions:
        fix = None if view.frame is None or view.frame.ego is None else view.frame.ego.gps
        pose = view.now(EGO_POSE).get(0)
        if fix is None:
            return Additions()
        if pose is None:
            raise InputError(NO_POSE)
        dim = 2 if pose.dim == 3 else 3
        if len(fix.position) < dim:
            raise InputError("gps: expected a place of 3 coordinates, as poses are in space, got 2")
        z = fix.position[:dim].copy()
        z[:2] -= view.origin
        R = fix.covariance
        if R is None:
            R = np.diag(np.square([self.deviation, self.deviation, self.height_deviation]))
        R = R[:dim, :dim]
        robust = None if math.isinf(self.outlier_scale) else Robust("cauchy", self.outlier_scale)
        factor = position_factor(pose.key, z, R, self.antenna, robust)
        if self.gate < 1:
            values = gtsam.Values()
            values.insert(pose.key, view.state(pose.key))
            _, (J,), (r,) = factor.linearisation(values)
            S = J[0] @ view.covariance(pose.key) @ J[0].T + R
            if float(r @ np.linalg.solve(S, r)) > chi_square_quantile(self.gate, dim):
                return Additions()
        return Additions(factors=[factor])
