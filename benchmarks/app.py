"""All benchmarks, as one command: the function `NAME` of each module `benchmarks.NAME`."""

from __future__ import annotations

from importlib import import_module

from benchmarks.runner import application

NAMES = (
    *(
        "calibration",
        "conventions",
        "endurance",
        "estimators",
        "gaps",
        "geometry",
        "inertial",
        "joint",
        "kills",
        "labels",
        "landmarks",
        "loops",
        "metrics",
    ),
    *("modes", "pose_graphs", "scaling", "service", "settling", "slam", "smoothing", "speed", "streaming", "tracking"),
)

app = application(getattr(import_module(f"benchmarks.{name}"), name) for name in NAMES)
