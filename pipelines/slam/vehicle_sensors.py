"""The vehicle's sensors beside its LiDAR: what they measured since the last keyframe, their factors, and their fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from pipelines.slam.between_keyframes import BetweenKeyframes
from pipelines.slam.odometry import OdometryStep
from pipelines.slam.wheel_comparison import WheelComparison
from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import checked_transform, inverse_transform
from saga_fg.slam.sensors import SensorConsistency, SensorName, SensorSettings, sensor_providers
from saga_fg.types.ego_measurements import EgoMeasurements, WheelSpeed


class VehicleSensors:
    """Sensors of the vehicle in a graph of the poses of its LiDAR.

    names       those that there are; settings: noise and places of all of them
    ego_T_lidar (4, 4) pose of the LiDAR on the vehicle, the identity by default
    others_read whether other providers may read what sensors measure that are not among the names
    """

    def __init__(
        self,
        names: Collection[SensorName],
        settings: SensorSettings | None,
        ego_T_lidar: FloatArray | None,
        others_read: bool = False,
    ) -> None:
        if isinstance(names, str):
            raise InputError(f"sensors: expected a list of names, such as [{names!r}], got a string")
        self.names, self._settings = tuple(names), settings or SensorSettings()
        self.ego_T_lidar = np.eye(4) if ego_T_lidar is None else checked_transform("ego_T_lidar", ego_T_lidar)
        self.lidar_T_ego = inverse_transform(self.ego_T_lidar)
        self.since_keyframe = BetweenKeyframes(self.names, others_read, self._settings.wheels.deviation)
        self.consistency = SensorConsistency(self.names, self._settings)
        self._wheels = WheelComparison(self._settings.wheels, self.ego_T_lidar)

    def new_providers(self) -> list[FactorProvider]:
        """Fresh providers of their factors."""
        return sensor_providers(self._settings, self.names, self.lidar_T_ego)

    def corrected(self, wheels: WheelSpeed | None) -> WheelSpeed | None:
        """The speed of the wheels that predicts the next scan's motion; scaled or None if scans contradict it."""
        return self._wheels.corrected(wheels) if "wheels" in self.names else wheels

    def compared(self, measured: EgoMeasurements, step: OdometryStep) -> EgoMeasurements:
        """What was measured until a scan that was placed, with the speed of the wheels that the graph takes.

        Warns once if wheels do not fit the scans.
        """
        if "wheels" not in self.names:
            return measured
        wheels, misfit = self._wheels.used(step), self._wheels.update(step)
        if misfit:
            self.consistency.state("wheels", misfit)
        return replace(measured, wheels=wheels)

    def velocity(self, wheels: WheelSpeed | None) -> FloatArray | None:
        """The velocity (6,) of the LiDAR by the wheels, as `LidarOdometry.step` takes it; None without them."""
        if wheels is None or "wheels" not in self.names:
            return None
        return np.concatenate([np.full(3, np.nan), self.ego_T_lidar[:3, :3].T @ [wheels.speed, 0.0, 0.0]])
