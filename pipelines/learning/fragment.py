"""Learned settings as a piece of configuration for `--config`: YAML that holds nothing else."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import yaml

from pipelines.learning.noise import LearnedNoise
from saga_fg.model.motion import ConstantVelocity, Curvilinear
from saga_fg.tracking import ClassSettings
from saga_fg.types.by_class import class_settings

LEARNED = ("noise", "calibration", "detection_probability", "class_detection_probability", "field_of_view", "confusion")
KINDS: dict[type, str] = {ConstantVelocity: "constant_velocity", Curvilinear: "curvilinear"}
DIGITS = 4


def learned_fragment(learned: LearnedNoise, origin: str) -> str:
    """The YAML text; `origin` says in its first line what it was learned from."""
    sensors = {}
    for name in learned.detections:
        values = asdict(learned.config.sensors[name])
        sensors[name] = {key: _rounded(values[key]) for key in LEARNED if values[key] != {}}
    tracker: dict[str, Any] = {}
    if any("confusion" in values for values in sensors.values()):  # it is one among the classes of these groups
        tracker["class_groups"] = [list(group) for group in learned.config.tracker.class_groups]
    if learned.classes:
        classes = learned.config.tracker.classes
        motions = {label: class_settings(classes, ClassSettings, label).motion for label in learned.classes}
        tracker["classes"] = {
            label: {"motion": {"kind": KINDS[type(motion)], **_rounded(asdict(motion))}}
            for label, motion in motions.items()
        }
    data: dict[str, Any] = {"sensors": sensors, **({"tracker": tracker} if tracker else {})}
    text: str = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)
    return f"# Learned by saga-fg learn noise from {origin}; pass it to --config.\n{text}"


def _rounded(value: Any) -> Any:
    """Plain numbers of a few digits."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
