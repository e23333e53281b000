"""A seedable traffic simulator: queues, platoons and merges on roads, seen by several sensors on one of the cars."""

from data_tools.simulator.scene import SimulatedTraffic, simulate_scene
from data_tools.simulator.settings import SensorSettings, SimulatorSettings, camera, lidar, radar

__all__ = [
    "SensorSettings",
    "SimulatedTraffic",
    "SimulatorSettings",
    "camera",
    "lidar",
    "radar",
    "simulate_scene",
]
