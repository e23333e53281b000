"""All benchmarks, as one command: the function `NAME` of each module `benchmarks.NAME`."""

from __future__ import annotations

from importlib import import_module

from benchmarks.runner import application

NAMES = (
    *("calibration", "conventions", "endurance", "gaps", "geometry", "inertial", "joint", "kills", "labels"),
    *("landmarks", "loops", "metrics", "pose_graphs", "right_of_way", "service", "slam", "speed"),
    *("streaming", "tracking"),
)

app = application(getattr(import_module(f"benchmarks.{name}"), name) for name in NAMES)
