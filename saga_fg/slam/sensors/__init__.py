"""Sensors of the vehicle in SLAM: their settings, what they measured since the last pose, and whether it fits."""

from saga_fg.slam.sensors.buffer import SensorBuffer
from saga_fg.slam.sensors.consistency import SensorConsistency
from saga_fg.slam.sensors.settings import SensorName, SensorSettings, sensor_providers

__all__ = ["SensorBuffer", "SensorConsistency", "SensorName", "SensorSettings", "sensor_providers"]
