"""Who is compared: methods and changes of their settings, each with tracks kept alive and with the shipped life."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from typing import Any, Literal

from pipelines.bench.gaps.gap import LONGEST
from pipelines.bench.variants import Variant, changed
from pipelines.config import TrackConfig
from saga_fg.model.motion import ConstantAcceleration, ConstantVelocity, Curvilinear
from saga_fg.model.turning import CoordinatedTurn
from saga_fg.tracking import ClassSettings

Life = Literal["kept", "shipped"]
LIVES: tuple[Life, ...] = ("kept", "shipped")
LIFE = LONGEST + 1.0  # s: for so long tracks that are kept alive live without a detection
KEPT_ALIVE: Mapping[str, Any] = {
    "tracker.report_coasting": LIFE,
    "tracker.classes.*.max_coasting": LIFE,
    "tracker.max_out_of_view": inf,
    "tracker.existence.delete_below": 0.0,
    "tracker.existence.report_above": 0.0,
    "greedy.max_coasting": LIFE,
}
TURNING = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle", "cyclist", "default")
"""Classes of vehicles."""
CLASSICAL_NOISE = 1.5
"""Spectral density of the acceleration, m^2/s^3, of classes configured with a fading acceleration instead.

White acceleration is the textbook's motion; a noise of the jerk means nothing to it. KITTI is the only set configured
with fading accelerations. The density was chosen for constant velocity by tracking its sequences 0000, 0003, 0004,
0005 and 0011.
"""


def _moving(turn: bool) -> Callable[[Mapping[str, ClassSettings]], Mapping[str, ClassSettings]]:
    """All classes at constant velocity, or vehicles at a constant turn rate; acceleration noise, where set, stays."""

    def change(classes: Mapping[str, ClassSettings]) -> Mapping[str, ClassSettings]:
        found = dict(classes)
        for label, own in classes.items():
            fading = isinstance(own.motion, ConstantAcceleration | Curvilinear)
            noise = getattr(own.motion, "acceleration_noise", None) or (CLASSICAL_NOISE if fading else None)
            if noise is not None:
                turns = turn and label in TURNING
                motion = CoordinatedTurn(noise) if turns else ConstantVelocity(noise)
                found[label] = replace(own, motion=motion)
        return found

    return change


def _classical(name: str, stationary: bool, turn: bool) -> Variant:
    prior = {"tracker.stationarity.prior": 0.5 if stationary else 0.0}
    return Variant(name, "kf", prior | {"tracker.classes": _moving(turn)})


CONTENDERS = {
    variant.name: variant
    for variant in (
        Variant("saga"),
        Variant("kf", "kf"),
        _classical("constant velocity", stationary=False, turn=False),
        _classical("turn", stationary=False, turn=True),
        _classical("stationary", stationary=True, turn=False),
        _classical("stationary + turn", stationary=True, turn=True),
        Variant("centerpoint", "centerpoint"),
    )
}


def with_life(config: TrackConfig, life: Life) -> TrackConfig:
    """The configuration, with tracks that live, and are reported, for as long as any gap if they are kept alive."""
    if life == "kept":
        for name, value in KEPT_ALIVE.items():
            config = changed(config, name, value)
    return config
