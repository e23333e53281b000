"""The official configuration of the nuScenes tracking task (`tracking_nips_2019`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from saga_fg.settings import setting, settings_group

CLASS_RANGE = {
    "bicycle": 40.0,
    "bus": 50.0,
    "car": 50.0,
    "motorcycle": 40.0,
    "pedestrian": 40.0,
    "trailer": 50.0,
    "truck": 50.0,
}


@dataclass(frozen=True)
class NuScenesTrackingSettings:
    """Settings of the nuScenes tracking metrics; the defaults are the official ones."""

    class_range: Mapping[str, float] = settings_group(
        lambda: dict(CLASS_RANGE), "classes scored, and the distance from the vehicle up to which they are, m"
    )
    gate: float = setting(2.0, "distance from which a pair cannot match, m")
    min_recall: float = setting(0.1, "lowest recall of the sweep")
    thresholds: int = setting(40, "number of recall values in the sweep")
    worst_motp: float = setting(2.0, "charged where a recall is not reached, m")
    worst_faf: float = setting(500.0, "reported for a class that is never matched, false alarms per 100 frames")
    worst_duration: float = setting(20.0, "initialisation and gap duration of a class that is never matched, s")
    sample_period: float = setting(0.5, "time thin one frame counts in TID and LGD, s")
