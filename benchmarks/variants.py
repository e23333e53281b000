"""Variants of trackers: methods, the graph-aware tracker with one component switched off, and classical motions.

A component is a named change of settings, written as dotted names and values over the shipped configuration; `*` stands
for every entry of a mapping. A value may be a function of the old value. One that is off as shipped is not compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.gap_runs import CURVE
from benchmarks.runner import chosen
from pipelines.config import METHODS, Method, TrackConfig
from pipelines.configuration import load_settings
from pipelines.learning.interactions import Contender
from saga_fg.errors import InputError
from saga_fg.model import (
    ConstantVelocity,
    CoordinatedTurn,
    EdgeRule,
    Following,
    GreenLight,
    Neighbours,
    RandomWalk,
    RedLight,
)
from saga_fg.tracking import ClassSettings
from saga_fg.types import class_settings

Classes = Mapping[str, ClassSettings]


@dataclass(frozen=True)
class Variant:
    """A method, and what is changed in its settings."""

    name: str
    method: Method = "saga"
    changes: Mapping[str, Any] = field(default_factory=dict)

    def contender(self, base: TrackConfig) -> Contender:
        """The method with the changes of a configuration."""
        for name, value in self.changes.items():
            base = changed(base, name, value)
        return Contender(self.name, self.method, base)


def _without(*kinds: type) -> Callable[[tuple[EdgeRule, ...]], tuple[EdgeRule, ...]]:
    return lambda edges: tuple(edge for edge in edges if not isinstance(edge, kinds))


SHIPPED = (Variant("saga"), Variant("kf", "kf"), Variant("centerpoint", "centerpoint"))
COMPONENTS = (
    Variant("without following", changes={"tracker.edges": _without(Following)}),
    Variant("without neighbours", changes={"tracker.edges": _without(Neighbours)}),
    Variant("without explained noise", changes={"tracker.explained_noise": 0.0}),
    Variant("without speeds of traffic", changes={"tracker.traffic.speed_prior.weight": 0.0}),
    Variant("without stationary objects", changes={"tracker.stationary_share": 0.0}),
    Variant("tracks of one detection rank as others", changes={"tracker.min_hits": 1}),
    Variant("without non-maximum suppression", changes={"tracker.classes.*.nms_distance": 0.0}),
    Variant("without suppression of weak detections", changes={"tracker.classes.*.weak_nms_distance": 0.0}),
    Variant("matching without clutter", changes={"tracker.association.clutter_area": math.inf}),
    Variant("hard association", changes={"tracker.association.clear_above": 0.0}),
    Variant("greedy matching", changes={"tracker.association.method": "greedy"}),
    Variant("graph matching", changes={"tracker.association.method": "graph"}),
    Variant("scores without hit ratio", changes={"tracker.existence.hit_ratio_weight": 0.0}),
    Variant("without tentative tracks", changes={"tracker.tentative_score_factor": 0.0}),
    Variant("without output while coasting", changes={"tracker.report_coasting": 0.0}),
    Variant("headings that drift freely", changes={"tracker.classes.*.yaw_drift": 3.0}),
)
CONFUSED = {c: {z: 8.0 if z == c else 1.0 for z in ("car", "truck", "bus")} for c in ("car", "truck", "bus")}
TURNING = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle", "cyclist", "default")
"""Classes of vehicles."""
CLASSICAL_NOISE: Mapping[str | Path, Mapping[str, float]] = {
    "kitti": {"default": 1.5},
    "nuscenes": {"default": 1.5, "car": 3.0, "motorcycle": 3.0, "pedestrian": 0.5},
    "traffic": {"default": 1.0, "pedestrian": 0.3},
    "simulated": {"default": 0.3, "pedestrian": 0.1},
    "file": {"default": 1.0},
}
"""Spectral density of the acceleration, m^2/s^3, of classes that are configured with another motion.

