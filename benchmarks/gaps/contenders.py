"""Contenders: methods and changes of their settings, each with tracks kept alive and with the shipped deletion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from benchmarks.variants import Variant
from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.motion import ConstantVelocity, RandomWalk
from saga_fg.model.road.starting import GreenLight
from saga_fg.model.road.stopping import RedLight
from saga_fg.model.turning import CoordinatedTurn
from saga_fg.tracking import ClassSettings
from saga_fg.types.by_class import class_settings

TURNING = ("car", "truck", "bus", "trailer", "motorcycle", "bicycle", "cyclist", "default")
"""Classes of vehicles."""
CLASSICAL_NOISE: Mapping[str | Path, Mapping[str, float]] = {
    "kitti": {"default": 1.5},
    "nuscenes": {"default": 1.5, "car": 3.0, "motorcycle": 3.0, "pedestrian": 0.5},
    "traffic": {"default": 1.0, "pedestrian": 0.3},
    "simulated": {"default": 0.3, "pedestrian": 0.1},
    "heterogeneous": {"default": 0.3, "pedestrian": 0.3},
    "file": {"default": 1.0},
}
"""Spectral density of the acceleration, m^2/s^3, of classes that are configured with another motion.

White acceleration is the textbook's motion, and the noise of another one means nothing to it. The densities are those
chosen for constant velocity: by tracking sequences 0000, 0003, 0004, 0005 and 0011 of KITTI, others as they were
configured before motions that suit better.
"""


def _moving(family: str | Path, turn: bool) -> Callable[[Mapping[str, ClassSettings]], Mapping[str, ClassSettings]]:
    """All classes at constant velocity, or vehicles at a constant turn rate; those that don't move stay."""

    def change(classes: Mapping[str, ClassSettings]) -> Mapping[str, ClassSettings]:
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

    return change


def _without_lights(edges: tuple[EdgeRule, ...]) -> tuple[EdgeRule, ...]:
    """Without the rules by which lights act at their stop lines."""
    return tuple(edge for edge in edges if not isinstance(edge, RedLight | GreenLight))


def _classical(family: str | Path, name: str, stationary: bool, turn: bool) -> Variant:
    prior = {"tracker.stationarity.prior": 0.5 if stationary else 0.0}
    return Variant(name, "kf", prior | {"tracker.classes": _moving(family, turn)})


def contenders(family: str | Path) -> dict[str, Variant]:
    """All, by name, for the settings of a kind of data."""
    found = (
        Variant("saga"),
        Variant("without trails", changes={"tracker.traffic.reach": 0.0}),
        Variant("without lights", changes={"tracker.edges": _without_lights}),
        Variant("kf", "kf"),
        _classical(family, "constant velocity", stationary=False, turn=False),
        _classical(family, "turn", stationary=False, turn=True),
        _classical(family, "stationary", stationary=True, turn=False),
        _classical(family, "stationary + turn", stationary=True, turn=True),
        Variant("centerpoint", "centerpoint"),
    )
    return {variant.name: variant for variant in found}
