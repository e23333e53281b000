"""Settings of offline smoothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from factors import Robust
from saga_fg.graph import FactorProvider
from saga_fg.model.node import ConstantVelocity
from saga_fg.settings import (
    Fraction,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveOrInf,
    Settings,
    setting,
    settings_group,
)
from saga_fg.types.by_class import DEFAULT


@dataclass(frozen=True)
class OfflineClass(Settings):
    """How objects of one class are smoothed."""

    acceleration_noise: Positive = setting(1.0, "spectral density of the acceleration, m^2/s^3")
    position_bias: NonNegative = setting(
        0.1, "standard deviation of the part of a detector's position errors that lasts over a track, m"
    )
    motion_heading: Positive = setting(2.0, "speed from which the direction of motion tells the heading, m/s")
    stand_speed: NonNegative = setting(0.5, "smoothed speed below which an object may stand, m/s")
    stand_drift: NonNegative = setting(
        0.5, "how far measured positions may drift from the beginning to the end of a stand, m"
    )
    yaw_drift: NonNegative = setting(0.2, "how fast the heading changes, standard deviation after one second, rad")

    @property
    def motion(self) -> ConstantVelocity:
        """Own motion of the class."""
        return ConstantVelocity(self.acceleration_noise)


@dataclass(frozen=True)
class JoiningSettings(Settings):
    """When two tracklets are one object."""

    max_gap: NonNegative = setting(3.0, "longest time between the end of one and the beginning of the other, s")
    new_objects: Positive = setting(0.005, "how densely objects appear that were not there before, per m^2")
    miss: NonNegative = setting(0.3, "cost of a frame in the gap that should have shown the object, nats")
    gate: Fraction = setting(0.999, "share of true pairs that the chi-square gate lets through")


@dataclass(frozen=True)
class StationarySettings(Settings):
    """Objects that stand still (see the classes for how slow that is), and how firmly they are pinned."""

    min_time: NonNegative = setting(1.0, "shortest time it stands, s")
    velocity: Positive = setting(0.02, "standard deviation of its velocity meanwhile, m/s")
    noise: Positive = setting(1e-4, "factor on the process noise meanwhile")


@dataclass(frozen=True)
class QualitySettings(Settings):
    """The classes of quality of a box: the first whose conditions it fulfils, else low."""

    high_score: Fraction = setting(0.5, "least score of a box of high quality")
    high_deviation: PositiveOrInf = setting(0.3, "largest standard deviation of its position in any direction, m")
    medium_score: Fraction = setting(0.2, "least score of a box of medium quality")
    medium_deviation: PositiveOrInf = setting(0.8, "largest standard deviation of its position in any direction, m")


@dataclass(frozen=True)
class SmoothingSettings(Settings):
    """Everything that turns online tracks into labels."""

    classes: Mapping[str, OfflineClass] = settings_group(
        lambda: {DEFAULT: OfflineClass()}, "by class; the entry named default serves all others"
    )
    joining: JoiningSettings = settings_group(JoiningSettings, "joining of tracklets across gaps")
    stationary: StationarySettings = settings_group(StationarySettings, "objects that stand still")
    loss: Literal["none", "huber", "cauchy", "geman-mcclure", "tukey"] = setting(
        "huber", "robust loss of the detections"
    )
    loss_scale: Positive = setting(2.0, "residual from which the loss differs from a square, standard deviations")
    providers: tuple[str | FactorProvider, ...] = setting(
        (),
        "factor providers as MODULE:NAME, or with settings as {kind: MODULE:NAME, ...}, asked once a moment for the "
        "final states, made anew every time",
    )
    reweightings: NonNegativeInt = setting(
        1, "times the weights of the loss, and the edges, are found again at the final states"
    )
    extension: NonNegative = setting(1.5, "how far before its birth and after its end an object is looked for, s")
    prior_time: NonNegative = setting(1.0, "looks without a detection that every object starts with, as a time, s")
    min_score: Fraction = setting(0.02, "objects of a lower score are dropped")
    quality: QualitySettings = settings_group(QualitySettings, "classes of quality of a box")
    claim: Fraction = setting(0.95, "share of true pairs let through by the gate of detections nobody had claimed")

    @property
    def robust(self) -> Robust | None:
        """The loss of the detections."""
        return None if self.loss == "none" else Robust(self.loss, self.loss_scale)
