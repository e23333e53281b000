"""Tables of all settings, from their dataclasses, which site_hooks.py adds to docs/configuration.md on the site."""

from __future__ import annotations

from data_tools.simulator import SimulatorSettings
from pipelines.config import TrackConfig
from pipelines.configuration import settings_reference
from pipelines.serving import StreamSettings
from pipelines.slam.configuration import SlamSettings
from saga_fg.providers import Gps, Imu, Landmarks, LaneKeeping, Odometry, StationaryObjects, Wheels
from saga_fg.smoothing import SmoothingSettings


def configuration_tables() -> str:
    """Tables in Markdown, a section for each command."""
    parts = []
    documented: dict[tuple[type, str], str] = {}
    for title, cls in (("Tracking (`saga-fg track`, `saga-fg demo`)", TrackConfig),
                       ("Smoothing (`saga-fg smooth`, below `smoothing`)", SmoothingSettings),
                       ("SLAM (`saga-fg slam`, below `slam`)", SlamSettings),
                       ("Limits of the service (`saga-fg serve --limits`)", StreamSettings),
                       ("The simulator (`saga-fg simulate`)", SimulatorSettings)):  # fmt: skip
        parts += [f"## {title}\n", settings_reference(cls, documented)]
    for cls in (Odometry, Gps, Imu, Wheels, Landmarks, LaneKeeping, StationaryObjects):
        parts += [f"## Factor provider `saga_fg.providers:{cls.__name__}`\n", settings_reference(cls, documented)]
    return "\n".join(parts)


if __name__ == "__main__":
    print(configuration_tables())