White acceleration is the textbook's motion, and the noise of another one means nothing to it. The densities are those
chosen for constant velocity: by tracking sequences 0000, 0003, 0004, 0005 and 0011 of KITTI, others as they were
configured before motions that suit better.
"""


def variants(family: str | Path) -> dict[str, Variant]:
    """All, by name, for the settings of a kind of data."""
    found = (
        *SHIPPED,
        Variant(CURVE, "kf"),
        Variant("trails alone", changes={"tracker.edges": ()}),
        Variant("without trails", changes={"tracker.traffic.reach": 0.0}),
        Variant("class beliefs", changes={"sensors.*.confusion": CONFUSED}),
        Variant("without lights", changes={"tracker.edges": _without(RedLight, GreenLight)}),
        _classical(family, "constant velocity", stationary=False, turn=False),
        _classical(family, "turn", stationary=False, turn=True),
        _classical(family, "stationary", stationary=True, turn=False),
        _classical(family, "stationary + turn", stationary=True, turn=True),
        *COMPONENTS,
    )
    return {variant.name: variant for variant in found}


def contenders(family: str | Path, base: TrackConfig, wanted: str, own: Sequence[str]) -> list[Contender]:
    """Variants of a configuration by name, with commas, without those that change nothing, and others from files.

    own  NAME[:METHOD]=FILE each. Raises `InputError` for an unknown name and a wrong file.
    """
    known, found = variants(family), list[Contender]()
    for name in chosen("--contenders", wanted, tuple(known)):
        made = known[name].contender(base)
        same = [one for one in found if (one.method, one.config) == (made.method, made.config)]
        if name == CURVE or all(one.name == CURVE for one in same):
            found.append(made)
    for text in own:
        title, _, path = text.partition("=")
        name, _, method = title.partition(":")
        if not name or not path or method not in ("", *METHODS) or name in [each.name for each in found]:
            raise InputError(
                f"--contender {text}: expected a new NAME=FILE or NAME:METHOD=FILE, of {', '.join(METHODS)}"
            )
        settings = load_settings(type(base), Path(path), base)
        found.append(Contender(name, next((m for m in METHODS if m == method), "saga"), settings))
    return found


def _classical(family: str | Path, name: str, stationary: bool, turn: bool) -> Variant:
    """`kf` with all classes at constant velocity, or vehicles at a constant turn rate; those that don't move stay."""

    def change(classes: Classes) -> Classes:
        found = dict(classes)
        for label, own in classes.items():
            if isinstance(own.motion, RandomWalk):
                continue
            noise = class_settings(CLASSICAL_NOISE.get(family, CLASSICAL_NOISE["file"]), float, label)
            if isinstance(own.motion, ConstantVelocity):
                noise = own.motion.acceleration_noise
            motion = CoordinatedTurn(noise) if turn and label in TURNING else ConstantVelocity(noise)
            found[label] = replace(own, motion=motion)
        return found

    return Variant(name, "kf", {"tracker.stationary_share": 0.5 if stationary else 0.0, "tracker.classes": change})


def changed(settings: Any, name: str, value: Any) -> Any:
    """`settings` with the dotted `name` set to `value`. Raises `InputError` for a name that does not exist."""
    head, _, rest = name.partition(".")
    if isinstance(settings, Mapping):
        keys = list(settings) if head == "*" else [head]
        if not all(key in settings for key in keys):
            raise InputError(f"{name}: expected one of {', '.join(settings)}")
        return {**settings, **{key: _next(settings[key], rest, value) for key in keys}}
    if not is_dataclass(settings) or isinstance(settings, type) or head not in settings.__dataclass_fields__:
        raise InputError(f"{name}: expected the name of a setting")
    return replace(settings, **{head: _next(getattr(settings, head), rest, value)})


def _next(old: Any, rest: str, value: Any) -> Any:
    if rest:
        return changed(old, rest, value)
    return value(old) if callable(value) else value
