"""Settings of offline smoothing."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from factors import Robust
from saga_fg.graph import FactorProvider
from saga_fg.model import ConstantVelocity
from saga_fg.settings import (
    Fraction,
    NonNegative,
    Positive,
    Settings,
    setting,
    settings_group,
)
from saga_fg.types import DEFAULT

LOSS_SCALE = 2.0  # residual from which the loss departs from a square, standard deviations
PRIOR_OPPORTUNITY_TIME = 1.0  # missed opportunities that each object starts with, as a time, s


@dataclass(frozen=True)
class OfflineClass(Settings):
    """Smoothing of the objects of one class."""

    acceleration_noise: Positive = setting(
        1.0, "spectral density of the acceleration, m^2/s^3; usual 0.3 to 2; lower: smoother paths"
    )
    position_bias: NonNegative = setting(
        0.1,
        "standard deviation of the position error that all detections of one object share, m; usual 0 to "
        "0.3; higher: wider reported ellipses",
    )
    min_heading_speed: Positive = setting(
        2.0,
        "speed from which the direction of motion gives the heading, m/s; usual 1 to 3; higher: detected "
        "headings count for longer",
    )
    stationary_speed: NonNegative = setting(
        0.5, "smoothed speed below which an object may be stationary, m/s; usual 0.1 to 1"
    )
    stationary_drift: NonNegative = setting(
        0.5, "largest drift of the measured positions while an object is stationary, m; usual 0.1 to 1"
    )

    @property
    def motion(self) -> ConstantVelocity:
        """Own motion of the class."""
        return ConstantVelocity(self.acceleration_noise)


@dataclass(frozen=True)
class SmoothingSettings(Settings):
    """All settings that turn online tracks into labels."""

    classes: Mapping[str, OfflineClass] = settings_group(
        lambda: {DEFAULT: OfflineClass()}, "settings by class of object; the entry named default serves all others"
    )
    edges: bool = setting(
        True,
        "whether edges act in the passes over the recording too; false: online alone, where detections are dense and a "
        "follower's own past and future say more than its leader",
    )
    max_gap: NonNegative = setting(
        3.0, "longest gap between two tracklets of one object, s; higher: more links, right and wrong"
    )
    position_drift: Positive = setting(
        0.03,
        "standard deviation of the place after one second while stationary, m: by the drift of the vehicle's poses; "
        "usual 0.01 to 0.1; lower: held more firmly",
    )
    loss: Literal["none", "huber", "cauchy", "geman-mcclure", "tukey"] = setting(
        "huber", "robust loss of the detections"
    )
    providers: tuple[str | FactorProvider, ...] = setting(
        (), "factor providers, MODULE:NAME or {kind: MODULE:NAME, ...settings}, for the final states"
    )
    backward_time: NonNegative = setting(
        0.0,
        "time by which boxes reach back before the first detection of an object that came from far away, s; usual 0 "
        "to 1; higher: more boxes of objects too far to be detected, right and wrong",
    )
    backward_distance: NonNegative = setting(
        50.0,
        "an object came from far away if its first detection is further from the vehicle than this, m; set it a bit "
        "below the range of the detector; higher: fewer objects reach back",
    )
    min_score: Fraction = setting(0.02, "drop objects of a lower score; higher: fewer false objects, more misses")

    @property
    def robust(self) -> Robust | None:
        """The loss of the detections."""
        return None if self.loss == "none" else Robust(self.loss, LOSS_SCALE)
