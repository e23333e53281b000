"""Who is compared: methods and changes of their settings, each with tracks kept alive and with the shipped life."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, Literal

from pipelines.bench.gaps.gap import LONGEST
from pipelines.bench.variants import Variant, changed
from pipelines.config import TrackConfig
from saga_fg.model.turning import CoordinatedTurn
from saga_fg.tracking import ClassSettings
from saga_fg.types.by_class import class_settings

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
STATIONARY = {"tracker.stationarity.prior": 0.5}
TURNING = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle", "cyclist", "default")


def _turning(classes: Mapping[str, ClassSettings]) -> Mapping[str, ClassSettings]:
    """Vehicles that turn at a nearly constant rate, with the noise of their acceleration as it is."""
    found = dict(classes)
    for label in classes:
        own = class_settings(classes, ClassSettings, label)
        if label in TURNING:
            noise = getattr(own.motion, "acceleration_noise", CoordinatedTurn().acceleration_noise)
            found[label] = changed(own, "motion", CoordinatedTurn(acceleration_noise=noise))
    return found


TURN = {"tracker.classes": _turning}
CONTENDERS = {
    variant.name: variant
    for variant in (
        Variant("saga"),
        Variant("kf", "kf"),
        Variant("turn", "kf", {"tracker.stationarity.prior": 0.0, **TURN}),
        Variant("stationary", "kf", STATIONARY),
        Variant("stationary + turn", "kf", STATIONARY | TURN),
        Variant("centerpoint", "centerpoint"),
    )
}
REFERENCE = "kf"


def with_life(config: TrackConfig, life: Life) -> TrackConfig:
    """The configuration, with tracks that live, and are reported, for as long as any gap if they are kept alive."""
    if life == "kept":
        for name, value in KEPT_ALIVE.items():
            config = changed(config, name, value)
    return config
