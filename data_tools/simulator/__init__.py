"""A seedable traffic simulator: queues, platoons and merges on roads, seen by several sensors on one of the cars."""

from data_tools.simulator.settings import SensorSettings, SimulatorSettings, camera, lidar, radar
from data_tools.simulator.world import SimulatedTraffic, simulate_scene

__all__ = [
    "SensorSettings",
    "SimulatedTraffic",
    "SimulatorSettings",
    "camera",
    "lidar",
    "radar",
    "simulate_scene",
]
