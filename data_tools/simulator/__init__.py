"""A seedable traffic simulator: queues, platoons and merges on roads, seen by several sensors on one of the cars."""

from data_tools.simulator.settings import (
    ScenarioName,
    SensorSettings,
    SimulatorSettings,
    camera,
    lidar,
    radar,
    scenario_settings,
)
from data_tools.simulator.world import SimulatedTraffic, simulate_scene, write_tables

__all__ = [
    "ScenarioName",
    "SensorSettings",
    "SimulatedTraffic",
    "SimulatorSettings",
    "camera",
    "lidar",
    "radar",
    "scenario_settings",
    "simulate_scene",
    "write_tables",
]
