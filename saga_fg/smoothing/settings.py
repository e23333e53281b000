"""Settings of offline smoothing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from factors import Robust
from saga_fg.graph import FactorProvider
from saga_fg.model.node import ConstantVelocity
from saga_fg.settings import require_between, require_one_of, require_positive, setting, settings_group
from saga_fg.types.by_class import DEFAULT


@dataclass(frozen=True)
class OfflineClass:
    """How objects of one class are smoothed."""

    acceleration_noise: float = setting(1.0, "spectral density of the acceleration, m^2/s^3")
    lasting_error: float = setting(
        0.1, "standard deviation of the part of a detector's position errors that lasts over a track, m"
    )
    motion_heading: float = setting(2.0, "speed from which the direction of motion tells the heading, m/s")
    stand_speed: float = setting(0.5, "smoothed speed below which an object may stand, m/s")
    stand_drift: float = setting(
        0.5, "how far measured positions may drift from the beginning to the end of a stand, m"
    )
    yaw_drift: float = setting(0.2, "how fast the heading changes, standard deviation after one second, rad")

    def __post_init__(self) -> None:
        require_positive(self, "acceleration_noise", "motion_heading")
        require_between(self, 0, math.inf, "lasting_error", "stand_speed", "stand_drift", "yaw_drift")

    @property
    def motion(self) -> ConstantVelocity:
        """Own motion of the class."""
        return ConstantVelocity(self.acceleration_noise)


@dataclass(frozen=True)
class JoiningSettings:
    """When two tracklets are one object."""

    max_gap: float = setting(3.0, "longest time between the end of one and the beginning of the other, s")
    new_objects: float = setting(0.005, "how densely objects appear that were not there before, per m^2")
    miss: float = setting(0.3, "cost of a frame in the gap that should have shown the object, nats")
    gate: float = setting(0.999, "share of true pairs that the chi-square gate lets through")

    def __post_init__(self) -> None:
        require_between(self, 0, math.inf, "max_gap", "miss")
        require_positive(self, "new_objects")
        require_between(self, 0, 1, "gate")


@dataclass(frozen=True)
class StandingSettings:
    """Objects that stand still (see the classes for how slow that is), and how firmly they are pinned."""

    min_time: float = setting(1.0, "shortest time it stands, s")
    velocity: float = setting(0.02, "standard deviation of its velocity meanwhile, m/s")
    noise: float = setting(1e-4, "factor on the process noise meanwhile")

    def __post_init__(self) -> None:
        require_between(self, 0, math.inf, "min_time")
        require_positive(self, "velocity", "noise")


@dataclass(frozen=True)
class QualitySettings:
    """The classes of quality of a box: the first whose conditions it fulfils, else low."""

    high_score: float = setting(0.5, "least score of a box of high quality")
    high_deviation: float = setting(0.3, "largest standard deviation of its position in any direction, m")
    medium_score: float = setting(0.2, "least score of a box of medium quality")
    medium_deviation: float = setting(0.8, "largest standard deviation of its position in any direction, m")

    def __post_init__(self) -> None:
        require_between(self, 0, 1, "high_score", "medium_score")
        require_positive(self, "high_deviation", "medium_deviation", infinite=True)


@dataclass(frozen=True)
class SmoothingSettings:
    """Everything that turns online tracks into labels."""

    classes: Mapping[str, OfflineClass] = field(
        default_factory=lambda: {DEFAULT: OfflineClass()},
        metadata={"comment": "by class; the entry named default serves all others"},
    )
    joining: JoiningSettings = settings_group(JoiningSettings, "joining of tracklets across gaps")
    standing: StandingSettings = settings_group(StandingSettings, "objects that stand still")
    loss: Literal["none", "huber", "cauchy", "geman-mcclure", "tukey"] = setting(
        "huber", "robust loss of the detections"
    )
    loss_scale: float = setting(2.0, "residual from which the loss differs from a square, standard deviations")
    providers: tuple[str | FactorProvider, ...] = setting(
        (),
        "factor providers as MODULE:NAME, or with settings as {kind: MODULE:NAME, ...}, asked once a moment for the "
        "final states, made anew every time",
    )
    reweightings: int = setting(1, "times the weights of the loss, and the edges, are found again at the final states")
    extension: float = setting(1.5, "how far before its birth and after its end an object is looked for, s")
    prior_time: float = setting(1.0, "looks without a detection that every object starts with, as a time, s")
    min_score: float = setting(0.02, "objects of a lower score are dropped")
    quality: QualitySettings = settings_group(QualitySettings, "classes of quality of a box")
    claim: float = setting(0.95, "share of true pairs let through by the gate of detections nobody had claimed")

    def __post_init__(self) -> None:
        require_between(self, 0, math.inf, "extension", "prior_time", "reweightings")
        require_one_of(self, "loss", ("none", "huber", "cauchy", "geman-mcclure", "tukey"))
        require_positive(self, "loss_scale")
        require_between(self, 0, 1, "claim", "min_score")

    @property
    def robust(self) -> Robust | None:
        """The loss of the detections."""
        return None if self.loss == "none" else Robust(self.loss, self.loss_scale)
