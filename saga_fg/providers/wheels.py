"""The speed of the vehicle by its wheels: they roll ahead, and slide neither sideways nor off the ground.

    r = log( X^-1 before^-1 now X )_translation / dt - s (v, 0, 0)

X is the place of the axle that does not steer, v the mean speed by the wheels and s their scale: 1, or a variable for
all time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import gtsam
import numpy as np

from factors import ResidualFactor, Robust, SpatialPose, Variable, Vector, prior_factor
from saga_fg.errors import InputError
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.keys import EGO_CALIBRATION, EGO_POSE
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.providers.mounting import ON_THE_POSE, WHEELS, Mounting, mounting
from saga_fg.providers.start import NO_POSE
from saga_fg.settings import Fraction, Positive, Settings, setting

_OFF = 0.5  # share of an epoch that the wheels must have measured
SIDEWAYS = 0.1  # standard deviation of the velocity to the side and upwards, m/s
SCALE_DEVIATION = 0.05  # standard deviation of the scale of the speed beforehand, as a share


@dataclass(frozen=True)
class Wheels(Settings):
    """Adds the speed by the wheels (`frame.ego.wheels`) between the vehicle's poses in space of two epochs."""

    deviation: Positive = setting(
        0.1, "standard deviation of a speed without one of its own, m/s; higher: trusted less"
    )
    share: Fraction = setting(0.01, "standard deviation of a speed as a share of it: radius of the wheels, slip")
    outlier_scale: Positive = setting(
        3.0, "residual from which the Cauchy loss discounts a speed, as of spinning wheels, standard deviations"
    )
    mounted: Mounting = setting(
        ON_THE_POSE, "x, y, z (m), roll, pitch, yaw (rad) of the axle that does not steer, in the vehicle's frame"
    )
    estimate_scale: bool = setting(False, "true: the scale of the speed is a variable of the graph")
    name = "wheels"

    def __post_init__(self) -> None:
        super().__post_init__()
        mounting("mounted", self.mounted)

    @property
    def _place(self) -> gtsam.Pose3:
        return mounting("mounted", self.mounted)

    def factors(self, view: GraphView) -> Additions:
        wheels = None if view.frame is None or view.frame.ego is None else view.frame.ego.wheels
        before, now = view.before(EGO_POSE).get(0), view.now(EGO_POSE).get(0)
        if wheels is None or before is None or view.dt == 0 or wheels.dt < _OFF * view.dt:
            return Additions()
        if now is None:
            raise InputError(NO_POSE)
        if now.dim != 6:
            raise InputError("wheels: expected the vehicle's pose in space, got one in the plane")
        ahead = np.hypot(self.deviation if wheels.deviation is None else wheels.deviation, self.share * wheels.speed)
        R = np.diag(np.square([ahead, SIDEWAYS, SIDEWAYS]))
        keys, types = [before.key, now.key], list[Variable]([SpatialPose(), SpatialPose()])
        new, priors = list[NewVariable](), list[Factor]()
        if self.estimate_scale:
            scale = view.key(EGO_CALIBRATION, WHEELS, static=True)
            keys, types = [*keys, scale], [*types, Vector(1)]
            if WHEELS not in view.static(EGO_CALIBRATION):
                new.append(NewVariable(EGO_CALIBRATION, WHEELS, np.ones(1), static=True, label="scale of the wheels"))
                priors.append(prior_factor(scale, np.ones(1), [[SCALE_DEVIATION**2]]))
        residual = partial(_residual, self._place, view.dt, wheels.speed)
        robust = Robust("cauchy", self.outlier_scale)
        factor = ResidualFactor(tuple(keys), tuple(types), residual, R, robust=robust, name="speed of the wheels")
        return Additions(new, [*priors, factor])


def _residual(place: gtsam.Pose3, dt: float, speed: float, before: Any, now: Any, *scale: FloatArray) -> FloatArray:
    moved = gtsam.Pose3.Logmap(before.compose(place).between(now.compose(place)))[3:] / dt
    moved[0] -= speed * (float(scale[0][0]) if scale else 1.0)
    return np.asarray(moved)
