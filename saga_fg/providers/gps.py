"""The vehicle's place by satellites: r = t + R a - z, with a the antenna's place on the vehicle.

A fix that is older than the frame by dt was taken at exp(-dt xi) a in the vehicle's frame of now, xi its velocity over
the epoch. The antenna's place can be a variable for all time. A fix far off is left out by a gate, which is as wide as
the pose is uncertain; what passes is under a robust loss.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import gtsam
import numpy as np

from factors import ResidualFactor, Robust, SpatialPose, Vector, position_factor, prior_factor
from saga_fg.errors import InputError
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.keys import EGO_CALIBRATION, EGO_POSE
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.chi_square import chi_square_quantile
from saga_fg.providers.mounting import ANTENNA
from saga_fg.providers.start import NO_POSE
from saga_fg.settings import Fraction, Positive, PositiveOrInf, Settings, setting

_LOG = logging.getLogger(__name__)
ANTENNA_DEVIATION = 0.5  # standard deviation of the antenna's position beforehand, by axis, m


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
    estimate_antenna: bool = setting(False, "true: the antenna's position is a variable of the graph; poses in space")
    name = "gps"

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
        antenna = _moved_back(view, pose.key, np.array(self.antenna), fix.age)
        factor = position_factor(pose.key, z, R, antenna, robust)
        if self.gate < 1:
            values = gtsam.Values()
            values.insert(pose.key, view.state(pose.key))
            _, (J,), (r,) = factor.linearisation(values)
            S = J[0] @ view.covariance(pose.key) @ J[0].T + R
            if float(r @ np.linalg.solve(S, r)) > chi_square_quantile(self.gate, dim):
                _LOG.warning(
                    "%s at %.2f s: a fix %.1f m off is left out", self.name, view.time, float(np.linalg.norm(r))
                )
                return Additions()
        if not self.estimate_antenna:
            return Additions(factors=[factor])
        if dim == 2:
            raise InputError("gps: estimate_antenna: expected the vehicle's pose in space, got one in the plane")
        key, place, new = view.key(EGO_CALIBRATION, ANTENNA, static=True), np.array(self.antenna), list[NewVariable]()
        priors = list[Factor]()
        if ANTENNA not in view.static(EGO_CALIBRATION):
            new.append(NewVariable(EGO_CALIBRATION, ANTENNA, place, static=True, label="place of the antenna"))
            priors.append(prior_factor(key, place, ANTENNA_DEVIATION**2 * np.eye(3)))
        types = (SpatialPose(), Vector(3))
        function = partial(_by_antenna, z, antenna - place)
        return Additions(new, [*priors, ResidualFactor((pose.key, key), types, function, R, robust=robust, name="fix")])


def _by_antenna(z: FloatArray, moved: FloatArray, pose: gtsam.Pose3, antenna: FloatArray) -> FloatArray:
    return np.asarray(pose.transformFrom(antenna + moved) - z)


def _moved_back(view: GraphView, key: int, antenna: FloatArray, age: float) -> FloatArray:
    """Place of the antenna `age` s ago in the frame of the present pose; its present place without an earlier pose."""
    before = view.before(EGO_POSE).get(0)
    if age == 0 or before is None or view.dt == 0:
        return antenna
    motion: Any = view.state(before.key).between(view.state(key))
    share: Any = type(motion).Expmap(-age / view.dt * type(motion).Logmap(motion))
    dim = 2 if isinstance(motion, gtsam.Pose2) else 3
    return np.concatenate([share.transformFrom(antenna[:dim]), antenna[dim:]])
